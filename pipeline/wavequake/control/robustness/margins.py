"""Sensitivity, margins and certificate of a loop over frequency, on a grid that knows its resonances.

A mode of a light structure is as narrow as it is damped. The grid has points about the pole of every mode,
of the controller and of the loop at the scale of its own distance from the imaginary axis, and is refined
until the eigenvalues of the loop gain move by small steps.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from wavequake.control.linear import Array
from wavequake.control.robustness.feedback import Loop
from wavequake.control.robustness.plant import Complex, transfer, truncation_bound

# Points about a pole, in distances from the axis; points per decade between poles.
_ABOUT = np.array([0.0, 0.12, 0.3, 0.5, 0.75, 1.0, 1.4, 2.0, 3.0, 5.0, 9.0, 20.0, 60.0])
_PER_DECADE = 120
# Eigenvalues that move farther in a step, as a share of their distance from -1, are followed more closely.
_STEP, _SMALL, _PASSES, _MOST = 0.3, 0.05, 12, 60_000
# Eigenvalues whose imaginary part is a smaller share than this are real.
_REAL = 1e-9
# Peaks of the sensitivity that are followed to their tops.
_TOPS = 5
_BLOCK = 128


@dataclass(frozen=True)
class Margins:
    """How far a stable loop is from an unstable one; all channels change alike.

    Attributes
    ----------
    peak, peak_omega : float
        Largest singular value of the sensitivity (I + G H)^-1 over frequency, and where.
    gain_up, gain_down : float
        Factors of the loop gain at which it becomes unstable: the smallest above 1 (inf: none), the largest
        below (0: none).
    phase : float
        Smallest phase at which it becomes unstable, rad, at most pi.
    delay : float
        Smallest delay that does so; inf where the gain is below 1 everywhere.
    last_omega : float
        Highest frequency at which the largest singular value of the loop gain reaches 1; 0: nowhere.
    """

    peak: float
    peak_omega: float
    gain_up: float
    gain_down: float
    phase: float
    delay: float
    last_omega: float


def grid(loop: Loop, poles: Complex) -> Array:
    """Return rising angular frequencies that resolve every pole of a loop.

    Parameters
    ----------
    loop : Loop
    poles : ndarray of complex
        Of the closed loop.
    """
    centers = np.concatenate([poles, loop.plant.poles, np.linalg.eigvals(loop.controller.a)])
    centers = centers[centers.imag >= 0]
    # A pole that another one covers asks for no points of its own.
    order = np.lexsort((np.abs(centers.real), centers.imag))
    centers = centers[order]
    away = np.abs(np.diff(centers)) > 1e-3 * np.abs(centers[1:].real)
    centers = centers[np.concatenate([[True], away])]
    about = np.concatenate([-_ABOUT[:0:-1], _ABOUT])
    points = (centers.imag[:, None] + np.abs(centers.real)[:, None] * about).ravel()
    sizes = np.abs(centers)[np.abs(centers) > 0]
    low, high = 1e-3 * sizes.min(), 30 * sizes.max()
    between = np.geomspace(low, high, int(_PER_DECADE * np.log10(high / low)) + 2)
    return np.unique(np.concatenate([points[(points > low) & (points < high)], between]))


def controller_transfer(loop: Loop, s: Complex) -> Complex:
    """Return the controller's transfer matrices (f, p, m) at complex frequencies (f,).

    By the triangular matrix of its Schur form at many frequencies at once, and one step of refinement: beside
    a narrow pole rounding of the Schur form, which knows no zeros, is forty times that of a solution with A.
    """
    own = loop.controller
    if len(s) == 1:
        one = own.c @ np.linalg.solve(s[0] * np.eye(len(own.a)) - own.a, own.b.astype(complex))
        return np.asarray(one, dtype=np.complex128)[None]
    vectors = loop.triangular[1]
    turned = vectors.conj().T
    found = []
    for first in range(0, len(s), _BLOCK):
        some = s[first : first + _BLOCK]
        shape = len(own.a), len(some), own.b.shape[1]
        states = np.zeros(shape, dtype=np.complex128)
        for _ in range(2):
            left = own.b[:, None] - some[:, None] * states + _times(own.a, states)
            states = states + _times(vectors, _solved(loop.triangular[0], some, _times(turned, left)))
        found.append(np.moveaxis(_times(own.c, states), 0, 1))
    return np.concatenate(found)


def _times(matrix: Array | Complex, states: Complex) -> Complex:
    found: Complex = matrix @ states.reshape(len(states), -1)
    return found.reshape(len(found), *states.shape[1:])


def _solved(triangular: Complex, s: Complex, given: Complex) -> Complex:
    """Return (s - T)^-1 of what is given (n, f, p), by back substitution."""
    found = np.empty_like(given)
    flat = found.reshape(len(given), -1)
    for k in reversed(range(len(given))):
        driven = triangular[k, k + 1 :] @ flat[k + 1 :]
        found[k] = (given[k] + driven.reshape(len(s), -1)) / (s - triangular[k, k])[:, None]
    return found


def loop_gain(loop: Loop, omega: Array) -> Complex:
    """Return G H at angular frequencies (f,), shape (f, m, m)."""
    s = _on_axis(omega)
    return np.asarray(transfer(loop.plant, s) @ controller_transfer(loop, s))


def _on_axis(omega: Array) -> Complex:
    return np.asarray(1j * omega, dtype=np.complex128)


def truncation_share(loop: Loop, omega: Array) -> float:
    """Return the certificate that modes which the plant leaves out change the number of unstable poles not.

    It is the largest |H (I + G H)^-1| times the bound of what the plant lacks; below 1 the Nyquist curves of
    the two go around the same number of times, because they never differ by as much as their distance from
    -1 (the truncated modes decay). Modes between two points of the grid are covered as far as it resolves
    all poles of the loop.
    """
    s = _on_axis(omega)
    bound = truncation_bound(loop.plant, s)
    if not bound.any():
        return 0.0
    h = controller_transfer(loop, s)
    unit = np.eye(len(loop.plant.outputs))
    answer = h @ np.linalg.inv(np.asarray(unit + transfer(loop.plant, s) @ h))
    return float((np.linalg.norm(answer, 2, axis=(1, 2)) * bound).max())


def margins(loop: Loop, omega: Array) -> Margins:
    """Return the margins of a stable loop.

    Parameters
    ----------
    loop : Loop
    omega : ndarray, shape (f,)
        As `grid` gives them.
    """
    omega, gain, loci = _followed(loop, omega)
    up, down = _gain_factors(loop, omega, loci)
    phase, delay = _phases(loop, omega, loci)
    peak, where = _peak(loop, omega, gain)
    reaches = np.flatnonzero(np.linalg.norm(gain, 2, axis=(1, 2)) >= 1.0)
    last = float(omega[reaches[-1]]) if len(reaches) else 0.0
    return Margins(peak, where, up, down, phase, delay, last)


def curves(loop: Loop, omega: Array) -> tuple[Complex, Array, Array]:
    """Return a loop at angular frequencies (f,).

    Returns
    -------
    loci : ndarray of complex, shape (f, m)
        Eigenvalues of the loop gain, each as near as can be to its predecessor.
    sensitivity, complementary : ndarray, shape (f,)
        Largest singular values of S = (I + G H)^-1 and of T = I - S.
    """
    gain = loop_gain(loop, omega)
    loci = _sorted(np.asarray(np.linalg.eigvals(gain), dtype=np.complex128))
    rest = np.linalg.norm(np.linalg.solve(np.eye(gain.shape[1]) + gain, gain), 2, axis=(1, 2))
    return loci, _sensitivity(gain), np.asarray(rest)


def _followed(loop: Loop, omega: Array) -> tuple[Array, Complex, Complex]:
    """Return frequencies, loop gains (f, m, m) and their eigenvalues (f, m), each a smooth curve."""
    gain = loop_gain(loop, omega)
    for _ in range(_PASSES):
        loci = _sorted(np.asarray(np.linalg.eigvals(gain), dtype=np.complex128))
        steps, apart, sizes = np.abs(np.diff(loci, axis=0)), np.abs(1 + loci), np.abs(loci)
        far = steps > _STEP * np.minimum(apart[1:], apart[:-1])
        wide = (far & (np.maximum(sizes[1:], sizes[:-1]) > _SMALL)).any(axis=1)
        if not wide.any() or len(omega) + wide.sum() > _MOST:
            break
        between = (omega[1:] + omega[:-1])[wide] / 2
        order = np.argsort(np.concatenate([omega, between]))
        omega = np.concatenate([omega, between])[order]
        gain = np.concatenate([gain, loop_gain(loop, between)])[order]
    return omega, gain, loci


def _sorted(values: Complex) -> Complex:
    """Return eigenvalues (f, m) in an order in which each follows its predecessor."""
    count = values.shape[1]
    away = np.abs(values[1:, None, :] - values[:-1, :, None])
    nearest = away.argmin(axis=2)
    # Where each has a nearest one of its own, that follows it, whatever the order in which they choose.
    alone = (np.sort(nearest, axis=1) == np.arange(count)).all(axis=1)
    orders = [list(range(count))]
    for place, (follows, apart) in enumerate(zip(nearest.tolist(), alone.tolist(), strict=True)):
        if apart:
            orders.append([follows[one] for one in orders[-1]])
            continue
        left, chosen = list(range(count)), []
        for one in orders[-1][:-1]:
            row = away[place, one]
            near = min(left, key=lambda at, row=row: float(row[at]))  # type: ignore[misc]
            left.remove(near)
            chosen.append(near)
        orders.append([*chosen, *left])
    return np.take_along_axis(values, np.array(orders), axis=1)


def _crossings(
    loop: Loop, omega: Array, loci: Complex, level: Callable[[Complex], Array]
) -> Iterator[tuple[float, complex]]:
    """Yield the frequencies at which a real function of an eigenvalue changes sign, and the eigenvalue."""
    signs = np.sign(level(loci))
    for place, column in zip(*np.nonzero(signs[1:] != signs[:-1]), strict=True):
        low, high = omega[place], omega[place + 1]
        one, two = loci[place, column], loci[place + 1, column]

        def between(
            at: float, low: float = low, high: float = high, one: complex = one, two: complex = two
        ) -> complex:
            if at in (low, high):
                return one if at == low else two
            values = np.linalg.eigvals(loop_gain(loop, np.array([at]))[0])
            expected = one + (two - one) * (at - low) / (high - low)
            return complex(values[np.abs(values - expected).argmin()])

        def height(at: float, between: Callable[[float], complex] = between) -> float:
            return float(level(np.array([between(at)]))[0])

        if height(low) * height(high) < 0:
            at = float(brentq(height, low, high, rtol=1e-13))
            yield at, between(at)


def _gain_factors(loop: Loop, omega: Array, loci: Complex) -> tuple[float, float]:
    """Return the factors at which an eigenvalue of the loop gain would pass through -1."""
    found = [value.real for _, value in _crossings(loop, omega, loci, np.imag) if value.real < 0]
    resting = np.abs(np.linalg.eigvals(loop.controller.a)).min(initial=np.inf) > 0 < loop.plant.squared.min()
    if resting:  # at rest the loop gain is real then: a pole can leave through the origin
        still = np.linalg.eigvals(loop_gain(loop, np.zeros(1))[0])
        found += [value.real for value in still if value.real < 0 and abs(value.imag) < _REAL * abs(value)]
    factors = -1.0 / np.array(found)
    return float(factors[factors > 1].min(initial=np.inf)), float(factors[factors <= 1].max(initial=0.0))


def _phases(loop: Loop, omega: Array, loci: Complex) -> tuple[float, float]:
    """Return the smallest phase, and the smallest delay, that take an eigenvalue of size 1 to -1."""
    found = [*_crossings(loop, omega, loci, lambda values: np.abs(values) - 1.0)]
    # By how much such an eigenvalue may turn backward before it is -1; turning forward takes the rest.
    late = np.array([np.angle(-value) % (2 * np.pi) for _, value in found])
    delays = late / np.array([at for at, _ in found])
    return (
        float(np.minimum(late, 2 * np.pi - late).min(initial=np.pi)),
        float(delays.min(initial=np.inf)),
    )


def _peak(loop: Loop, omega: Array, gain: Complex) -> tuple[float, float]:
    """Return the largest singular value of the sensitivity, followed to the top of the highest ones."""
    sizes = _sensitivity(gain)
    inner = (sizes[1:-1] >= sizes[:-2]) & (sizes[1:-1] >= sizes[2:])
    tops = np.flatnonzero(inner) + 1
    tops = tops[np.argsort(-sizes[tops])][:_TOPS]
    best, where = float(sizes.max()), float(omega[sizes.argmax()])
    for top in tops:
        found = minimize_scalar(
            lambda at: -float(_sensitivity(loop_gain(loop, np.array([at])))[0]),
            bounds=(omega[top - 1], omega[top + 1]),
            method="bounded",
            options={"xatol": 1e-9 * omega[top]},
        )
        if -found.fun > best:
            best, where = float(-found.fun), float(found.x)
    return best, where


def _sensitivity(gain: Complex) -> Array:
    unit = np.eye(gain.shape[1])
    found: Array = np.linalg.norm(np.linalg.inv(unit + gain), 2, axis=(1, 2))
    return found
