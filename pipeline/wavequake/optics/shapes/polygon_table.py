"""Read a user's table of polygons: one segment of glass per row."""

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.optics.shapes.concave import crossing
from wavequake.optics.shapes.polygons import ROUNDING, concave, overlapping, signed_areas
from wavequake.user_files import read_text

Array = NDArray[np.float64]

_MM_PER_M = 1e3
_FARTHEST_M = 1e6


def read_polygons(source: str | Path | TextIO) -> tuple[list[str], Array, Array | None]:
    """Read polygons from CSV with the columns ``id,x1_m,y1_m,x2_m,y2_m,...``.

    A row with fewer corners leaves its last cells empty. ``cx_m,cy_m`` are optional pivots; other columns are
    ignored, and so are lines that begin with ``#``.

    Parameters
    ----------
    source : path or text stream

    Returns
    -------
    names : list of str, length S
    corners : ndarray, shape (S, V, 2)
        In mm, counter-clockwise whatever their order in the table; shorter polygons repeat their last corner.
    centers : ndarray, shape (S, 2), or None
        In mm, if the table has them.

    Raises
    ------
    UserError
        If the file cannot be read, has no rows or columns, or a number is missing or wrong (names the line);
        if two segments have one id or overlap, or a polygon has fewer than 3 corners or no area, or
        crosses itself, or has its pivot farther away than the mirror is wide.
    """
    if not isinstance(source, str | Path):
        return _parsed(source, getattr(source, "name", "the table of polygons"))
    try:
        text = read_text(source)
    except UserError as error:
        raise UserError(f"The table of polygons {error}") from None
    return _parsed(io.StringIO(text, newline=""), str(source))


def _parsed(stream: TextIO, where: str) -> tuple[list[str], Array, Array | None]:
    reader = csv.reader(stream)
    try:
        rows = [
            (f"{where}, line {reader.line_num}", row)
            for row in reader
            if any(cell.strip() for cell in row) and not row[0].startswith("#")
        ]
        header = [name.strip() for name in rows.pop(0)[1]] if rows else []
        pairs = _corner_columns(header, where)
    except (csv.Error, UnicodeDecodeError) as error:
        raise UserError(f"{where} is not a table in CSV (UTF-8): {error}.") from None
    if not rows:
        raise UserError(f"{where} has no polygons; give one row per segment.")
    require_columns(header, rows)
    names, polygons = _names(header, rows, where), [_corners(pairs, row, line) for line, row in rows]
    corners = _padded(polygons)
    _require_area(names, corners, where)
    corners = _padded(
        [
            polygon if area > 0.0 else polygon[::-1]
            for polygon, area in zip(polygons, signed_areas(corners), strict=True)
        ]
    )
    _require_simple(names, corners, where)
    _require_apart(names, corners, where)
    centers = None
    if "cx_m" in header and "cy_m" in header:
        columns = (header.index("cx_m"), header.index("cy_m"))
        centers = np.array([_point(row, columns, line) for line, row in rows])
        _require_near(names, corners, centers, where)
    return names, corners, centers


def _corner_columns(header: list[str], where: str) -> list[tuple[int, int]]:
    """Return the columns of x and y of corners 1, 2, ..."""
    pairs: list[tuple[int, int]] = []
    while {f"x{len(pairs) + 1}_m", f"y{len(pairs) + 1}_m"} <= set(header):
        pairs.append((header.index(f"x{len(pairs) + 1}_m"), header.index(f"y{len(pairs) + 1}_m")))
    if "id" not in header or len(pairs) < 3:
        raise UserError(
            f"{where} must have the columns id, x1_m, y1_m, x2_m, y2_m, x3_m, y3_m, ... in its first line; "
            f"it has {', '.join(filter(None, header)) or 'none'}."
        )
    corners = [name for name in header if re.fullmatch(r"[xy]\d+_m", name)]
    named = {f"{axis}{index + 1}_m" for index in range(len(pairs)) for axis in "xy"}
    if spare := next((name for name in corners if name not in named or corners.count(name) > 1), None):
        raise UserError(
            f"{where}: the column {spare} has no place among x1_m, y1_m, x2_m, y2_m, ... of {len(pairs)} "
            "corners; each corner has both, once, and none is left out."
        )
    return pairs


def require_columns(header: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]]) -> None:
    """Raise UserError for a row, with its place, that has more cells than there are columns."""
    for line, row in rows:
        if any(cell.strip() for cell in row[len(header) :]):
            raise UserError(
                f"{line}: there are {len(row)} cells, but {len(header)} columns; numbers have a decimal "
                "point, and commas part them."
            )


def _names(header: list[str], rows: Sequence[tuple[str, list[str]]], where: str) -> list[str]:
    column = header.index("id")
    names = [row[column].strip() if column < len(row) else "" for _, row in rows]
    for (line, _), name in zip(rows, names, strict=True):
        if not name:
            raise UserError(f"{line}: the id is empty; every segment needs a name.")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise UserError(f"{where}: two segments are called {twice!r}; every id must be unique.")
    return names


def _corners(pairs: Sequence[tuple[int, int]], row: list[str], line: str) -> list[tuple[float, float]]:
    """Return the corners of a row, in mm; trailing empty cells are corners that it does not have."""
    cells = [[row[column].strip() if column < len(row) else "" for column in pair] for pair in pairs]
    count = max((index + 1 for index, pair in enumerate(cells) if any(pair)), default=0)
    if count < 3:
        raise UserError(f"{line}: the polygon has {count} corners; it must have at least 3.")
    return [_point(row, pair, line) for pair in pairs[:count]]


def _point(row: list[str], columns: tuple[int, int], line: str) -> tuple[float, float]:
    values = []
    for column in columns:
        text = row[column].strip() if column < len(row) else ""
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not abs(value) < _FARTHEST_M:
            raise UserError(
                f"{line}, column {column + 1}: {text!r} is not a number below {_FARTHEST_M:g}; write meters, "
                "such as 1.25."
            )
        values.append(value * _MM_PER_M)
    return values[0], values[1]


def _padded(polygons: Sequence[Sequence[tuple[float, float]]]) -> Array:
    """Return corners (S, V, 2); shorter polygons repeat their last corner."""
    most = max(len(polygon) for polygon in polygons)
    return np.array([[*polygon, *[polygon[-1]] * (most - len(polygon))] for polygon in polygons])


def _require_area(names: list[str], corners: Array, where: str) -> None:
    size = np.ptp(corners, axis=1).max(axis=1)
    for name, area, extent in zip(names, signed_areas(corners), size, strict=True):
        if not abs(area) > ROUNDING * extent:
            raise UserError(f"{where}: polygon {name!r} has no area; list its corners in order around it.")


def _require_simple(names: list[str], corners: Array, where: str) -> None:
    wrong = concave(corners) & crossing(corners)
    if wrong.any():
        name = names[int(np.argmax(wrong))]
        raise UserError(
            f"{where}: polygon {name!r} crosses or touches itself; list its corners in order around it."
        )


def _require_near(names: list[str], corners: Array, centers: Array, where: str) -> None:
    """Raise UserError for a pivot that lies farther from its segment than the mirror is wide: wrong units."""
    width = float(np.ptp(corners.reshape(-1, 2), axis=0).max())
    distance = np.linalg.norm(corners - centers[:, None], axis=2).min(axis=1)
    if (distance > width).any():
        index = int(np.argmax(distance))
        meters = distance[index] / _MM_PER_M
        raise UserError(
            f"{where}: the pivot of {names[index]!r} lies {meters:g} m from its corners; "
            "cx_m and cy_m are in m, and no pivot lies farther away than the mirror is wide."
        )


def _require_apart(names: list[str], corners: Array, where: str) -> None:
    pairs = overlapping(corners, ROUNDING)
    if len(pairs):
        first, second = (names[index] for index in pairs[0])
        more = f" (the first of {len(pairs)} pairs)" if len(pairs) > 1 else ""
        raise UserError(
            f"{where}: the polygons {first!r} and {second!r} overlap{more}; segments must lie side by side."
        )
