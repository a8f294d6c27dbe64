"""Identify the modal model of the bench from one uncontrolled run, by variable projection.

Lens 4 and image swing freely after the blow: y(t) = Re Σ Y_j e^{λ_j t}, a(t) = Re Σ A_j e^{λ_j t}. The
amplitudes are linear, so only the poles are searched for (Golub and Pereyra 1973, with Kaufman's Jacobian).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import qr, solve_triangular
from scipy.optimize import least_squares

from wavequake.control.linear import Array
from wavequake.control.regulator import Complex, ModalModel
from wavequake.errors import UserError

# How far decays (of logarithms) and frequencies (as shares) are expected to be off a nominal model's. The
# record decides; on a short one, which cannot tell close modes apart, this keeps them in place.
DECAY_SPREAD, FREQUENCY_SPREAD = 0.5, 0.02
# A fit that leaves more than this share of the motion has failed: friction and the strip leave less.
FAILED = 0.1


@dataclass(frozen=True)
class Record:
    """A run after the blow at t = 0: lens 4 as the control unit reads it, image as the camera sees it.

    Attributes
    ----------
    time, measured : ndarray, shape (k,)
        s, m; instants are evenly spaced.
    frame_time, image : ndarray, shape (f,)
        s, m; evenly spaced, too.
    """

    time: Array
    measured: Array
    frame_time: Array
    image: Array


@dataclass(frozen=True)
class Identified:
    """A modal model, and what it leaves: rms of both signals, m, and evaluations that it took."""

    model: ModalModel
    measured_rms: float
    image_rms: float
    evaluations: int


def identify(
    record: Record,
    nominal: ModalModel,
    *,
    after: float = 0.016,
    stages: tuple[tuple[float, float], ...] = ((1.0, 10.0), (2.5, 3.0), (np.inf, 1.0)),
    measured_noise: float = 10e-6,
    image_noise: float = 20e-6,
) -> Identified:
    """Identify poles, image row and state after the blow, starting from a nominal model.

    Parameters
    ----------
    record : Record
    nominal : ModalModel
        Poles within some percent of the true ones.
    after : float
        From when on the hammer has left, s.
    stages : tuple of (float, float)
        Lengths of the record that are fitted one after the other, s, and by how much the noise is overstated:
        a short piece finds the neighborhood, in which the phase of a long one is unambiguous, and must not
        drive modes apart that it cannot resolve.
    measured_noise, image_noise : float
        Standard deviations, m: weights of the two signals.

    Raises
    ------
    UserError
        If the record is too short or not finite, or a fit leaves too much (says which mode went farthest).
    """
    count = len(nominal.poles)
    poles, evaluations = nominal.poles, 0
    for horizon, softer in stages:
        signals = _signals(record, after, horizon, (measured_noise * softer, image_noise * softer))
        if min(len(time) for time, _ in signals) < 4 * count or not all(
            np.isfinite(values).all() for _, values in signals
        ):
            raise UserError(
                f"{count} modes cannot be identified: the record needs at least {4 * count} finite samples "
                f"of lens and image between {after:g} s and {min(horizon, float(record.time[-1])):g} s."
            )
        found = least_squares(
            _residual, _unknowns(poles, nominal.poles), _jacobian, args=(signals, nominal.poles, _Cache()),
            method="lm", xtol=1e-6, ftol=1e-7, max_nfev=40,
        )  # fmt: skip
        poles, evaluations = _poles(found.x, nominal.poles), evaluations + int(found.nfev)
    seen, shown = (_projected(time, values, poles) for time, values in signals)
    scales = (measured_noise * softer, image_noise * softer)
    lens, image = seen.amplitudes * scales[0], shown.amplitudes * scales[1]
    identified = Identified(
        ModalModel(poles, image / lens, lens),
        float(np.sqrt(np.mean(seen.rest**2))) * scales[0],
        float(np.sqrt(np.mean(shown.rest**2))) * scales[1],
        evaluations,
    )
    _check(
        identified, nominal.poles, max(8 * measured_noise, FAILED * float(np.std(signals[0][1])) * scales[0])
    )
    return identified


def _check(found: Identified, nominal: Complex, most: float) -> None:
    """Raise UserError that names the mode which has gone farthest, if the search went astray."""
    if found.measured_rms > most or not (found.model.poles.imag > 0).all():
        number = int(np.argmax(np.abs(found.model.poles / nominal - 1)))
        raise UserError(
            f"The identification failed: it leaves {1e6 * found.measured_rms:.3g} um of the motion of lens 4 "
            f"and mode {number + 1}, nominally at {nominal[number].imag:.4g} rad/s, ended at "
            f"{found.model.poles[number].imag:.4g} rad/s; give a longer record or a closer nominal "
            "model."
        )


Signals = tuple[tuple[Array, Array], tuple[Array, Array]]


def _signals(record: Record, after: float, horizon: float, noise: tuple[float, float]) -> Signals:
    kept = [(time >= after) & (time <= after + horizon) for time in (record.time, record.frame_time)]
    return (
        (record.time[kept[0]], record.measured[kept[0]] / noise[0]),
        (record.frame_time[kept[1]], record.image[kept[1]] / noise[1]),
    )


class _Projection(NamedTuple):
    """Waves e^{λt} of the modes, an orthonormal basis of them, their amplitudes in a signal, what is left."""

    waves: Complex
    q: Array
    amplitudes: Complex
    rest: Array


def _waves(time: Array, poles: Complex) -> Complex:
    """Return e^{λt} at evenly spaced instants, (k, m), from two short tables: exponentials are dear."""
    step, block = time[1] - time[0], 64
    fine = np.exp(np.multiply.outer(step * np.arange(block), poles))
    coarse = np.exp(np.multiply.outer(time[::block], poles))
    table = (coarse[:, None] * fine[None]).reshape(-1, len(poles))
    return np.asarray(table[: len(time)])


def _projected(time: Array, values: Array, poles: Complex) -> _Projection:
    """Project a signal on the waves; the real basis is Re e^{λt}, then -Im e^{λt}."""
    count, waves = len(poles), _waves(time, poles)
    q, r = qr(np.hstack([waves.real, -waves.imag]), mode="economic", check_finite=False, overwrite_a=True)
    if np.abs(np.diag(r)).min() <= 1e-12 * np.abs(np.diag(r)).max():
        # Poles that coincide or have decayed before the record begins: a point that the search turns down.
        return _Projection(waves, q, np.zeros(count, dtype=np.complex128), values)
    parts = q.T @ values
    amplitudes = solve_triangular(r, parts)
    return _Projection(waves, q, amplitudes[:count] + 1j * amplitudes[count:], values - q @ parts)


def _unknowns(poles: Complex, nominal: Complex) -> Array:
    """Return what is searched for: how far decays (as logarithms) and frequencies are off, in expected steps.

    As such they are small numbers, decays stay decays, and their squares weigh what is known beforehand.
    """
    decay = np.log(poles.real / nominal.real) / DECAY_SPREAD
    return np.concatenate([decay, (poles.imag / nominal.imag - 1) / FREQUENCY_SPREAD])


def _poles(x: Array, nominal: Complex) -> Complex:
    count = len(nominal)
    decay = nominal.real * np.exp(DECAY_SPREAD * np.clip(x[:count], -10, 10))
    return np.asarray(decay + 1j * nominal.imag * (1 + FREQUENCY_SPREAD * x[count:]))


class _Cache:
    """The projections of the last point: residual and Jacobian ask for the same ones."""

    def __init__(self) -> None:
        self.at: Array | None = None
        self.found: list[_Projection] = []

    def projections(self, x: Array, signals: Signals, poles: Complex) -> list[_Projection]:
        if self.at is None or not np.array_equal(x, self.at):
            self.at, self.found = x.copy(), [_projected(time, values, poles) for time, values in signals]
        return self.found


def _residual(x: Array, signals: Signals, nominal: Complex, cache: _Cache) -> Array:
    found = cache.projections(x, signals, _poles(x, nominal))
    return np.concatenate([*(one.rest for one in found), x])


def _jacobian(x: Array, signals: Signals, nominal: Complex, cache: _Cache) -> Array:
    """Return Kaufman's approximation: the derivative of the basis, without what the basis itself explains."""
    poles = _poles(x, nominal)
    by_decay, by_frequency = DECAY_SPREAD * poles.real, 1j * FREQUENCY_SPREAD * nominal.imag
    blocks = []
    for (time, _), one in zip(signals, cache.projections(x, signals, poles), strict=True):
        moved = time[:, None] * one.waves * one.amplitudes
        slopes = np.hstack([(moved * by_decay).real, (moved * by_frequency).real])
        blocks.append(one.q @ (one.q.T @ slopes) - slopes)
    return np.vstack([*blocks, np.eye(len(x))])
