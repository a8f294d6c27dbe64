"""Margins of a loop gain over frequency, all that is changed changed in all channels alike."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, linear_sum_assignment, minimize_scalar

from wavequake.control.linear import Array
from wavequake.control.robustness.margins import Margins

Complex = NDArray[np.complex128]

# Factors of the gain that are tried, up and down; beyond them a margin does not matter.
_FACTORS = np.geomspace(1.0, 1e3, 150)
_ROUNDING = 1e-9
# Where 1 + gain times an eigenvalue turns farther in a step, or turns are no whole number, poles are counted.
_TURN, _WHOLE = 1.5, 0.2
# An eigenvalue that turns by more between two frequencies is not known there; smaller ones are nothing.
_KNOWN, _TINY = np.radians(60.0), 1e-300
_POINTS = 1500
# From one frequency to the next, as a share of the distance to the nearest pole, and of half the rate.
_GRADED, _WIDEST, _LEAST = 0.05, 0.01, 1e-9
# Eigenvalues whose crossings are followed, and frequencies at which singular values are taken.
_FINE, _TRIED, _EVENLY = 60, 12, 60
# How near the top of a peak is found, as a share of what it lies between.
_FLAT = 1e-7


@dataclass(frozen=True)
class LoopGain:
    """The loop gain -K G at the commands over frequency, in Hz: eigenvalues (f, q) and whole, (q, q)."""

    loci: Callable[[Array], Complex]
    whole: Callable[[float], Complex]


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


def graded_grid(values: Complex, period: float) -> Array:
    """Return rising frequencies up to half the rate of commands, in Hz, close where poles of a period are."""
    high = 0.5 / period
    poles = np.log(values[np.abs(values) > 1e-6]) / period / (2 * np.pi)
    found = [1e-6 * high]
    while found[-1] < high:
        near = float(np.abs(1j * found[-1] - poles).min(initial=np.inf))
        found.append(found[-1] + min(max(_GRADED * near, _LEAST * high), _WIDEST * high))
    return np.array([*found[:-1], high])


def gain_margins(gain: LoopGain, hertz: Array, radius: Callable[[float], float]) -> Margins:
    """Return margins from the loop gain at frequencies and the size of the largest pole by its factor."""
    loci = followed(gain.loci(hertz))
    peak, where = _peak(gain, hertz, loci)
    late, at = _critical(gain, hertz, loci)
    always = np.abs(loci[-1]).max() >= 1.0
    return Margins(
        peak,
        2 * np.pi * where,
        first_unstable(radius, _FACTORS, np.inf, partial(_is_unstable, loci)),
        first_unstable(radius, 1 / _FACTORS, 0.0, partial(_is_unstable, loci)),
        float(np.minimum(late, 2 * np.pi - late).min(initial=np.pi)),
        float((late / (2 * np.pi * at)).min(initial=np.inf)),
        2 * np.pi * float(hertz[-1] if always else at.max(initial=0.0)),
    )


def read_margins(loci: Complex) -> tuple[float, float, Complex]:
    """Read gain and phase margin (rad) off eigenvalues (f, q) of the loop gain of a stable loop.

    Each is followed from frequency to frequency, in between as a logarithmic spiral; where it turns by more
    than 60 degrees, nothing is known. inf and pi: there is none. `gain_margins` follows all poles instead.

    Returns
    -------
    gain_up, phase : float
    critical : ndarray of complex, shape (f, 2)
        The eigenvalue that has the gain margin, and that which has the phase margin; where there is none,
        that which comes nearest to -1.
    """
    known = followed(loci)
    first, last = known[:-1], known[1:]
    turn, angle = np.angle(last * first.conj()), np.angle(-first)
    sizes = np.log(np.maximum(np.abs(known), _TINY))
    low, high = sizes[:-1], sizes[1:]
    small = np.abs(turn) < _KNOWN
    crosses = small & (angle * (angle + turn) <= _ROUNDING) & (np.abs(angle) < _KNOWN) & (turn != 0)
    share = np.clip(-angle[crosses] / turn[crosses], 0.0, 1.0)
    at = (1 - share) * low[crosses] + share * high[crosses]
    up = np.where(at < 0, at, -np.inf)
    meets = small & (low * high <= 0) & (low != high)
    share = low[meets] / (low - high)[meets]
    late = np.abs(np.angle(np.exp(1j * (angle[meets] + share * turn[meets]))))
    nearest = int(np.abs(1.0 + known).min(axis=0).argmin())
    which = [
        int(np.nonzero(found)[1][place.argmin()]) if np.isfinite(place).any() else nearest
        for found, place in ((crosses, -up), (meets, late))
    ]
    return float(np.exp(-up.max(initial=-np.inf))), float(late.min(initial=np.pi)), known[:, which]


def followed(loci: Complex) -> Complex:
    """Return eigenvalues (f, q) in an order in which each follows its predecessor."""
    found = loci.copy()
    if found.shape[1] > 1:
        for before, now in pairwise(found):
            now[:] = now[linear_sum_assignment(np.abs(before[:, None] - now))[1]]
    return found


def _is_unstable(loci: Complex, factor: float) -> bool | None:
    """Return whether a stable loop is unstable with its gain times a factor; None where steps are too wide.

    The determinants of 1 + the gain with and without the factor have a ratio that is finite outside of the
    unit circle, so that it turns about 0 along the circle once for each pole that is outside (the argument
    principle). Half the circle suffices, as it is real at both ends.
    """
    turned = 0.0
    for size, sign in ((factor, 1.0), (1.0, -1.0)):
        values = 1.0 + size * loci
        steps = np.angle(values[1:] / values[:-1])
        if not np.abs(steps).max(initial=0.0) < _TURN:
            return None
        turned += sign * float(steps.sum()) / np.pi
    return None if abs(turned - round(turned)) > _WHOLE else round(turned) != 0


def _peak(gain: LoopGain, hertz: Array, loci: Complex) -> tuple[float, float]:
    """Return the largest singular value of the sensitivity, looked for where eigenvalues peak, and its Hz."""
    sizes = (1.0 / np.abs(1.0 + loci)).max(axis=1)
    # Eigenvalues say where a peak is, but for matrices that are not normal singular values have their own.
    evenly = np.linspace(0, len(hertz) - 1, _EVENLY).astype(int)
    places = np.unique(np.concatenate([np.argsort(-sizes, kind="stable")[:_TRIED], evenly]))
    found = [_sensitivity(gain.whole(float(hertz[one]))) for one in places]
    top = int(np.argmax(found))
    low, high = hertz[places[max(top - 1, 0)]], hertz[places[min(top + 1, len(places) - 1)]]
    near = minimize_scalar(
        lambda at: -_sensitivity(gain.whole(float(at))),
        bounds=(low, high),
        method="bounded",
        options={"xatol": _FLAT * (high - low)},
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


def first_unstable(
    radius: Callable[[float], float],
    factors: Array,
    none: float,
    judge: Callable[[float], bool | None] = lambda factor: None,
) -> float:
    """Return the first of rising or falling factors of the gain at which the loop becomes unstable.

    The first of all where it is unstable from the start. Poles of size 1, as those of integrators that
    nothing sees, do not make it so. What `judge` knows of a
    factor without poles is believed but for the limit itself.
    """
    last = float(factors[0])
    for factor in map(float, factors[1:]):
        known = judge(factor)
        if known is not False and radius(factor) - 1.0 > _ROUNDING:
            before = radius(last)
            if before - 1.0 > _ROUNDING:
                return last if last == factors[0] else first_unstable(radius, factors, none)
            limit = 1.0 if before < 1.0 - _ROUNDING else 1.0 + _ROUNDING
            return float(brentq(lambda one, size: radius(one) - size, last, factor, (limit,), rtol=1e-10))
        last = factor
    return none
