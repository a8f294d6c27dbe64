"""Figures of segments: where a segment's polynomials are, and its glass as triangles that can bend."""

import numpy as np
from numpy.typing import NDArray

from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.systems.system import OpticalSystem

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_FINE = 100  # segments; more of them have fewer triangles each


def segment_radii(system: OpticalSystem) -> Array:
    """Return the radius of each segment's circumscribed circle; a mirror without corners fills the pupil."""
    segments = system.segments
    if segments.corners.shape[1] == 0:
        return np.full(len(segments), system.annulus.outer)
    radii: Array = np.linalg.norm(segments.corners - segments.centers[:, None, :2], axis=2).max(axis=1)
    return radii


def figure_frames(system: OpticalSystem) -> Array:
    """Return centers (mm) and directions of the local x axis over the radius, projected along z, (S, 4)."""
    segments = system.segments
    along = segments.axes[:, :2, 0]
    along = along / np.linalg.norm(along, axis=1, keepdims=True) / segment_radii(system)[:, None]
    return np.concatenate([segments.centers[:, :2], along], axis=1)


def figure_terms(system: OpticalSystem, segment: Integers, points: Array, terms: int) -> Array:
    """Return the circular Noll polynomials of segments' figures at points of the aperture.

    Parameters
    ----------
    system : OpticalSystem
    segment : ndarray of int, shape (N,)
        Whose figure.
    points : ndarray, shape (N, 2)
        x and y in mm.
    terms : int

    Returns
    -------
    ndarray, shape (N, terms)
        Heights along the segment's normal per unit of each coefficient.
    """
    frames = figure_frames(system)[segment]
    x, y = (points - frames[:, :2]).T
    a, b = frames[:, 2:].T
    return annular_zernike(a * x + b * y, a * y - b * x, terms)


def glass_triangles(system: OpticalSystem, finer: int = 1) -> tuple[Array, Integers, Integers]:
    """Return the segments as triangles that follow figures of low degree.

    Parameters
    ----------
    system : OpticalSystem
    finer : int
        So many times as many along each edge as moving pictures can take.

    Returns
    -------
    points : ndarray, shape (V, 2)
        x and y in mm; those of a segment follow each other.
    faces : ndarray of int, shape (F, 3)
    segment : ndarray of int, shape (V,)
        Whose point each is.
    """
    corners, centers = system.segments.corners, system.segments.centers[:, :2]
    count, size = corners.shape[:2]
    parts = finer * (3 if count <= _FINE else 2)
    # Each sector, from the center to two neighboring corners, in parts^2 triangles.
    steps = [(i, j) for i in range(parts + 1) for j in range(parts + 1 - i)]
    number = {step: place for place, step in enumerate(steps)}
    small = [
        [number[i, j], number[i + 1, j], number[i, j + 1]] for i in range(parts) for j in range(parts - i)
    ] + [
        [number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]]
        for i in range(parts - 1)
        for j in range(parts - 1 - i)
    ]
    first, second = (np.array(steps, dtype=np.float64).T / parts)[:, :, None]
    middle = centers[:, None, None]
    one, other = corners - centers[:, None], np.roll(corners, -1, axis=1) - centers[:, None]
    points = middle + first * one[:, :, None] + second * other[:, :, None]
    sectors = len(steps) * np.arange(count * size)
    faces = (sectors[:, None, None] + np.array(small)).reshape(-1, 3)
    return points.reshape(-1, 2), faces, np.repeat(np.arange(count), size * len(steps))
