"""Heights on a grid in .zmx files: the surface Grid Sag.

A line ``GDAT nx ny dx dy`` announces the grid; ``GARR k z dz/dx dz/dy d2z/dxdy`` holds a node each, from the
upper left (-x, +y) along x and then downwards, in units of the file. A surface that is read goes through the
heights by a bicubic spline of its own, whatever the slopes; the ones that are written are the spline's, so
the patches between four nodes are the same polynomials. Parameters 1 to 8 add an even asphere, the extra data
Zernike polynomials (`wavequake.optics.zemax.surfaces`).
"""

import numpy as np

from wavequake.errors import UserError
from wavequake.optics.shapes.basis import spline_coefficients
from wavequake.optics.shapes.sag import require_shape
from wavequake.optics.shapes.sag_file import MAX_NODES
from wavequake.optics.shapes.shapes import GridSag
from wavequake.optics.zemax.rows import Line, Row, as_integer, as_number, fail, written

FEWEST_NODES = 5

Weights = tuple[float, float, float]
_VALUE: Weights = (1 / 6, 4 / 6, 1 / 6)  # of a cubic B-spline's coefficients about a node
_SLOPE: Weights = (-1 / 2, 0.0, 1 / 2)


def grid_sag(row: Row, scale: float, radius: float, conic: float) -> GridSag:
    """Return a Grid Sag surface on its conic in mm; `scale` is mm per unit of the file."""
    if row.table("PARM").get(0, 0.0):
        fail(
            next(line for line in row.lines["PARM"] if as_integer(line, 0) == 0),
            f"{row.label} is interpolated linearly, with edges at every node; choose the bicubic spline",
        )
    head = row.one("GDAT")
    if head is None:
        fail(row.line, f"{row.label} has no grid (GDAT and GARR); import its heights and save the file again")
    columns, rows = _count(head, 0, row), _count(head, 1, row)
    dx, dy = (scale * abs(as_number(head, place)) for place in (2, 3))
    if any(as_number(head, place) for place in range(4, len(head.words))):
        fail(head, f"{row.label} has a grid that is decentered or in other units, which is not supported")
    heights = _heights(row, head, rows * columns).reshape(rows, columns)[::-1]
    shape = GridSag(radius, conic, scale * heights, dx, dy)
    try:
        require_shape(shape)
    except UserError as error:
        fail(head, f"{row.label}: {error}")
    return shape


def _count(head: Line, place: int, row: Row) -> int:
    count = as_integer(head, place)
    most = MAX_NODES // FEWEST_NODES
    if not FEWEST_NODES <= count <= most:
        fail(
            head,
            f"{row.label} has a grid of {count} nodes along an axis; {FEWEST_NODES} to {most} are possible",
        )
    return count


def _heights(row: Row, head: Line, count: int) -> np.ndarray:
    """Return the heights in the file's order, whose numbers start at 0 or 1."""
    nodes = {as_integer(line, 0): line for line in row.lines.get("GARR", [])}
    first = min(nodes, default=1)
    given = len(row.lines.get("GARR", []))
    numbered = first in (0, 1) and set(nodes) == set(range(first, first + given))
    if count > MAX_NODES or given != count or not numbered:
        fail(
            head,
            f"{row.label} announces {count} nodes (at most {MAX_NODES} are supported), {given} lines GARR "
            "follow, whose numbers must run from 0 or 1 without a gap",
        )
    for line in nodes.values():
        if len(line.words) > 5 and as_number(line, 5):
            fail(line, f"{row.label} has a node without data; fill the holes of the grid first")
    return np.array([as_number(nodes[number], 1) for number in range(first, first + count)])


def grid_lines(shape: GridSag, name: str) -> list[str]:
    """Return the lines of a grid, with the slopes of its spline at the nodes.

    Raises
    ------
    UserError
        If it has fewer than 5 rows or columns, which the format asks for.
    """
    rows, columns = shape.heights.shape
    if min(rows, columns) < FEWEST_NODES:
        raise UserError(
            f"The grid of {name} has {rows} rows and {columns} columns; a lens file holds {FEWEST_NODES} at "
            "least."
        )
    spline = spline_coefficients(shape.heights)
    slope_x = _at_nodes(spline, _VALUE, _SLOPE) / shape.dx
    slope_y = _at_nodes(spline, _SLOPE, _VALUE) / shape.dy
    twist = _at_nodes(spline, _SLOPE, _SLOPE) / (shape.dx * shape.dy)
    nodes = np.stack([shape.heights, slope_x, slope_y, twist], axis=-1)[::-1].reshape(-1, 4)
    return [
        f"GDAT {columns} {rows} {written(shape.dx)} {written(shape.dy)}",
        *(
            f"GARR {number} " + " ".join(map(written, node))
            for number, node in enumerate(nodes.tolist(), start=1)
        ),
    ]


def _at_nodes(spline: np.ndarray, along_y: Weights, along_x: Weights) -> np.ndarray:
    """Return sums of three neighbors along both axes."""
    for axis, weights in enumerate((along_y, along_x)):
        size = spline.shape[axis] - 2
        parts = [w * np.take(spline, range(k, k + size), axis) for k, w in enumerate(weights)]
        spline = np.sum(parts, axis=0)
    return spline
