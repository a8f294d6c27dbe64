"""A history as text: a CSV whose first line names its columns."""

import csv
import io
import math
from array import array
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

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
    names, values = read_columns(text, "time_s", COLUMNS, _require_known)
    return history_from(values[:, 0].copy(), [place_of(name) for name in names], values[:, 1:], {})


def _require_known(names: list[str]) -> None:
    require_distinct(names, [place_of(name) for name in names])


def read_columns(
    text: str, key: str, columns: str, check: Callable[[list[str]], None]
) -> tuple[list[str], NDArray[np.float64]]:
    """Read CSV text whose first column, `key`, increases; return the names of the others and all numbers.

    Parameters
    ----------
    text : str
        At most so much of it as a study can hold.
    key : str
        Name of the first column, ending in its unit.
    columns : str
        What the others may be called, in words for messages.
    check : callable
        Raises UserError if the names of the others are not what they must be.

    Returns
    -------
    names : list of str, length c
    values : ndarray, shape (n, 1 + c)

    Raises
    ------
    UserError
        As `read_table`.
    """
    if len(text) > MOST_TEXT:
        raise UserError(
            f"it has {len(text) / 1e6:.0f} MB of text, {MOST_TEXT / 1e6:.0f} MB are possible; leave out rows "
            "or digits."
        )
    rows = _rows(text)
    header = [cell.strip() for cell in next(rows, (0, []))[1]]
    check(_columns(header, key, columns))
    table = array("d")
    last, count = -math.inf, 0
    for line, row in rows:
        numbers = _numbers(row, header, f"line {line}")
        if numbers[0] <= last:
            raise UserError(
                f"line {line}: {key} {numbers[0]:.12g} does not increase, the row before has "
                f"{last:.12g}; sort the rows by {key.partition('_')[0]}."
            )
        last, count = numbers[0], count + 1
        if count > MOST_INSTANTS:
            raise UserError(f"there are more than {MOST_INSTANTS} rows; divide them among several studies.")
        table.extend(numbers)
    if not count:
        raise UserError("there are no rows below the line that names the columns.")
    return header[1:], np.frombuffer(table).reshape(count, len(header))


def _rows(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows that are no comments with the numbers of their lines."""
    reader = csv.reader(io.StringIO(text))
    try:
        for row in reader:
            if any(row) and not row[0].lstrip().startswith("#"):
                yield reader.line_num, row
    except csv.Error as error:
        raise UserError(f"line {reader.line_num}: it is no CSV ({error}).") from None


def _columns(header: list[str], key: str, columns: str) -> list[str]:
    """Return the columns beside the first one, `key`."""
    if not header:
        raise UserError(f"it is empty; its first line must name its columns: {key}, then {columns}.")
    if header[0] != key:
        first = ",".join(header)[:60]
        divider = next((mark for mark in (";", "\t") if mark in first), None)
        if divider:
            raise UserError(f"its columns are divided by {divider!r}; divide them by commas.")
        raise UserError(
            f"it begins with {first!r}, but its first line must name its columns: {key}, then {columns}."
        )
    if len(header) < 2:
        raise UserError(f"there is no column beside {key}; add some, {columns}.")
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
