"""Filters that channels share: integrator with leak and proportional part, and LQG of a known disturbance.

Each takes what is left in one channel, in the actuator's units, and gives the channel's command; unit gain
from a position to what is left.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag, expm, solve_discrete_are

from wavequake.control.frames.controllers import filter_gain
from wavequake.control.frames.disturbance import Shaped, balanced, sampled
from wavequake.control.linear import Array, LinearModel
from wavequake.control.sampled.channel import RIGID, Dynamics, Timing, in_series, sampled_channel
from wavequake.errors import UserError


def integrator(gain: float, leak: float = 0.0, proportional: float = 0.0) -> LinearModel:
    """Return u_k = (1 - leak) u_(k-1) - gain z_k - proportional (z_k - (1 - leak) z_(k-1)).

    Its state is u_(k-1) + proportional z_(k-1).
    """
    keep = 1.0 - leak
    a, b = np.array([[keep]]), np.array([[-gain]])
    return LinearModel(a, b, np.array([[keep]]), np.array([[-gain - proportional]]))


def crossover_gain(bandwidth_hz: float, period: float) -> float:
    """Return the gain at which the loop gain of an integrator is 1 at a frequency: 2 sin(pi f T)."""
    return float(2 * np.sin(np.pi * bandwidth_hz * period))


def drift(corner_hz: float, rms: float) -> Shaped:
    """Return first-order noise of a corner and an rms."""
    rate = 2 * np.pi * corner_hz
    return Shaped(np.array([[-rate]]), np.array([[np.sqrt(2 * rate)]]), np.array([rms]))


@dataclass(frozen=True)
class _Read:
    """A disturbance by periods as a sensor reads it: filter, row of readings, and of what it is."""

    phi: Array
    gain: Array
    row: Array
    left: Array
    ahead: Callable[[float], Array]


def _read(known: Shaped, noise: float, timing: Timing, shows: Dynamics) -> _Read:
    """Return the Kalman filter of a disturbance that a sensor with dynamics reads.

    Raises
    ------
    UserError
        If the noise is not positive, or the sensor does not average over whole frames.
    """
    if timing.integration < timing.frame:
        raise UserError("The filter needs a sensor that averages over whole frames (integration = 1).")
    n, m = len(known.a), len(shows)
    a = np.block([[known.a, np.zeros((n, m))], [np.outer(shows.b, known.c), shows.a]])
    g = np.vstack([known.g, np.zeros((m, known.g.shape[1]))])
    shown = Shaped(a, g, np.concatenate([shows.d * known.c, shows.c]))
    plain = np.concatenate([known.c, np.zeros(m)])
    if m:
        # States of unit variance, and a reading of unit variance: accelerations are of another size.
        shown, sizes = balanced(shown)
        plain = plain * sizes
    found = sampled(shown, timing.period)
    size = float(np.sqrt(found.variance)) if m else 1.0
    scaled = replace(found, row=found.row / size, s=found.s / size, r=found.r / size**2)
    gain = filter_gain(scaled, noise / size)[:, None] / size
    left = sampled(replace(shown, c=plain), timing.period).row[None]
    return _Read(found.phi, gain, found.row[None], left, lambda late: np.asarray(left @ expm(shown.a * late)))


def lqg(
    known: Shaped, noise: float, follows: Dynamics, timing: Timing, shows: Dynamics = RIGID
) -> LinearModel:
    """Return LQG of a disturbance of one channel: what it will be while the command acts, sign turned.

    A Kalman predictor of the disturbance alone reads what is left less what the channel itself did, of which
    it keeps a model. With an actuator that is a pure delay this is optimal; how fast the actuator follows is
    known to the filter, but not made up for.

    Parameters
    ----------
    known : Shaped
    noise : float
        Standard deviation of the mean reading of a period, in the units of what the sensor gives.
    follows : Dynamics
        The actuator.
    timing : Timing
    shows : Dynamics
        The sensor, which need not see constants: an accelerometer.

    Raises
    ------
    UserError
        If the noise is not positive, or the sensor does not average over whole frames.
    """
    found = _read(known, noise, timing, shows)
    gain, ahead = found.gain, found.ahead(timing.latency)
    plant = sampled_channel(in_series(follows, shows), timing)
    phi = found.phi - gain @ found.row
    acts = ahead @ gain
    return LinearModel(
        np.block([[phi, -gain @ plant.c], [-plant.b @ ahead @ phi, plant.a + plant.b @ acts @ plant.c]]),
        np.vstack([gain, -plant.b @ acts]),
        np.hstack([-ahead @ phi, acts @ plant.c]),
        -acts,
        timing.period,
    )


def lqr(
    known: Shaped,
    noise: float,
    effort: float,
    follows: Dynamics,
    timing: Timing,
    shows: Dynamics = RIGID,
) -> LinearModel:
    """Return the regulator that leaves the least of z^2 + effort (u_k - u_(k-1))^2, with its Kalman filter.

    Unlike `lqg` it makes up for how an actuator follows. The filter is that of `lqg`; by certainty
    equivalence both together are optimal.

    Parameters
    ----------
    known, noise, follows, timing, shows
        As of `lqg`; z is what is left, not what a sensor shows of it.
    effort : float
        Cost of a change of the command.

    Raises
    ------
    UserError
        If the noise is not positive, or the sensor does not average over whole frames.
    """
    found = _read(known, noise, timing, shows)
    gain = found.gain
    whole = in_series(follows, shows)
    plant = sampled_channel(whole, timing)
    moved = Dynamics(whole.a, whole.b, np.concatenate([follows.c, np.zeros(len(shows))]), follows.d)
    moved_row = sampled_channel(moved, timing).c
    n, m = len(plant.a), len(found.phi)
    # States: the actuator now, the disturbance of the next period as it is expected, the last command.
    step = block_diag(plant.a, found.phi, np.eye(1))
    step[:n, n + m :] = plant.b
    into = np.vstack([plant.b, np.zeros((m, 1)), np.ones((1, 1))])
    through = moved_row @ plant.b
    seen, size = np.hstack([moved_row @ plant.a, found.left, through]), effort + through**2
    cost = solve_discrete_are(step, into, seen.T @ seen, size, s=seen.T @ through)
    weights = np.linalg.solve(size + into.T @ cost @ into, into.T @ cost @ step + through.T @ seen)
    by_actuator, by_disturbance, by_last = np.split(weights, [n, n + m], axis=1)
    # The innovation is the reading less what actuator and disturbance were expected to give.
    ahead = found.phi - gain @ found.row
    command = np.hstack(
        [by_disturbance @ gain @ plant.c - by_actuator, -by_disturbance @ ahead, np.eye(1) - by_last]
    )
    reading = -by_disturbance @ gain
    a = block_diag(plant.a, ahead, np.zeros((1, 1)))
    a[n : n + m, :n] = -gain @ plant.c
    a[:n] += plant.b @ command
    a[n + m :] = command
    b = np.vstack([plant.b @ reading, gain, reading])
    return LinearModel(a, b, command, reading, timing.period)
