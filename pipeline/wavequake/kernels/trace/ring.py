"""Zernike polynomials over a ring, by recurrences that stay accurate where sums of monomials cancel (NumPy).

With z = u + i v and t = |z|^2 a polynomial of radial degree n = m + 2 k is P_k(t) times the real (cosine) or
imaginary part (sine) of z^m; the P_k of each m are orthogonal and follow from one another.
"""

from functools import lru_cache
from math import sqrt

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Recurrence = tuple[float, tuple[tuple[float, float, float], ...]]


@lru_cache(maxsize=4096)
def ring_recurrence(m: int, count: int, start: float) -> Recurrence:
    """Return P_0 and, for each further P_k up to `count` in all, what leads to it from its predecessors.

    P_k is orthonormal over [start, 1] for the weight t^m / (1 - start), and the triples (center, before,
    norm) mean ``norm P_(k+1) = (t - center) P_k - before P_(k-1)``. They come from Stieltjes' procedure on
    Gauss-Legendre nodes, so many that every inner product is exact up to rounding (Gautschi 2004, "Orthogonal
    Polynomials", section 2.2).
    """
    nodes, weights = np.polynomial.legendre.leggauss(count + m // 2 + 1)
    nodes = start + (1 - start) * (nodes + 1) / 2
    weights = weights / 2 * nodes**m
    first = float(1 / np.sqrt(np.sum(weights)))
    before, now, norm = np.zeros_like(nodes), np.full_like(nodes, first), 0.0
    steps = []
    for _ in range(count - 1):
        center = float(np.sum(weights * nodes * now**2))
        following = (nodes - center) * now - norm * before
        previous, norm = norm, float(np.sqrt(np.sum(weights * following**2)))
        before, now = now, following / norm
        steps.append((center, previous, norm))
    return first, tuple(steps)


def ring_order(degree: int) -> list[tuple[int, int]]:
    """Return degree n and frequency m (negative: sine) in the order in which coefficients are taken.

    The highest frequencies come first, in each of them the cosines before the sines, and of these the highest
    degrees first: the order of Clenshaw's recurrence in t and of Horner's rule in z.
    """
    return [
        (n, sign * m)
        for m in range(degree, -1, -1)
        for sign in ((1, -1) if m else (1,))
        for n in range(degree - (degree - m) % 2, m - 1, -2)
    ]


@lru_cache(maxsize=32)
def ring_steps(degree: int, inner: float) -> tuple[float, ...]:
    """Return the numbers that the kernel's recurrences take in turn, see ``kernels/ring.h``.

    For each frequency m, the highest first: P_0 (times the root of two for m > 0); then, from the highest k
    down, what takes P_k to P_(k+1): slope and value at 0 of its factor, and the share of P_k that P_(k+2)
    loses.
    """
    numbers: list[float] = []
    for m in range(degree, -1, -1):
        first, steps = ring_recurrence(m, (degree - m) // 2 + 1, inner**2)
        numbers.append(first * (sqrt(2.0) if m else 1.0))
        lost = 0.0
        for center, before, norm in reversed(steps):
            numbers += [1.0 / norm, -center / norm, lost]
            lost = before / norm
    return tuple(numbers)


def ring_polynomial(
    degree: int, inner: float, terms: Array, u: Array, v: Array
) -> tuple[Array, Array, Array]:
    """Return a sum of Zernike polynomials over the ring of radii `inner` to 1, and its slopes.

    Parameters
    ----------
    degree : int
        Highest radial degree.
    inner : float
        0 for the circle.
    terms : ndarray, shape (terms, ...)
        Coefficients of polynomials of unit rms, in the order of `ring_order`; broadcast against u and v.
    u, v : ndarray
        Position in outer radii of the ring.
    """
    z, t = u + 1j * v, u * u + v * v
    value, by_z, by_t = (np.zeros(t.shape, dtype=np.complex128) for _ in range(3))
    place = 0
    for m in range(degree, -1, -1):
        first, steps = ring_recurrence(m, (degree - m) // 2 + 1, inner**2)
        count = len(steps) + 1
        cosines = terms[place : place + count][::-1]
        sines = terms[place + count : place + 2 * count][::-1] if m else np.zeros_like(cosines)
        place += 2 * count if m else count
        weights = (cosines - 1j * sines) * (sqrt(2.0) if m else 1.0)
        now, slope = np.full_like(t, first), np.zeros_like(t)
        earlier, earlier_slope = np.zeros_like(t), np.zeros_like(t)
        total, total_slope = weights[0] * now, weights[0] * slope
        for weight, (center, before, norm) in zip(weights[1:], steps, strict=True):
            following = ((t - center) * now - before * earlier) / norm
            following_slope = (now + (t - center) * slope - before * earlier_slope) / norm
            earlier, now, earlier_slope, slope = now, following, slope, following_slope
            total, total_slope = total + weight * now, total_slope + weight * slope
        by_z, by_t, value = by_z * z + value, by_t * z + total_slope, value * z + total
    return value.real, by_z.real + 2.0 * u * by_t.real, 2.0 * v * by_t.real - by_z.imag


def ring_second_derivatives(degree: int, inner: float, u: Array, v: Array) -> Array:
    """Return the second derivatives uu, uv and vv of every polynomial, shape (3, points, terms)."""
    z, t = u + 1j * v, u * u + v * v
    columns: dict[tuple[int, int], Array] = {}
    for m in range(degree + 1):
        scale = sqrt(2.0) if m else 1.0
        power = z ** np.arange(m - 2, m + 3).clip(0)[:, None]  # of z^(m - 2) .. z^(m + 2)
        for k, (value, slope, bend) in enumerate(_derivatives(m, (degree - m) // 2 + 1, inner, t)):
            # F = z^m P(z z*), with z and its conjugate taken for independent
            twice = m * (m - 1) * power[0] * value
            twice = twice + 2 * m * power[1] * np.conj(z) * slope + power[2] * np.conj(z) ** 2 * bend
            mixed = (m + 1) * power[2] * slope + power[3] * np.conj(z) * bend
            conjugate = power[4] * bend
            found = scale * np.stack(
                [twice + 2 * mixed + conjugate, 1j * (twice - conjugate), 2 * mixed - twice - conjugate]
            )
            columns[m + 2 * k, m] = found.real
            if m:
                columns[m + 2 * k, -m] = found.imag
    return np.stack([columns[order] for order in ring_order(degree)], axis=-1)


def _derivatives(m: int, count: int, inner: float, t: Array) -> list[tuple[Array, Array, Array]]:
    """Return P_k and its first two derivatives."""
    first, steps = ring_recurrence(m, count, inner**2)
    none = np.zeros_like(t)
    found = [(np.full_like(t, first), none, none)]
    earlier = (none, none, none)
    for center, before, norm in steps:
        now = found[-1]
        value = ((t - center) * now[0] - before * earlier[0]) / norm
        slope = (now[0] + (t - center) * now[1] - before * earlier[1]) / norm
        bend = (2.0 * now[1] + (t - center) * now[2] - before * earlier[2]) / norm
        found.append((value, slope, bend))
        earlier = now
    return found
