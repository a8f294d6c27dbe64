"""Segments that are mirror images of each other in x or y, and fields by their parities.

A real function's transform parts into four: even or odd in f_x, even or odd in f_y. The even-even and odd-odd
parts are real, the other two imaginary. Where a pupil is a mirror image of itself, its segments' twins share
these parts but for signs, so that their factors are added before the transform: a quarter of the products.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]
Floating = NDArray[np.float32] | NDArray[np.float64]

# Whether a part is odd in (f_x, f_y); the first two are real, the last two imaginary.
_PARITIES = np.array([(0, 0), (1, 1), (1, 0), (0, 1)])
# Twins: itself, its image in x (x -> -x), in y, in both.
_IMAGES = np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
# Corners are mirror images if nothing is off by more than this share of the pupil: rounding.
_ROUNDING = 1e-13


@dataclass(frozen=True)
class Twins:
    """Which segments share a transform.

    Attributes
    ----------
    segment : ndarray of int, shape (4, R)
        A segment that represents its twins, then its images in x, in y and in both.
    share : ndarray, shape (4, R)
        What each counts: a segment on an axis is its own image, and 0 stands where pupils have no such twins.
    """

    segment: NDArray[np.intp]
    share: Real


def lone(segments: int) -> Twins:
    """Return the twins of segments that have none."""
    share = np.zeros((4, segments))
    share[0] = 1.0
    return Twins(np.tile(np.arange(segments), (4, 1)), share)


def find_twins(corners: Real, centers: Real) -> Twins:
    """Find which polygons are mirror images in the axes through the origin, in x, y, both or neither.

    Parameters
    ----------
    corners : ndarray, shape (S, V, 2)
        Corners in mm; a polygon with fewer than V corners repeats one.
    centers : ndarray, shape (S, 2)
        Points that must be mirror images, too.

    Returns
    -------
    Twins
        An axis counts if every polygon has an image in it.
    """
    count = len(corners)
    here = np.arange(count)
    rounding = _ROUNDING * float(np.abs(corners).max())
    images = [_images(corners, centers, np.array(turn), rounding) for turn in ((-1.0, 1.0), (1.0, -1.0))]
    in_x, in_y = (here if image is None else image for image in images)
    segment = np.stack([here, in_x, in_y, in_x[in_y]])
    first = segment.min(axis=0) == here
    share = np.ones((4, count))
    for image, rows in zip(images, ([1, 3], [2, 3]), strict=True):
        if image is None:
            share[rows] = 0.0
    segment, share = segment[:, first], share[:, first]
    same = (segment[:, None] == segment) & (share > 0.0)
    return Twins(segment, np.where(share > 0.0, 1.0 / same.sum(axis=1), 0.0))


def parts_of(upper: NDArray[np.complex128]) -> Real:
    """Part the transform of a real function by parity.

    Parameters
    ----------
    upper : ndarray, shape (Y, 2 X, ...), complex
        Its values at frequencies f_y > 0 and, along axis 1, symmetric f_x in ascending order.

    Returns
    -------
    ndarray, shape (4, Y, X, ...)
        At f_x > 0: the even-even and odd-odd part, and the imaginary parts of what is odd in x, and in y.
    """
    middle = upper.shape[1] // 2
    right, left = upper[:, middle:], upper[:, middle - 1 :: -1]
    return np.asarray(
        0.5
        * np.stack(
            [right.real + left.real, right.real - left.real, right.imag - left.imag, right.imag + left.imag]
        )
    )


def fold(twins: Twins, powers: NDArray[np.intp], factors: Floating) -> Floating:
    """Add what twins count, with the signs of each part.

    Parameters
    ----------
    twins : Twins
    powers : ndarray of int, shape (J, 2)
        Powers of x and y of the moments.
    factors : ndarray, shape (J, S, n)
        What the moments of each segment count.

    Returns
    -------
    ndarray, shape (4 or 1, J * R, n)
        For every part, or for all alike where nothing has a twin.
    """
    moments, _, width = factors.shape
    if not twins.share[1:].any():
        return factors.reshape(1, -1, width)
    odd = (powers[:, None, None] + _PARITIES[:, None]) * _IMAGES  # (J, parts, images, 2)
    signs = (1.0 - 2.0 * (odd.sum(axis=-1) % 2)).astype(factors.dtype)
    each = np.multiply(factors[:, twins.segment], twins.share[..., None], dtype=factors.dtype)
    added = signs @ each.reshape(moments, 4, -1)
    return np.ascontiguousarray(added.swapaxes(0, 1)).reshape(4, -1, width)


def unfold(parts: Floating) -> Floating:
    """Put the field of complex factors together.

    Parameters
    ----------
    parts : ndarray, shape (4, Y, X, 2, n)
        Every part times its factors: real and imaginary parts of these.

    Returns
    -------
    ndarray, shape (2 Y, 2 X, 2, n)
        Real and imaginary parts at all frequencies, ascending.
    """
    even, both, *imaginary = parts
    in_x, in_y = (np.stack([-one[:, :, 1], one[:, :, 0]], axis=2) for one in imaginary)
    rows, columns = even.shape[:2]
    field = np.empty((2 * rows, 2 * columns, *even.shape[2:]), dtype=parts.dtype)
    same, other = even + both, even - both
    along, across = in_x + in_y, in_y - in_x
    field[rows:, columns:] = same + along
    field[rows - 1 :: -1, columns - 1 :: -1] = same - along
    field[rows:, columns - 1 :: -1] = other + across
    field[rows - 1 :: -1, columns:] = other - across
    return field


def _images(corners: Real, centers: Real, turn: Real, rounding: float) -> NDArray[np.intp] | None:
    """Return which polygon is the mirror image of each; none if one has no image."""
    middles = corners.mean(axis=1)
    image = _nearest(middles * turn, middles)
    if not np.array_equal(np.sort(image), np.arange(len(corners))):
        return None
    if np.abs(centers * turn - centers[image]).max() > rounding:
        return None
    apart = (corners * turn)[:, :, None] - corners[image][:, None]  # (S, V, V, 2)
    near = np.abs(apart).max(axis=-1) <= rounding
    return image if near.any(axis=1).all() and near.any(axis=2).all() else None


def _nearest(points: Real, others: Real) -> NDArray[np.intp]:
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(others).query(points)[1], dtype=np.intp)
