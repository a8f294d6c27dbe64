"""How much of each cell of a grid polygons cover, and where in it: exact areas and first moments."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.imaging.pupils.outlines import Outline

Real = NDArray[np.float64]
Index = NDArray[np.intp]

# Cells that are covered less than this hold rounding, not light.
_DARK = 1e-10


@dataclass(frozen=True)
class Patches:
    """The parts of cells that hold light, one for every piece and cell.

    Attributes
    ----------
    cells : ndarray of int, shape (m,)
        Index in the flat grid; rows are y.
    share : ndarray, shape (m,)
        Area in units of a cell.
    x, y : ndarray, shape (m,)
        Centroid, in cells from the grid's corner.
    piece : ndarray of int, shape (m,)
    """

    cells: Index
    share: Real
    x: Real
    y: Real
    piece: Index


def coverage(outline: Outline, samples: int) -> Patches:
    """Return which parts of the cells [i, i + 1] x [j, j + 1] of a square grid an outline covers.

    With w = x - i clipped to a cell, the area of a polygon in the cell is, by Green's theorem, the integral
    of w dy around the polygon; moments likewise. Edges are cut where they cross the grid. Each cut gives its
    integral to its own cell, and to all cells before it in the row that of w = 1.

    Parameters
    ----------
    outline : Outline
        Corners in units of a cell, from the grid's corner.
    samples : int
        Cells along the grid.

    Raises
    ------
    UserError
        If the outline reaches beyond the grid.
    """
    corners = outline.corners
    slack = 1e-6 * samples  # the polygon that has a circle's area passes it by 2e-7
    if not (corners.min() >= -slack and corners.max() <= samples + slack):
        raise UserError(
            f"the pupil reaches beyond its grid, which spans 2 radii from -1 to 1, to "
            f"{np.abs(2.0 * corners / samples - 1.0).max():.6g} radii; give the diameter that encloses it"
        )
    start, end, polygon = _cut(np.clip(corners, 0.0, samples))
    piece = outline.piece[polygon]
    row, column = (
        np.minimum(np.floor(0.5 * (start[:, axis] + end[:, axis])).astype(np.intp), samples - 1)
        for axis in (1, 0)
    )
    pieces = int(outline.piece.max()) + 1
    low_row, low_column = (np.full(pieces, samples) for _ in range(2))
    np.minimum.at(low_row, piece, row)
    np.minimum.at(low_column, piece, column)
    height = int((row - low_row[piece]).max(initial=0)) + 1
    width = int((column - low_column[piece]).max(initial=0)) + 1
    place = (piece * height + row - low_row[piece]) * width + column - low_column[piece]
    weight = outline.sign[polygon] * (end[:, 1] - start[:, 1])
    w0, w1 = start[:, 0] - column, end[:, 0] - column
    z0, z1 = (point[:, 1] - row - 0.5 for point in (start, end))
    own = (
        0.5 * (w0 + w1),
        (w0 * w0 + w0 * w1 + w1 * w1) / 6.0 - 0.25 * (w0 + w1),
        (2.0 * (w0 * z0 + w1 * z1) + w0 * z1 + w1 * z0) / 6.0,
    )
    before = (np.ones_like(w0), np.zeros_like(w0), 0.5 * (z0 + z1))
    shape = (pieces, height, width)
    area, moment_x, moment_y = (
        _accumulated(place, weight * here, weight * there, shape)
        for here, there in zip(own, before, strict=True)
    )
    lit = np.nonzero(area > _DARK)
    rows, columns = low_row[lit[0]] + lit[1], low_column[lit[0]] + lit[2]
    share = area[lit]
    return Patches(
        cells=rows * samples + columns,
        share=share,
        x=columns + 0.5 + moment_x[lit] / share,
        y=rows + 0.5 + moment_y[lit] / share,
        piece=lit[0],
    )


def _accumulated(place: Index, own: Real, before: Real, shape: tuple[int, int, int]) -> Real:
    """Sum what cuts give to their own cells and to the cells before them."""
    size = shape[0] * shape[1] * shape[2]
    total = np.bincount(place, before, size).reshape(shape)
    further = np.cumsum(total[..., ::-1], axis=-1)[..., ::-1] - total
    return np.asarray(further + np.bincount(place, own, size).reshape(shape))


def _cut(corners: Real) -> tuple[Real, Real, Index]:
    """Cut edges of polygons where they cross lines of the grid; return ends (C, 2) and the polygons."""
    following = np.roll(corners, -1, axis=1)
    polygon, _ = real = np.nonzero((following != corners).any(axis=2))
    start, end = corners[real], following[real]
    edges, shares = [np.arange(len(start))] * 2, [np.zeros(len(start)), np.ones(len(start))]
    for axis in (0, 1):
        low, high = np.minimum(start, end)[:, axis], np.maximum(start, end)[:, axis]
        first = np.floor(low) + 1.0
        count = np.maximum(np.ceil(high) - first, 0.0).astype(np.intp)
        edge = np.repeat(np.arange(len(start)), count)
        line = first[edge] + (np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count))
        edges.append(edge)
        shares.append((line - start[edge, axis]) / (end[edge, axis] - start[edge, axis]))
    edge, share = np.concatenate(edges), np.concatenate(shares)
    order = np.lexsort((share, edge))
    edge, share = edge[order], share[order]
    points = start[edge] + share[:, None] * (end[edge] - start[edge])
    points[share == 1.0] = end[edge[share == 1.0]]
    inside = np.flatnonzero(edge[1:] == edge[:-1])
    return points[inside], points[inside + 1], polygon[edge[inside]]
