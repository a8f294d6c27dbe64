"""Simple polygons that need not be convex: whether they cross themselves, what they contain, and triangles.

Arrays of corners have the shape (S, V, 2), counter-clockwise; a polygon with fewer than V corners repeats its
last one.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def crossing(corners: Array) -> Mask:
    """Return which polygons (S,) cross or touch themselves, or go back the way they came."""
    start, end = corners, np.roll(corners, -1, axis=1)
    real = (start != end).any(axis=2)
    count, place = real.sum(axis=1), np.cumsum(real, axis=1) - 1
    apart = np.mod(place[:, :, None] - place[:, None], np.maximum(count, 1)[:, None, None])
    both = real[:, :, None] & real[:, None]
    follows = both & (apart == 1)  # the first of the two follows the second
    far = both & (apart > 1) & (apart < count[:, None, None] - 1)
    # Two edges meet if each has an end on either side of the other, or if they overlap in one line.
    from_start, from_end = (_turn(start[:, None], end[:, None], at[:, :, None]) for at in (start, end))
    parted = from_start * from_end > 0.0
    low, high = np.minimum(start, end), np.maximum(start, end)
    beside = ((low[:, :, None] > high[:, None]) | (low[:, None] > high[:, :, None])).any(axis=3)
    meet = far & ~parted & ~np.swapaxes(parted, 1, 2) & ~beside
    along = end - start
    back = follows & (_cross(along[:, None], along[:, :, None]) == 0.0)
    back &= np.sum(along[:, None] * along[:, :, None], axis=3) < 0.0
    return np.asarray((meet | back).any(axis=(1, 2)))


def signed_distance(corners: Array, x: Array, y: Array) -> Array:
    """Return the distance (...) of points to the outlines of polygons (..., V, 2), negative inside."""
    along = np.roll(corners, -1, axis=-2) - corners
    from_x, from_y = x[..., None] - corners[..., 0], y[..., None] - corners[..., 1]
    square = np.sum(along**2, axis=-1)
    part = (from_x * along[..., 0] + from_y * along[..., 1]) / np.where(square > 0.0, square, 1.0)
    part = np.clip(part, 0.0, 1.0)
    nearest = np.hypot(from_x - part * along[..., 0], from_y - part * along[..., 1]).min(axis=-1)
    rises, falls = from_y >= 0.0, np.roll(from_y, -1, axis=-1) >= 0.0
    left = (along[..., 0] * from_y - along[..., 1] * from_x) * along[..., 1] > 0.0
    inside = np.sum((rises != falls) & left, axis=-1) % 2 == 1
    distance: Array = np.where(inside, -nearest, nearest)
    return distance


def triangles(corners: Array) -> Array:
    """Cut simple polygons into triangles (S, V - 2, 3, 2), counter-clockwise, by clipping ears.

    An ear is a corner that points outwards and whose triangle holds no other corner. A repeated corner, or
    one in a straight edge, makes a triangle without area.
    """
    left, cut = corners, []
    while left.shape[1] > 3:
        before, after = np.roll(left, 1, axis=1), np.roll(left, -1, axis=1)
        area = _turn(before, left, after)
        sides = ((before, left), (left, after), (after, before))
        holds = np.ones((*left.shape[:2], left.shape[1]), dtype=np.bool_)
        for first, second in sides:
            holds &= _turn(first[:, :, None], second[:, :, None], left[:, None]) >= 0.0
        for own in (before, left, after):
            holds &= (own[:, :, None] != left[:, None]).any(axis=3)
        # The largest ear leaves few slivers; without one (rounding may hide it) comes the flattest corner.
        rank = np.where(holds.any(axis=2) | (area < 0.0), -np.abs(area) - 1.0, area)
        ear = np.argmax(rank, axis=1)[:, None]
        cut.append(np.stack([_of(points, ear) for points in (before, left, after)], axis=1))
        kept = np.arange(left.shape[1] - 1) + (np.arange(left.shape[1] - 1) >= ear)
        left = np.take_along_axis(left, kept[..., None], axis=1)
    return np.stack([*cut, left], axis=1)


def _of(points: Array, place: NDArray[np.intp]) -> Array:
    return np.take_along_axis(points, place[..., None], axis=1)[:, 0]


def _turn(a: Array, b: Array, c: Array) -> Array:
    """Return twice the area of the triangle a, b, c; negative if it is clockwise."""
    return _cross(b - a, c - a)


def _cross(a: Array, b: Array) -> Array:
    crossed: Array = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return crossed
