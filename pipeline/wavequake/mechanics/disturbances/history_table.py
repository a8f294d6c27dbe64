"""A history as text: a CSV whose first line names its columns."""

import csv
import io
import math
from array import array
from collections.abc import Iterator

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.history_facts import (
    COLUMNS,
    MOST_INSTANTS,
    MOST_TEXT,
    ElementHistory,
    history_from,
    place_of,
    require_distinct,
)
from wavequake.prepared import prepared


@prepared(maxsize=4)
def read_table(text: str) -> ElementHistory:
    """Read CSV text whose first line names its columns: time_s, and what moves.

    ``SURFACE.dx_um`` (dy_um, dz_um, rx_urad, ry_urad, rz_urad) is a rigid motion, ``SURFACE.zN_nm`` the Noll
    coefficient N of a figure, ``line_of_sight.x_mas`` (y_mas) the direction of the incoming light. What has
    no column is zero. Empty lines and those that begin with # are left out.

    Raises
    ------
    UserError
        If a column or a value is not what it must be, the instants do not increase, or there are no rows or
        too many; names line and column.
    """
    if len(text) > MOST_TEXT:
        raise UserError(
            f"it has {len(text) / 1e6:.0f} MB of text, {MOST_TEXT / 1e6:.0f} MB are possible; leave out rows "
            "or digits."
        )
    rows = _rows(text)
    header = [cell.strip() for cell in next(rows, (0, []))[1]]
    places = [place_of(column) for column in _columns(header)]
    require_distinct(header[1:], places)
    table = array("d")
    last, count = -math.inf, 0
    for line, row in rows:
        numbers = _numbers(row, header, f"line {line}")
        if numbers[0] <= last:
            raise UserError(
                f"line {line}: time_s {numbers[0]:.12g} does not increase, the row before has "
                f"{last:.12g}; sort the rows by time."
            )
        last, count = numbers[0], count + 1
        if count > MOST_INSTANTS:
            raise UserError(f"there are more than {MOST_INSTANTS} rows; divide them among several studies.")
        table.extend(numbers)
    if not count:
        raise UserError("there are no rows below the line that names the columns.")
    values = np.frombuffer(table).reshape(count, len(header))
    return history_from(values[:, 0].copy(), places, values[:, 1:], {})


def _rows(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows that are no comments with the numbers of their lines."""
    reader = csv.reader(io.StringIO(text))
    try:
        for row in reader:
            if any(row) and not row[0].lstrip().startswith("#"):
                yield reader.line_num, row
    except csv.Error as error:
        raise UserError(f"line {reader.line_num}: it is no CSV ({error}).") from None


def _columns(header: list[str]) -> list[str]:
    """Return the columns beside time_s."""
    if not header:
        raise UserError(f"it is empty; its first line must name its columns: time_s, then {COLUMNS}.")
    if header[0] != "time_s":
        first = ",".join(header)[:60]
        divider = next((mark for mark in (";", "\t") if mark in first), None)
        if divider:
            raise UserError(f"its columns are divided by {divider!r}; divide them by commas.")
        raise UserError(
            f"it begins with {first!r}, but its first line must name its columns: time_s, then {COLUMNS}."
        )
    if len(header) < 2:
        raise UserError(f"there is no column beside time_s; add some, {COLUMNS}.")
    return header[1:]


def _numbers(row: list[str], header: list[str], where: str) -> list[float]:
    if len(row) != len(header):
        raise UserError(f"{where} has {len(row)} cells, but there are {len(header)} columns.")
    try:
        numbers = [float(cell) for cell in row]
    except ValueError:
        numbers = [math.nan]
    if all(map(math.isfinite, numbers)):
        return numbers
    column, cell = next(
        (column, cell) for column, cell in zip(header, row, strict=True) if not _is_finite(cell)
    )
    raise UserError(f"{where}, column {column!r}: {cell.strip()!r} is no finite number.")


def _is_finite(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False
