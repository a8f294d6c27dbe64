"""Poles and margins of a sampled loop of many channels, all that is changed changed in all of them alike.

Where all channels share a filter and the actuator's dynamics, a loop is as many loops of one channel as there
are eigenvalues of W M, decoupling times sight: each is small, whatever the number of channels.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar

from wavequake.control.linear import Array, LinearModel, frequency_response
from wavequake.control.robustness.margins import Margins
from wavequake.control.sampled.channel import Dynamics, Timing, sampled_channel
from wavequake.control.sampled.regulator import Regulator, model_of

Complex = NDArray[np.complex128]

# Factors of the gain that are tried, up and down; beyond them a margin does not matter.
_FACTORS = np.geomspace(1.0, 1e3, 150)
_ROUNDING = 1e-9
# Eigenvalues of W M nearer than this share of the largest one are one.
_ALIKE = 1e-9
_POINTS = 1500
# Eigenvalues whose crossings are followed, and frequencies at which singular values are taken.
_FINE, _TRIED, _EVENLY = 60, 12, 60


@dataclass(frozen=True)
class SampledLoop:
    """A regulator with what it moves and sees.

    Attributes
    ----------
    timing : Timing
    dynamics : Dynamics
    sees : ndarray, shape (m, p)
        Change of readings with positions, as they truly are.
    regulator : Regulator
    """

    timing: Timing
    dynamics: Dynamics
    sees: Array
    regulator: Regulator


@dataclass(frozen=True)
class Worst:
    """The slowest or fastest growing pole: eigenvalue of a period, 1/s, Hz, and weights (p,) of channels."""

    value: complex
    growth: float
    hertz: float
    channels: Array


def plant_model(loop: SampledLoop) -> LinearModel:
    """Return the plant from commands (p,) to mean readings (m,) by periods; strictly proper."""
    one, unit = sampled_channel(loop.dynamics, loop.timing), np.eye(loop.sees.shape[1])
    return LinearModel(
        np.asarray(np.kron(one.a, unit), dtype=np.float64),
        np.asarray(np.kron(one.b, unit), dtype=np.float64),
        loop.sees @ np.kron(one.c, unit),
        np.zeros(loop.sees.shape),
        one.sample_time,
    )


def controller_model(loop: SampledLoop) -> LinearModel:
    """Return H of u = -H y by periods."""
    found = model_of(loop.regulator, loop.timing.period)
    return LinearModel(found.a, found.b, -found.c, -found.d, found.sample_time)


def worst_pole(loop: SampledLoop, factor: float = 1.0) -> Worst:
    """Return the pole that grows most, with the loop gain times a factor."""
    plant = sampled_channel(loop.dynamics, loop.timing)
    sees = factor * loop.sees
    if loop.regulator.shared:
        gains, shapes = np.linalg.eig(loop.regulator.decoupling @ sees)
        kept = np.unique(np.round(gains / np.abs(gains).max(), 9), return_index=True)[1]
        kept = kept[np.abs(gains[kept]) > _ALIKE * np.abs(gains).max()]  # nothing drives the others
        found = [_closed(plant, _filter(loop.regulator), one) for one in gains[kept]]
        mode = int(np.argmax([np.abs(one).max(initial=0.0) for one in found]))
        values, channels = found[mode], np.abs(shapes[:, kept[mode]])
    else:
        whole, own = plant_model(loop), model_of(loop.regulator, loop.timing.period)
        whole = LinearModel(whole.a, whole.b, factor * whole.c, whole.d, whole.sample_time)
        step = np.block([[whole.a + whole.b @ own.d @ whole.c, whole.b @ own.c], [own.b @ whole.c, own.a]])
        values, vectors = np.linalg.eig(step)
        p = loop.sees.shape[1]
        parts = np.abs(vectors[: len(whole.a), np.abs(values).argmax()]).reshape(-1, p)
        channels = parts.sum(axis=0)
    value = complex(values[np.abs(values).argmax()])
    rate = np.log(max(abs(value), 1e-300)) / loop.timing.period
    hertz = abs(np.angle(value)) / (2 * np.pi * loop.timing.period)
    return Worst(value, float(rate), float(hertz), channels)


def _filter(regulator: Regulator) -> LinearModel:
    a, b, c, d = regulator.a[0], regulator.b[0], regulator.c[0], regulator.d[0]
    return LinearModel(a, b, c, d)


def _closed(plant: LinearModel, own: LinearModel, gain: complex) -> Complex:
    """Return the poles of u = filter(gain plant(u))."""
    c = gain * plant.c
    closed = np.block([[plant.a + plant.b @ own.d @ c, plant.b @ own.c], [own.b @ c, own.a]])
    return np.asarray(np.linalg.eigvals(closed), dtype=np.complex128)


@dataclass(frozen=True)
class LoopGain:
    """The loop gain -K G at the commands over frequency, in Hz: eigenvalues (f, q) and whole, (q, q)."""

    loci: Callable[[Array], Complex]
    whole: Callable[[float], Complex]


def _loop_gain(loop: SampledLoop) -> LoopGain:
    plant, period = sampled_channel(loop.dynamics, loop.timing), loop.timing.period
    regulator = loop.regulator
    if not regulator.shared:
        model = model_of(regulator, period)

        def full(hertz: Array) -> Complex:
            size = frequency_response(plant, 2 * np.pi * hertz)
            return np.asarray(-frequency_response(model, 2 * np.pi * hertz) @ loop.sees * size)

        return LoopGain(
            lambda hertz: np.asarray(np.linalg.eigvals(full(hertz)), dtype=np.complex128),
            lambda hertz: np.asarray(full(np.array([hertz]))[0]),
        )
    own = _filter(regulator)
    own = LinearModel(own.a, own.b, own.c, own.d, period)
    gains, matrix = _distinct(loop), regulator.decoupling @ loop.sees
    if len(gains) == 1 and np.abs(matrix - gains[0] * np.eye(len(matrix))).max() < _ALIKE * np.abs(gains[0]):
        matrix = np.array([[gains[0].real]])  # as many equal loops

    def size(hertz: Array) -> Complex:
        omega = 2 * np.pi * hertz
        found = -frequency_response(own, omega) * frequency_response(plant, omega)
        return np.asarray(found[:, 0, 0])

    return LoopGain(
        lambda hertz: np.asarray(size(hertz)[:, None] * gains),
        lambda hertz: np.asarray(size(np.array([hertz]))[0] * matrix),
    )


def _distinct(loop: SampledLoop) -> Complex:
    """Return the eigenvalues of W M without those that are alike or nothing."""
    gains = np.linalg.eigvals(loop.regulator.decoupling @ loop.sees).astype(complex)
    largest = np.abs(gains).max()
    kept = np.unique(np.round(gains / largest, 9), return_index=True)[1]
    return np.asarray(gains[kept][np.abs(gains[kept]) > _ALIKE * largest])


def _grid(loop: SampledLoop) -> Array:
    """Return rising frequencies up to half the rate of commands, some about each pole of the loop."""
    if loop.regulator.shared:
        plant = sampled_channel(loop.dynamics, loop.timing)
        values = np.concatenate([_closed(plant, _filter(loop.regulator), one) for one in _distinct(loop)])
    else:
        values = np.linalg.eigvals(model_of(loop.regulator, loop.timing.period).a).astype(complex)
    return pole_grid(values, loop.timing.period)


def pole_grid(values: Complex, period: float) -> Array:
    """Return rising frequencies up to half the rate of commands, some about each pole of a period, in Hz."""
    high = 0.5 / period
    poles = np.log(values[np.abs(values) > 1e-6]) / period / (2 * np.pi)
    poles = poles[poles.imag >= 0]
    poles = poles[np.unique(np.round(np.log(np.abs(poles) + 1e-300), 6), return_index=True)[1]]
    poles = poles[np.abs(poles.real) < 0.2 * np.abs(poles.imag)]
    about = (poles.imag[:, None] + np.abs(poles.real)[:, None] * np.linspace(-6, 6, 25)).ravel()
    between = [np.linspace(0, high, _POINTS)[1:], np.geomspace(1e-6 * high, high, _POINTS)]
    return np.unique(np.concatenate([about[(about > 0) & (about <= high)], *between]))


def sampled_margins(loop: SampledLoop) -> Margins:
    """Return the margins of a stable loop, at the commands; delay in s, frequencies in rad/s.

    The last frequency is that at which an eigenvalue of the loop gain reaches 1. The sensitivity is
    (I - K G)^-1 of what the actuators should do, G the plant and K the regulator.
    """
    plant = sampled_channel(loop.dynamics, loop.timing)
    gains = _distinct(loop) if loop.regulator.shared else np.zeros(0, dtype=complex)

    def radius(factor: float) -> float:
        if not len(gains):
            return abs(worst_pole(loop, factor).value)
        poles = (_closed(plant, _filter(loop.regulator), factor * one) for one in gains)
        return max(float(np.abs(one).max()) for one in poles)

    return gain_margins(_loop_gain(loop), _grid(loop), radius)


def gain_margins(gain: LoopGain, hertz: Array, radius: Callable[[float], float]) -> Margins:
    """Return margins from the loop gain at frequencies and the size of the largest pole by its factor."""
    loci = gain.loci(hertz)
    peak, where = _peak(gain, hertz, loci)
    late, at = _critical(gain, hertz, loci)
    above = np.flatnonzero(np.abs(loci).max(axis=1) >= 1.0)
    return Margins(
        peak,
        2 * np.pi * where,
        first_unstable(radius, _FACTORS, np.inf),
        first_unstable(radius, 1 / _FACTORS, 0.0),
        float(np.minimum(late, 2 * np.pi - late).min(initial=np.pi)),
        float((late / (2 * np.pi * at)).min(initial=np.inf)),
        2 * np.pi * float(hertz[above[-1]]) if len(above) else 0.0,
    )


def curve(loop: SampledLoop, hertz: Array) -> tuple[Complex, Array, Array]:
    """Return a loop at frequencies in Hz (f,), NaN beyond half the rate of commands.

    Returns
    -------
    gain : ndarray of complex, shape (f,)
        The eigenvalue of the loop gain that is nearest to -1.
    rejection, passed : ndarray, shape (f,)
        Largest 1 / (1 + L) and L / (1 + L) of an eigenvalue L.
    """
    inside = hertz < 0.5 / loop.timing.period
    loci = _loop_gain(loop).loci(hertz[inside])
    nearest = np.abs(1.0 + loci).argmin(axis=1)
    gain = np.full(len(hertz), np.nan + 0j)
    rejection, passed = np.full((2, len(hertz)), np.nan)
    gain[inside] = loci[np.arange(len(loci)), nearest]
    rejection[inside] = (1.0 / np.abs(1.0 + loci)).max(axis=1)
    passed[inside] = np.abs(loci / (1.0 + loci)).max(axis=1)
    return gain, rejection, passed


def _peak(gain: LoopGain, hertz: Array, loci: Complex) -> tuple[float, float]:
    """Return the largest singular value of the sensitivity, looked for where eigenvalues peak, and its Hz."""
    sizes = (1.0 / np.abs(1.0 + loci)).max(axis=1)
    if gain.whole(float(hertz[0])).shape == (1, 1):
        return float(sizes.max()), float(hertz[sizes.argmax()])
    # Eigenvalues say where a peak is, but for matrices that are not normal singular values have their own.
    evenly = np.linspace(0, len(hertz) - 1, _EVENLY).astype(int)
    places = np.unique(np.concatenate([np.argsort(-sizes, kind="stable")[:_TRIED], evenly]))
    found = [_sensitivity(gain.whole(float(hertz[one]))) for one in places]
    top = int(np.argmax(found))
    low, high = hertz[places[max(top - 1, 0)]], hertz[places[min(top + 1, len(places) - 1)]]
    near = minimize_scalar(
        lambda at: -_sensitivity(gain.whole(float(at))), bounds=(low, high), method="bounded"
    )
    return max((float(found[top]), float(hertz[places[top]])), (-float(near.fun), float(near.x)))


def _sensitivity(gain: Complex) -> float:
    return float(1.0 / np.linalg.svd(np.eye(len(gain)) + gain, compute_uv=False)[-1])


def _critical(gain: LoopGain, hertz: Array, loci: Complex) -> tuple[Array, Array]:
    """Return by which phases eigenvalues of size 1 come before -1, and their frequencies."""
    order = np.sort(np.abs(loci), axis=1)
    late, at = [], []
    for rank in dict.fromkeys([0, order.shape[1] - 1, *range(min(order.shape[1], _FINE))]):
        signs = np.sign(order[:, rank] - 1.0)
        for one in np.flatnonzero(signs[1:] * signs[:-1] < 0):

            def height(f: float, rank: int = rank) -> float:
                return float(np.sort(np.abs(gain.loci(np.array([f]))[0]))[rank]) - 1.0

            where = float(brentq(height, hertz[one], hertz[one + 1], rtol=1e-13))
            values = gain.loci(np.array([where]))[0]
            value = values[np.abs(values).argsort()[rank]]
            late.append(float(np.angle(-value) % (2 * np.pi)))
            at.append(where)
    return np.array(late), np.array(at)


def first_unstable(radius: Callable[[float], float], factors: Array, none: float) -> float:
    """Return the first of rising or falling factors of the gain at which the loop becomes unstable."""
    last = float(factors[0])
    for factor in map(float, factors[1:]):
        if radius(factor) - 1.0 > _ROUNDING:
            return float(brentq(lambda one: radius(one) - 1.0, last, factor, rtol=1e-10))
        last = factor
    return none
