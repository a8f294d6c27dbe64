"""Exact Fourier transforms of polygons: the diffraction of one piece of glass."""

from math import factorial

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError

Complex = NDArray[np.complex128]
Real = NDArray[np.float64]

# Below this largest phase (rad) between a corner and the centroid the edge sum cancels: a series takes over.
_SERIES_PHASE = 1.0
# The terms of the series fall as 1/(n + 1)!, so 18 of them reach 1e-17.
_SERIES_TERMS = 18


def polygon_areas(corners: Real) -> Real:
    """Return the areas (S,) of counter-clockwise polygons.

    Parameters
    ----------
    corners : ndarray, shape (S, V, 2)
        Corners in mm; a polygon with fewer than V corners repeats its last one.

    Returns
    -------
    ndarray, shape (S,)
        Areas in mm².

    Raises
    ------
    UserError
        If there is no polygon, a corner is not finite, or a polygon is clockwise or empty.
    """
    corners = np.asarray(corners, dtype=np.float64)
    if corners.ndim != 3 or corners.shape[2] != 2 or not corners.size:
        raise UserError(f"polygons need corners of shape (polygon, corner, 2), not {corners.shape}")
    if not np.isfinite(corners).all():
        bad = int(np.flatnonzero(~np.isfinite(corners).all(axis=(1, 2)))[0])
        raise UserError(f"polygon {bad} has a corner that is not a finite number")
    spokes = corners - corners[:, :1]  # from the first corner: no cancellation far from the origin
    areas = 0.5 * _cross(spokes, np.roll(spokes, -1, axis=1)).sum(axis=1)
    if (areas <= 0.0).any():
        bad = int(np.flatnonzero(areas <= 0.0)[0])
        raise UserError(
            f"polygon {bad} has the area {areas[bad]:g} mm²: its corners must run counter-clockwise"
        )
    return np.asarray(areas)


def polygon_centroids(corners: Real) -> Real:
    """Return the centroids (S, 2) in mm of counter-clockwise polygons; arguments as for `polygon_areas`."""
    areas = polygon_areas(corners)
    spokes = corners - corners[:, :1]
    following = np.roll(spokes, -1, axis=1)
    moments = np.einsum("sv,svk->sk", _cross(spokes, following), spokes + following) / 6.0
    return np.asarray(corners[:, 0] + moments / areas[:, None])


def polygon_transform(corners: Real, fx: Real, fy: Real) -> Complex:
    """Fourier transform of the indicator function of polygons, in closed form.

    The transform is the integral of exp(-2πi f·x) over each polygon. By the divergence theorem it is a sum
    over edges, in which the limit of an edge perpendicular to f is a sinc; the limit of small f is a
    power series whose moments are complete homogeneous polynomials of the corners. Both are written
    about the centroid.

    Parameters
    ----------
    corners : ndarray, shape (S, V, 2)
        Corners in mm, counter-clockwise; a polygon with fewer than V corners repeats its last one.
    fx, fy : ndarray, shape (P,)
        Spatial frequencies in cycles per mm.

    Returns
    -------
    ndarray, shape (P, S), complex
        Transforms in mm²; at f = 0 the areas. The error is about 1e-15 of the area, and that of the phase
        2π f·x of a polygon far from the origin.

    Raises
    ------
    UserError
        If a polygon is clockwise, empty or not finite.
    """
    corners = np.asarray(corners, dtype=np.float64)
    centroids = polygon_centroids(corners)
    local = corners - centroids[:, None]
    kx, ky = 2.0 * np.pi * np.asarray(fx, dtype=np.float64), 2.0 * np.pi * np.asarray(fy, dtype=np.float64)
    reach = np.hypot(local[..., 0], local[..., 1]).max(axis=1)
    small = np.hypot(kx, ky)[:, None] * reach < _SERIES_PHASE
    transform = _edge_sum(local, kx, ky)
    frequency, polygon = np.nonzero(small)
    transform[frequency, polygon] = _series(local[polygon], kx[frequency], ky[frequency])
    cycles = np.outer(fx, centroids[:, 0]) + np.outer(fy, centroids[:, 1])
    return np.asarray(transform * np.exp(-2j * np.pi * (cycles - np.rint(cycles))))


def _cross(a: Real, b: Real) -> Real:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _edge_sum(corners: Real, kx: Real, ky: Real) -> Complex:
    """Sum over edges (P, S): i/k² Σ (k × edge) sinc(k·edge/2) exp(-i k·midpoint)."""
    squared = kx**2 + ky**2
    edges = np.roll(corners, -1, axis=1) - corners
    middles = corners + 0.5 * edges
    total = np.zeros((kx.size, corners.shape[0]), dtype=np.complex128)
    for edge, middle in zip(np.moveaxis(edges, 1, 0), np.moveaxis(middles, 1, 0), strict=True):
        along = np.outer(kx, edge[:, 0]) + np.outer(ky, edge[:, 1])
        across = np.outer(kx, edge[:, 1]) - np.outer(ky, edge[:, 0])
        phase = np.outer(kx, middle[:, 0]) + np.outer(ky, middle[:, 1])
        total += across * np.sinc(along / (2.0 * np.pi)) * np.exp(-1j * phase)
    # f = 0 belongs to the series; any finite number will do here.
    return np.asarray(1j * total / np.where(squared > 0.0, squared, 1.0)[:, None])


def _series(corners: Real, kx: Real, ky: Real) -> Complex:
    """Transform of polygon i at frequency i (N,): triangles from the origin, term by term in powers of k·x.

    The integral of (k·x)^n over the triangle (0, a, b) is 2 A n!/(n+2)! h_n(k·a, k·b), with h_n the
    complete homogeneous polynomial Σ (k·a)^i (k·b)^(n-i).
    """
    following = np.roll(corners, -1, axis=1)
    double_areas = _cross(corners, following)
    a = kx[:, None] * corners[..., 0] + ky[:, None] * corners[..., 1]
    b = np.roll(a, -1, axis=1)
    homogeneous, power = np.ones_like(a), np.ones_like(a)
    total = np.zeros(kx.size, dtype=np.complex128)
    for n in range(_SERIES_TERMS):
        total += (-1j) ** n / factorial(n + 2) * (double_areas * homogeneous).sum(axis=1)
        power = power * b
        homogeneous = a * homogeneous + power
    return total
