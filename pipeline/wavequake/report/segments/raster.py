"""Fill the glass of a segmented aperture with values that are known at rays only."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake.tables import kept

Array = NDArray[np.float64]


def fill_segments(
    corners: Array,
    centers: Array,
    rays: Array,
    segment: NDArray[np.integer],
    values: Array,
    reach: float,
    pixels: int,
) -> Array:
    """Turn values at rays into a picture (pixels, pixels) of the aperture; y first and upwards, NaN off it.

    Within each segment a polynomial of second degree is fitted to its rays (of first degree where they are
    few), and what the fit leaves is taken from the nearest ray: exact at the rays, and everywhere where a
    segment is only moved or curved. Nothing is shared across edges.

    Parameters
    ----------
    corners : ndarray, shape (S, V, 2)
        Counter-clockwise; a polygon of fewer corners repeats its last one.
    centers : ndarray, shape (S, 2)
    rays : ndarray, shape (N, 2)
    segment : ndarray of int, shape (N,)
        Segment of each ray.
    values : ndarray, shape (N,)
    reach : float
        Half width of the picture, in the unit of the corners.
    pixels : int
        Along each side. Pixels up to 1.5 of them outside the glass are filled too: clip the picture to the
        polygons.
    """
    arrays = [one.astype(np.float64).tobytes() for one in (corners, centers, rays)]
    found = _nearest(*arrays, segment.astype(np.int64).tobytes(), corners.shape, reach, pixels)
    points, owner = _points(found.inside, reach, pixels), found.owner
    smooth, left = _fit(rays, values, segment, centers)
    filled = smooth(points, owner) + left[found.ray]
    picture = np.full(pixels * pixels, np.nan)
    picture[found.inside] = np.where(found.ray >= 0, filled, np.nan)
    return picture.reshape(pixels, pixels)


@dataclass(frozen=True)
class _Nearest:
    """Pixels on glass, and of each of them its segment and the nearest ray of that: -1 for none."""

    inside: NDArray[np.int32]
    owner: NDArray[np.int32]
    ray: NDArray[np.int32]


@lru_cache(maxsize=1)
def _nearest(
    corner_bytes: bytes,
    center_bytes: bytes,
    ray_bytes: bytes,
    segment_bytes: bytes,
    shape: tuple[int, int, int],
    reach: float,
    pixels: int,
) -> _Nearest:
    """Return what all maps of an aperture share: those of a report, and on disk those of later reports.

    The bytes of float64 and int64 arrays, and the shape of the corners.
    """
    corners, centers = np.frombuffer(corner_bytes).reshape(shape), np.frombuffer(center_bytes).reshape(-1, 2)
    rays, segment = np.frombuffer(ray_bytes).reshape(-1, 2), np.frombuffer(segment_bytes, np.int64)
    return kept(_Nearest, _nearest_rays, corners, centers, rays, segment, reach, pixels)


def _points(inside: NDArray[np.int32], reach: float, pixels: int) -> Array:
    """Return the points of pixels that are counted by rows."""
    along = ((np.arange(pixels) + 0.5) / pixels * 2.0 - 1.0) * reach
    return np.stack([along[inside % pixels], along[inside // pixels]], axis=-1)


def _nearest_rays(
    corners: Array, centers: Array, rays: Array, segment: NDArray[np.int64], reach: float, pixels: int
) -> _Nearest:
    every = np.arange(pixels * pixels, dtype=np.int32)
    owner = segment_at(_points(every, reach, pixels), corners, centers, margin=3.0 * reach / pixels)
    inside = every[owner >= 0]
    points, owner = _points(inside, reach, pixels), owner[inside]
    best, nearest = np.full(len(points), np.inf), np.full(len(points), -1)
    # A step per ray of a segment, each over all pixels: far cheaper than a search tree per segment.
    for ray in _rays_of_segments(segment, len(corners)).T[:, owner]:
        distance = np.where(
            ray >= 0, (points[:, 0] - rays[ray, 0]) ** 2 + (points[:, 1] - rays[ray, 1]) ** 2, np.inf
        )
        closer = distance < best
        best[closer], nearest[closer] = distance[closer], ray[closer]
    return _Nearest(inside, owner.astype(np.int32), nearest.astype(np.int32))


def segment_at(points: Array, corners: Array, centers: Array, margin: float) -> NDArray[np.intp]:
    """Return the segment that each point lies deepest in, or up to `margin` outside of; -1 for none.

    The three segments with the nearest centers are tried, so polygons should not be much longer than wide.
    """
    count = min(3, len(corners))
    candidates = scipy.spatial.cKDTree(centers).query(points, k=list(range(1, count + 1)))[1]
    sides = np.roll(corners, -1, axis=1) - corners
    length = np.linalg.norm(sides, axis=2)
    # A repeated corner makes a side without length: its normal is zero, and an infinite offset never cuts.
    normal = np.stack([sides[..., 1], -sides[..., 0]], axis=-1) / np.where(length > 0, length, 1.0)[..., None]
    offset = np.where(length > 0, (normal * corners).sum(axis=2), np.inf)
    outside = np.full((len(points), count), -np.inf)
    for side in range(corners.shape[1]):
        across = normal[candidates, side]
        beyond = across[..., 0] * points[:, :1] + across[..., 1] * points[:, 1:] - offset[candidates, side]
        np.maximum(outside, beyond, out=outside)
    best = outside.argmin(axis=1)
    rows = np.arange(len(points))
    return np.where(outside[rows, best] <= margin, candidates[rows, best], -1)


def _fit(
    rays: Array, values: Array, segment: NDArray[np.integer], centers: Array
) -> tuple[Callable[[Array, NDArray[np.integer]], Array], Array]:
    """Return a polynomial per segment, of points and their segments, and what it leaves at the rays.

    Of second degree for segments with twice as many rays as it has terms, else of first; of least norm where
    the rays do not fix it.
    """
    scale = max(float(np.abs(rays - centers[segment]).max(initial=0.0)), 1e-300)
    count = np.bincount(segment, minlength=len(centers))

    def terms(points: Array, owner: NDArray[np.integer]) -> Array:
        x, y = (points - centers[owner]).T / scale
        curved = np.where(count[owner] >= 12, 1.0, 0.0)
        return np.stack([np.ones_like(x), x, y, curved * x * x, curved * x * y, curved * y * y])

    def sums(weights: Array) -> Array:
        return np.asarray(np.bincount(segment, weights, len(centers)), dtype=np.float64)

    basis = terms(rays, segment)
    normal = np.array([[sums(one * other) for other in basis] for one in basis]).transpose(2, 0, 1)
    right = np.array([sums(one * values) for one in basis]).T
    coefficients = (np.linalg.pinv(normal, rcond=1e-10, hermitian=True) @ right[..., None])[..., 0]

    def smooth(points: Array, owner: NDArray[np.integer]) -> Array:
        return np.asarray((terms(points, owner) * coefficients[owner].T).sum(axis=0))

    return smooth, values - smooth(rays, segment)


def _rays_of_segments(segment: NDArray[np.integer], segments: int) -> NDArray[np.intp]:
    """Return the rays of each segment as the rows of a table, filled up with -1."""
    order = np.argsort(segment, kind="stable")
    count = np.bincount(segment, minlength=segments)
    first = np.cumsum(count) - count
    table = np.full((segments, int(count.max(initial=0))), -1)
    table[segment[order], np.arange(len(order)) - first[segment[order]]] = order
    return table
