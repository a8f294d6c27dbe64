"""Polygons in a plane: areas, edges, insets, overlaps, and which of them a point may lie on.

Arrays of corners have the shape (S, V, 2), counter-clockwise; a polygon with fewer than V corners repeats its
last one. Polygons that are not convex cost more, see `wavequake.optics.shapes.concave`.
"""

import numpy as np
from numpy.typing import NDArray

from wavequake.optics.shapes.concave import signed_distance, triangles

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# mm: dents below this are the rounding of a table in m with six decimals, and the polygon counts as convex.
ROUNDING = 1e-3

_EVERYWHERE = (
    1e9  # right side of 0 x + 0 y <= c: the edge between a repeated corner and itself excludes nothing
)
_BLOCK = 65536  # points per step of the search: bounds the memory, not the result


def signed_areas(corners: Array) -> Array:
    """Return the areas (S,) of simple polygons (S, V, 2), negative if clockwise."""
    x, y = np.moveaxis(corners - corners[:, :1], -1, 0)  # near the origin, so that nothing cancels
    area: Array = 0.5 * np.sum(x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y, axis=1)
    return area


def centroids(corners: Array) -> Array:
    """Return the centroids (S, 2) of polygons (S, V, 2) that have an area."""
    local = corners - corners[:, :1]
    following = np.roll(local, -1, axis=1)
    cross = local[..., 0] * following[..., 1] - following[..., 0] * local[..., 1]
    moment = np.sum((local + following) * cross[..., None], axis=1)
    middle: Array = corners[:, 0] + moment / (3.0 * np.sum(cross, axis=1))[:, None]
    return middle


def edge_lines(corners: Array) -> Array:
    """Return (S, V, 3) half planes: a point is inside where ``a x + b y <= c`` for every edge.

    (a, b) is the outward unit normal of the edge from a corner to the next, so ``a x + b y - c`` is the
    signed distance to its line. An edge of no length becomes ``0 x + 0 y <= 1e9``.
    """
    along = np.roll(corners, -1, axis=1) - corners
    length = np.hypot(along[..., 0], along[..., 1])
    real = length > 0.0
    divisor = np.where(real, length, 1.0)
    a, b = along[..., 1] / divisor, -along[..., 0] / divisor
    c = np.where(real, a * corners[..., 0] + b * corners[..., 1], _EVERYWHERE)
    return np.stack([a, b, c], axis=-1)


def edge_spans(corners: Array) -> Array:
    """Return (S, V, 5): the half plane of each edge (`edge_lines`), its lowest and its highest y.

    A point is inside a polygon, convex or not, if a way from it to +x crosses an odd number of edges: those
    whose span, the highest y excluded, holds y, and which it passes, ``a (a x + b y - c) < 0``.
    """
    following = np.roll(corners, -1, axis=1)
    low, high = (extreme(corners[..., 1], following[..., 1]) for extreme in (np.minimum, np.maximum))
    return np.concatenate([edge_lines(corners), low[..., None], high[..., None]], axis=-1)


def inset(corners: Array, distance: float) -> Array:
    """Move every edge inwards by `distance` and return the new corners (S, V, 2); none may be repeated."""
    a, b, c = np.moveaxis(edge_lines(corners), -1, 0)
    a_before, b_before, c_before = (np.roll(values, 1, axis=1) for values in (a, b, c))
    c, c_before = c - distance, c_before - distance
    determinant = a_before * b - a * b_before
    x = (c_before * b - c * b_before) / determinant
    y = (a_before * c - a * c_before) / determinant
    return np.stack([x, y], axis=-1)


def protrusion(corners: Array) -> Array:
    """Return how far (S,) any corner lies outside another edge's line: above 0, the polygon is not convex."""
    excess = _excess(edge_lines(corners)[:, None], corners[..., 0], corners[..., 1])
    return np.asarray(excess.max(axis=1))


def concave(corners: Array) -> NDArray[np.bool_]:
    """Return which polygons (S,) have a dent that is more than rounding, or cross themselves."""
    if corners.shape[1] == 0:
        return np.zeros(len(corners), dtype=np.bool_)  # a mirror without edges
    return np.asarray(protrusion(corners) > ROUNDING)


def overlapping(corners: Array, tolerance: float) -> Index:
    """Return the pairs (P, 2) of simple polygons that overlap by more than `tolerance`."""
    if not concave(corners).any():
        return _overlapping_convex(corners, tolerance)
    parts = triangles(corners)
    owner = np.repeat(np.arange(len(parts)), parts.shape[1])
    parts = parts.reshape(-1, 3, 2)
    real = signed_areas(parts) > 0.0
    pairs = owner[real][_overlapping_convex(parts[real], tolerance)]
    return np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)


def _overlapping_convex(corners: Array, tolerance: float) -> Index:
    """Return the pairs (P, 2) of convex polygons that overlap by more than `tolerance`.

    Two convex polygons are apart if and only if the line of an edge of one of them separates them.
    """
    table = _Grid(corners, 0.0).table
    low, high = np.triu_indices(table.shape[1], k=1)
    pairs = np.stack([table[:, low].ravel(), table[:, high].ravel()], axis=1)
    pairs = np.unique(np.sort(pairs[(pairs >= 0).all(axis=1)], axis=1), axis=0)
    lines = edge_lines(corners)
    apart = np.full(len(pairs), -np.inf)
    for one, other in (pairs.T, pairs.T[::-1]):
        a, b, c = np.moveaxis(lines[one], -1, 0)[..., None]
        x, y = np.moveaxis(corners[other], -1, 0)[:, :, None, :]
        apart = np.maximum(apart, np.min(a * x + b * y - c, axis=2).max(axis=1, initial=-np.inf))
    return pairs[apart < -tolerance]


def distance_from_origin(corners: Array) -> Array:
    """Return the distance (S,) of the origin to each polygon, 0 inside."""
    if concave(corners).any():
        return np.maximum(signed_distance(corners, np.zeros(len(corners)), np.zeros(len(corners))), 0.0)
    start, along = corners, np.roll(corners, -1, axis=1) - corners
    square = np.sum(along**2, axis=-1)
    part = -np.sum(start * along, axis=-1) / np.where(square > 0.0, square, 1.0)
    nearest = start + np.clip(part, 0.0, 1.0)[..., None] * along
    inside = (edge_lines(corners)[..., 2] >= 0.0).all(axis=1)
    return np.where(inside, 0.0, np.hypot(nearest[..., 0], nearest[..., 1]).min(axis=1))


def polygons_at(corners: Array, x: Array, y: Array, margin: float) -> NDArray[np.int32]:
    """Return which polygons each point lies on, or nearly so.

    The cost grows with the number of points, not with that of points times polygons: a grid of cells over the
    polygons' bounding boxes leaves a few polygons per point to test.

    Parameters
    ----------
    corners : ndarray, shape (S, V, 2)
        Simple polygons.
    x, y : ndarray, shape (N,)
        Points; one that is not finite lies on no polygon.
    margin : float
        Every edge is moved outwards by this distance, which is at least 0. Where a polygon is not convex, the
        distance of points to all outlines counts.

    Returns
    -------
    ndarray of int32, shape (N, C)
        The polygon whose edges are farthest outside the point first, so the one that contains the point; then
        the others in the order of their distance; then -1. C is as small as possible, at least 1.
    """
    outlines, block_size = edge_lines(corners), _BLOCK
    if concave(corners).any():
        outlines, block_size = corners, _BLOCK // 8  # distances to edges take more memory
    grid = _Grid(corners, margin)
    found = np.full((len(x), grid.table.shape[1]), -1, dtype=np.int32)
    for first in range(0, len(x), block_size):
        block = slice(first, first + block_size)
        found[block] = _among(outlines, grid.at(x[block], y[block]), x[block], y[block], margin)
    columns = max(1, int((found >= 0).sum(axis=1).max(initial=0)))
    return np.ascontiguousarray(found[:, :columns])


def _among(outlines: Array, choice: Index, x: Array, y: Array, margin: float) -> Index:
    """Return those polygons of `choice` (N, K) that contain the points, the nearest first and -1 last."""
    finite = np.isfinite(x) & np.isfinite(y)
    x, y = np.where(finite, x, 0.0), np.where(finite, y, 0.0)
    distance = _excess if outlines.shape[-1] == 3 else signed_distance
    excess = distance(outlines[choice], x[:, None], y[:, None])
    hit = (choice >= 0) & finite[:, None] & (excess <= margin)
    order = np.argsort(np.where(hit, excess, np.inf), axis=1, kind="stable")
    return np.take_along_axis(np.where(hit, choice, -1), order, axis=1)


def _excess(lines: Array, x: Array, y: Array) -> Array:
    """Return the largest signed distance of points to the lines of a polygon; `lines` is (..., V, 3)."""
    a, b, c = np.moveaxis(lines, -1, 0)
    excess: Array = np.max(a * x[..., None] + b * y[..., None] - c, axis=-1)
    return excess


class _Grid:
    """Cells over all polygons; ``table`` (cell, K) lists those whose bounding box meets a cell, then -1."""

    def __init__(self, corners: Array, margin: float) -> None:
        low, high = corners.min(axis=1) - margin, corners.max(axis=1) + margin
        self.low, self.high = low.min(axis=0), high.max(axis=0)
        self.count = int(np.ceil(2.0 * np.sqrt(len(corners))))  # a cell is about half as wide as a polygon
        first, last = self._cells(low), self._cells(high)
        width, height = (last - first + 1).T
        covered = width * height
        polygon = np.repeat(np.arange(len(corners)), covered)
        step = np.arange(polygon.size) - np.repeat(np.cumsum(covered) - covered, covered)
        column, row = first[polygon, 0] + step % width[polygon], first[polygon, 1] + step // width[polygon]
        cell = row * self.count + column
        order = np.argsort(cell, kind="stable")
        filling = np.bincount(cell, minlength=self.count**2)
        rank = np.arange(cell.size) - np.repeat(np.cumsum(filling) - filling, filling)
        self.table = np.full((self.count**2, int(filling.max())), -1, dtype=np.int64)
        self.table[cell[order], rank] = polygon[order]

    def _cells(self, points: Array) -> Index:
        scaled = (points - self.low) / (self.high - self.low) * self.count
        cells: Index = np.minimum(scaled.astype(np.int64), self.count - 1)
        return cells

    def at(self, x: Array, y: Array) -> Index:
        """Return the polygons (N, K) to test for each point; for one outside, those of the nearest cell."""
        points = np.nan_to_num(np.stack([x, y], axis=1))
        column, row = self._cells(np.clip(points, self.low, self.high)).T
        return np.asarray(self.table[row * self.count + column])
