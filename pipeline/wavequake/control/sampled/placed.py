"""A filter of one channel by placed poles: an observer of the disturbance and a faster or slower actuator."""

import numpy as np

from wavequake.control.linear import Array, LinearModel
from wavequake.control.sampled.channel import Dynamics, Timing, sampled_channel
from wavequake.errors import UserError

_REST = 1e-9


def placed(
    observer_hz: float, actuator_hz: float | None, damping: float, dynamics: Dynamics, timing: Timing
) -> LinearModel:
    """Return the filter of a channel whose loop has given poles.

    Commands are known, so that a model says what the channel does; the rest of a reading is the disturbance,
    followed with one pole. The command takes it away without static error. Poles of the actuator and sensor
    move to a circle of radius `actuator_hz` (pairs of a damping ratio, one real pole where their number is
    odd) by Ackermann's formula (Åström and Wittenmark 1997, Computer-Controlled Systems, section 4.3), those
    of the delay stay at zero.

    Parameters
    ----------
    observer_hz : float
        Of the pole exp(-2 pi f T) that follows the disturbance.
    actuator_hz : float or None
        Where the dynamics' poles go; None: they stay.
    damping : float
        Of pairs.
    dynamics : Dynamics
        Unit static gain.
    timing : Timing

    Raises
    ------
    UserError
        If the poles cannot be moved.
    """
    period = timing.period
    follow = 1.0 - np.exp(-2 * np.pi * observer_hz * period)
    plant, n = sampled_channel(dynamics, timing), len(dynamics)
    size = len(plant.a)
    feedback = np.zeros((1, size))
    if actuator_hz is not None and n:
        wanted = np.concatenate([np.exp(_circle(n, actuator_hz, damping) * period), np.zeros(size - n)])
        feedback = _ackermann(plant.a, plant.b, wanted)
    kept = plant.a - plant.b @ feedback
    static = float((plant.c @ np.linalg.solve(np.eye(size) - kept, plant.b))[0, 0])
    if abs(static) < _REST:
        raise UserError("The actuator cannot hold a constant against these poles; move them elsewhere.")
    # States: the channel as its model has it, and the disturbance as it was last believed to be.
    by_model = -feedback + follow / static * plant.c
    command = np.hstack([by_model, [[-(1.0 - follow) / static]]])
    through = np.array([[-follow / static]])
    a = np.block([[plant.a, np.zeros((size, 1))], [-follow * plant.c, np.array([[1.0 - follow]])]])
    a[:size] += plant.b @ command
    b = np.vstack([plant.b @ through, [[follow]]])
    return LinearModel(a, b, command, through, period)


def _circle(count: int, hertz: float, damping: float) -> Array:
    """Return so many poles on a circle, pairs of a damping ratio; the last of an odd number is real."""
    radius = 2 * np.pi * hertz
    pair = radius * (-damping + np.emath.sqrt(damping**2 - 1) * np.array([1.0, -1.0]))
    return np.concatenate([np.tile(pair, count // 2), [-radius] * (count % 2)])


def _ackermann(a: Array, b: Array, poles: Array) -> Array:
    """Return K (1, n) with poles of a - b K, which may repeat."""
    reach = np.hstack([np.linalg.matrix_power(a, k) @ b for k in range(len(a))])
    polynomial = np.real(np.poly(poles))
    value = sum(one * np.linalg.matrix_power(a, len(a) - k) for k, one in enumerate(polynomial))
    last = np.zeros(len(a))
    last[-1] = 1.0
    return np.asarray(np.linalg.solve(reach.T, last) @ value)[None]
