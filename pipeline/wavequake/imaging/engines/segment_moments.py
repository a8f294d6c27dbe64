"""Fourier transforms of many polygons times monomials on a tensor grid of frequencies."""

from math import factorial

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake.imaging.engines.band_limit import waves
from wavequake.optics.shapes.concave import triangles
from wavequake.optics.shapes.polygons import concave

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

_DIRECTIONS = 24


def exponents(degree: int) -> list[tuple[int, int]]:
    """Return the exponents (a, b) of the monomials x^a y^b up to a total degree, lowest degree first."""
    return [(n - b, b) for n in range(degree + 1) for b in range(n + 1)]


def moments_on_grid(corners: Real, centers: Real, fy: Real, fx: Real, degree: int, scale: float) -> Complex:
    """Integrate ((x - x_s)/scale)^a ((y - y_s)/scale)^b exp(-2πi f·x) over polygons.

    About the middle of a polygon's box a wave is the Legendre series exp(-izt) = Σ (2n+1) (-i)^n j_n(z)
    P_n(t). A moment is then a small bilinear form: Bessel functions that all polygons share, times
    Legendre moments of the polygon, which a Gauss rule gives to rounding.

    Parameters
    ----------
    corners : ndarray, shape (S, V, 2)
        Counter-clockwise corners in mm.
    centers : ndarray, shape (S, 2)
        Centers (x_s, y_s) in mm.
    fy, fx : ndarray, shape (Y,), (X,)
        Frequencies in cycles per mm.
    degree : int
        Largest a + b; the J monomials come in the order of `exponents`.
    scale : float
        Length in mm.

    Returns
    -------
    ndarray, shape (Y * X, J, S), complex
        Moments in mm².
    """
    low, high = corners.min(axis=1), corners.max(axis=1)
    middle, box = 0.5 * (low + high), 0.5 * float((high - low).max())
    reach = float(np.hypot(*np.moveaxis(corners - middle[:, None], -1, 0)).max())
    highest = float(np.abs(fx).max()), float(np.abs(fy).max())
    order = _bessel_order(2.0 * np.pi * box * max(highest))
    total_order = _bessel_order(2.0 * np.pi * reach * float(np.hypot(*highest)))
    # One rule for all degrees: the lower moments then have the same bits in every basis.
    points, weights = gauss_rule(corners, total_order // 2 + 6)
    local = (points - middle[:, None]) / box
    legendre_x, legendre_y = (
        np.ascontiguousarray(np.polynomial.legendre.legvander(local[..., axis], order)) for axis in (0, 1)
    )
    x, y = np.moveaxis((points - centers[:, None]) / scale, -1, 0)
    legendre_moments = np.stack(
        [
            legendre_y.swapaxes(1, 2) @ (legendre_x * (weights * x**a * y**b)[..., None])
            for a, b in exponents(degree)
        ]
    )
    series_y, series_x = (_bessel_series(2.0 * np.pi * box * f, order) for f in (fy, fx))
    transform = (series_y @ legendre_moments) @ series_x.T  # (J, S, Y, X)
    transform *= waves(fy, middle[:, 1]).T[:, :, None] * waves(fx, middle[:, 0]).T[:, None, :]
    return np.moveaxis(transform.reshape(*transform.shape[:2], -1), 2, 0)


def largest_means(corners: Real, centers: Real, degree: int) -> Real:
    """Integrate |2π e·(x - x_s)|^(n+1) / (n+1)! over polygons for the unit vector e that makes it largest.

    Times |slope|^(n+1), slope in waves per mm, this bounds the end of the series of exp(iφ) after degree n.

    Returns
    -------
    ndarray, shape (degree // 2 + 1, S)
        For n = 0, 2, ..., degree; in mm² mm^(n+1).
    """
    points, weights = glass_rule(corners, 6)
    angles = np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS
    unit = np.stack([np.cos(angles), np.sin(angles)])
    power = 2.0 * np.pi * np.abs((points - centers[:, None]) @ unit)
    squared = power**2
    rows = []
    for n in range(0, degree + 1, 2):
        # At worst the largest direction lies midway between two of those tried.
        gap = np.cos(0.5 * np.pi / _DIRECTIONS) ** (n + 1)
        rows.append((weights[..., None] * power).sum(axis=1).max(axis=1) / (factorial(n + 1) * gap))
        power = power * squared
    return np.stack(rows)


def gauss_rule(corners: Real, count: int) -> tuple[Real, Real]:
    """Points (S, Q, 2) and weights (S, Q) that integrate polynomials of degree 2 count - 2 over polygons.

    A polygon is a fan of (signed) triangles about a point inside; each is a collapsed square.
    """
    t, w = np.polynomial.legendre.leggauss(count)
    t, w = 0.5 * (t + 1.0), 0.5 * w
    middle = corners.mean(axis=1, keepdims=True)
    a, b = corners - middle, np.roll(corners, -1, axis=1) - middle
    double_areas = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    across = a[:, :, None] + t[:, None] * (b - a)[:, :, None]  # (S, V, count, 2)
    points = middle[:, None, None] + t[:, None, None] * across[:, :, None]  # (S, V, count, count, 2)
    weights = double_areas[:, :, None, None] * np.outer(w * t, w)
    return points.reshape(len(corners), -1, 2), weights.reshape(len(corners), -1)


def glass_rule(corners: Real, count: int) -> tuple[Real, Real]:
    """Points and weights as of `gauss_rule`, all of them on the polygons and none negative."""
    if not concave(corners).any():
        return gauss_rule(corners, count)
    parts = triangles(corners)
    points, weights = gauss_rule(parts.reshape(-1, 3, 2), count)
    return points.reshape(len(corners), -1, 2), np.maximum(weights.reshape(len(corners), -1), 0.0)


def _bessel_order(z: float) -> int:
    """Return the smallest order after which (2n+1) j_n(z) is below 1e-17."""
    n = np.arange(int(z) + 60)
    return int(np.flatnonzero((2 * n + 1) * np.abs(scipy.special.spherical_jn(n, z)) > 1e-17)[-1]) + 1


def _bessel_series(z: Real, order: int) -> Complex:
    n = np.arange(order + 1)
    return np.asarray((2 * n + 1) * (-1j) ** n * scipy.special.spherical_jn(n, z[:, None]))
