"""LQG of several sensors and channels together, of the same frames, on a structure that it knows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, expm, solve_continuous_lyapunov, solve_discrete_are

from wavequake.control.frames.disturbance import stepped
from wavequake.control.linear import Array, LinearModel
from wavequake.control.sampled.alike import coupled, stacked
from wavequake.control.sampled.channel import Dynamics, Timing, in_series, sampled_channel
from wavequake.errors import UserError


@dataclass(frozen=True)
class Known:
    """A disturbance of several signals: x' = A x + G w, w white noise of unit intensity.

    Attributes
    ----------
    a, g : ndarray, shapes (n, n), (n, q)
    target : ndarray, shape (p, n)
        What each channel should take away, in its unit.
    """

    a: Array
    g: Array
    target: Array


@dataclass(frozen=True)
class Seen:
    """What a sensor of m readings sees.

    Attributes
    ----------
    disturbance, positions, modes : ndarray, shapes (m, n), (m, p), (m, K)
        Per state of the disturbance, position of a channel, and mode of the structure.
    shows : Dynamics
        How a reading follows what is read.
    noise : float
        Standard deviation of a reading's mean over a period.
    """

    disturbance: Array
    positions: Array
    modes: Array
    shows: Dynamics
    noise: float


def fused(
    known: Known,
    seen: Sequence[Seen],
    follows: Dynamics,
    timing: Timing,
    structure: Sequence[Dynamics],
    drives: Array,
) -> LinearModel:
    """Return LQG: what the target will be on average while the command acts, sign turned, of all readings.

    Parameters
    ----------
    known : Known
    seen : sequence of Seen
        The sensors; their readings are inputs, one sensor after the other.
    follows : Dynamics
        Of every channel of the actuator, which is known to the filter, but not made up for.
    timing : Timing
        Of all sensors.
    structure : sequence of Dynamics
        How its modes answer what moves along them, known to the filter, too.
    drives : ndarray, shape (K, p)

    Raises
    ------
    UserError
        If noise is not positive, a sensor does not average over whole frames, or the equation cannot be
        solved.
    """
    if timing.integration < timing.frame:
        raise UserError("The filter needs sensors that average over whole frames (integration = 1).")
    if not all(np.isfinite(one.noise) and one.noise > 0 for one in seen):
        raise UserError("A filter needs positive noise of each sensor.")
    noise = np.concatenate([np.full(len(one.positions), one.noise) for one in seen])
    a, g, rows = _shown(known, seen)
    # States of unit variance, but those of readings that see nothing; readings in units of their noise.
    sizes = np.sqrt(np.maximum(np.diag(solve_continuous_lyapunov(a, -g @ g.T)), 0.0))
    sizes[sizes == 0.0] = 1.0
    a, g, rows = a * sizes / sizes[:, None], g / sizes[:, None], rows * sizes
    target, rows = rows[: len(known.target)], rows[len(known.target) :] / noise[:, None]
    phi, mean, q, s, r = _by_periods(a, g, rows, timing.period)
    try:
        p = solve_discrete_are(phi.T, mean.T, q, r + np.eye(len(r)), s=s)
    except (ValueError, np.linalg.LinAlgError):
        raise UserError(
            "The filter's equation is too ill-conditioned to be solved; expect wider lines, or name fewer "
            "sensors."
        ) from None
    gain = np.linalg.solve(mean @ p @ mean.T + r + np.eye(len(r)), (phi @ p @ mean.T + s).T).T / noise
    mean = mean * noise[:, None]
    ahead = _by_periods(a, g, target, timing.period)[1] @ expm(a * timing.latency)
    plant = plant_of(seen, follows, timing, structure, drives)
    left, acts = phi - gain @ mean, ahead @ gain
    return LinearModel(
        np.block([[left, -gain @ plant.c], [-plant.b @ ahead @ left, plant.a + plant.b @ acts @ plant.c]]),
        np.vstack([gain, -plant.b @ acts]),
        np.hstack([-ahead @ left, acts @ plant.c]),
        -acts,
        timing.period,
    )


def _shown(known: Known, seen: Sequence[Seen]) -> tuple[Array, Array, Array]:
    """Return disturbance and sensors as one system: A, G, and rows of the target, then of all readings."""
    n = len(known.a)
    blocks = [(np.eye(len(one.positions)), one) for one in seen]
    sensors = block_diag(np.zeros((0, 0)), *(np.kron(one.shows.a, unit) for unit, one in blocks))
    into = np.vstack([np.zeros((0, n)), *(np.kron(one.shows.b[:, None], one.disturbance) for one in seen)])
    out = block_diag(*(np.kron(one.shows.c[None], unit) for unit, one in blocks))
    through = np.vstack([one.shows.d * one.disturbance for one in seen])
    a = np.block([[known.a, np.zeros((n, len(sensors)))], [into, sensors]])
    g = np.vstack([known.g, np.zeros((len(sensors), known.g.shape[1]))])
    target = np.hstack([known.target, np.zeros((len(known.target), len(sensors)))])
    return a, g, np.vstack([target, np.hstack([through, out])])


def _by_periods(a: Array, g: Array, rows: Array, period: float) -> tuple[Array, Array, Array, Array, Array]:
    """Return the step of states, rows of means over the period, and covariances Q, S, R of both noises."""
    n, m = len(a), len(rows)
    whole = np.block([[a, np.zeros((n, m))], [rows, np.zeros((m, m))]])
    step, noise = stepped(whole, np.vstack([g, np.zeros((m, g.shape[1]))]), period)
    scale = 1.0 / period
    return (
        step[:n, :n],
        step[n:, :n] * scale,
        noise[:n, :n],
        noise[:n, n:] * scale,
        noise[n:, n:] * scale**2,
    )


def plant_of(
    seen: Sequence[Seen], follows: Dynamics, timing: Timing, structure: Sequence[Dynamics], drives: Array
) -> LinearModel:
    """Return what sensors read of commands, by periods, one sensor after the other."""
    parts = []
    for one in seen:
        moving = [follows, *(in_series(follows, mode) for mode in structure)]
        channels = tuple(sampled_channel(in_series(each, one.shows), timing) for each in moving)
        parts.append(coupled(channels, one.positions, one.modes, drives))
    return stacked(parts)
