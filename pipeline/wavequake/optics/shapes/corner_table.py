"""Distort segments: corners of the glass displaced as a table says."""

import csv
import difflib
import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.optics.segments.layout import Segments
from wavequake.optics.shapes.concave import crossing
from wavequake.optics.shapes.polygon_table import require_columns
from wavequake.optics.shapes.polygons import ROUNDING, concave, overlapping, signed_areas
from wavequake.user_files import read_text

Array = NDArray[np.float64]

_FARTHEST_MM = 1e9
_COLUMNS = ("segment", "corner", "dx_mm", "dy_mm")


def distorted(segments: Segments, source: str | Path | TextIO) -> Segments:
    """Return the segments with some of their corners displaced in x and y; pivots and axes stay.

    Parameters
    ----------
    segments : Segments
    source : path or text stream
        CSV with the columns ``segment,corner,dx_mm,dy_mm``, one row per displaced corner; corners count from
        1 in the order of ``segments.corners``, which is counter-clockwise. Lines that begin with ``#`` are
        ignored.

    Returns
    -------
    Segments

    Raises
    ------
    UserError
        If the table cannot be read or names what does not exist (says the line), or if a distorted segment
        crosses itself or overlaps another one.
    """
    if isinstance(source, str | Path):
        try:
            text = read_text(source)
        except UserError as error:
            raise UserError(f"The table of corners {error}") from None
        return distorted(segments, _Named(text, str(source)))
    where = getattr(source, "name", "the table of corners")
    moves = np.zeros_like(segments.corners)
    seen: set[tuple[int, int]] = set()
    for line, row in _rows(source, where):
        segment, corner, move = _parsed(segments, row, line)
        if (segment, corner) in seen:
            raise UserError(
                f"{line}: corner {corner + 1} of segment {segments.names[segment]} is displaced twice."
            )
        seen.add((segment, corner))
        moves[segment, corner] = move
    corners = segments.corners + moves
    _require_glass(segments.names, corners, where)
    return replace(segments, corners=corners)


class _Named(io.StringIO):
    """A text that says where it is from."""

    def __init__(self, text: str, name: str) -> None:
        super().__init__(text, newline="")
        self.name = name


def _rows(stream: TextIO, where: str) -> list[tuple[str, list[str]]]:
    """Return the cells of segment, corner, dx and dy with the place of each row."""
    reader = csv.reader(stream)
    try:
        rows = [
            (f"{where}, line {reader.line_num}", [cell.strip() for cell in row])
            for row in reader
            if any(cell.strip() for cell in row) and not row[0].startswith("#")
        ]
    except (csv.Error, UnicodeDecodeError) as error:
        raise UserError(f"{where} is not a table in CSV (UTF-8): {error}.") from None
    header = rows.pop(0)[1] if rows else []
    missing = [name for name in _COLUMNS if name not in header]
    if missing:
        raise UserError(f"{where} must have the columns {', '.join(_COLUMNS)}; it lacks {missing[0]}.")
    require_columns(header, rows)
    places = [header.index(name) for name in _COLUMNS]
    return [(line, [row[place] if place < len(row) else "" for place in places]) for line, row in rows]


def _parsed(segments: Segments, row: list[str], line: str) -> tuple[int, int, tuple[float, float]]:
    """Return the indices of segment and corner, and the displacement in mm."""
    name, corner, *move = row
    if name not in segments.names:
        near = difflib.get_close_matches(name, segments.names, n=1, cutoff=0.0)
        raise UserError(f"{line}: there is no segment {name!r}; the nearest is {near[0]!r}.")
    most = segments.corners.shape[1]
    if not (corner.isdecimal() and len(corner) < 10 and 1 <= int(corner) <= most):
        raise UserError(f"{line}: {corner!r} is not a corner; write a number from 1 to {most}.")
    return segments.names.index(name), int(corner) - 1, (_length(move[0], line), _length(move[1], line))


def _length(text: str, line: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < _FARTHEST_MM:
        raise UserError(f"{line}: {text!r} is not a number; write millimeters, such as -0.5.")
    return value


def _require_glass(names: Sequence[str], corners: Array, where: str) -> None:
    wrong = (concave(corners) & crossing(corners)) | (signed_areas(corners) <= 0.0)
    if wrong.any():
        name = names[int(np.argmax(wrong))]
        raise UserError(f"{where}: segment {name!r} would cross itself; displace its corners by less.")
    pairs = overlapping(corners, ROUNDING)
    if len(pairs):
        first, second = (names[index] for index in pairs[0])
        raise UserError(
            f"{where}: the segments {first!r} and {second!r} would overlap; displace their corners by less, "
            "or leave a wider gap."
        )
