"""Motions and figures over time that were computed or measured elsewhere, read from a table (CSV)."""

import csv
import difflib
import io
import math
import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.errors import UserError
from wavequake.mechanics.motion import RAD_PER_MAS
from wavequake.mechanics.population import Population

Array = NDArray[np.float64]

MOST_INSTANTS = 100_000
MOST_TERMS = 2016  # of a figure, as everywhere
MOST_NUMBERS = 2**24  # of all motions and figures: 134 MB, of which a trace has a few copies
MOST_TEXT = 2**26  # characters: the text becomes a part of the study, and of its store
RIGID = ("dx_um", "dy_um", "dz_um", "rx_urad", "ry_urad", "rz_urad")
SIGHT, SIGHT_AXES = "line_of_sight", ("x_mas", "y_mas")
_MICRO, _NANO = 1e-6, 1e-9
_TERM = re.compile(r"z(-?\d{1,9})_nm")
_WHAT = "SURFACE.dx_um, .dy_um, .dz_um, .rx_urad, .ry_urad, .rz_urad or .zN_nm"
# Instants this much of the longest time apart are one: a program's rounding.
_SAME = 1e-9


@dataclass(frozen=True)
class ElementHistory:
    """Motions and figures at n instants, SI units; nobody may write into the arrays.

    Attributes
    ----------
    time : ndarray, shape (n,)
        s, increasing.
    rigid : dict of ndarray, shape (n, 6)
        By the element's name: dx, dy, dz in m and rx, ry, rz in rad in its own frame at rest.
    figure : dict of ndarray, shape (n, terms)
        By the surface's name: Noll coefficients from j = 1 in m.
    sight : ndarray, shape (n, 2)
        Rotation of the incoming bundle on the sky, rad, along x and y.
    """

    time: Array
    rigid: dict[str, Array]
    figure: dict[str, Array]
    sight: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the elements, those that move before those that deform only."""
        return tuple(dict.fromkeys((*self.rigid, *self.figure)))


class SurfaceHistory(Population):
    """Given motion and figures of surfaces and bodies over time, the same in every case.

    The instants are the rows of the file, so `instants` and `duration_s` are left out.
    """

    model: Literal["surface-history"] = "surface-history"
    instants: int = Field(default=16, ge=1, le=MOST_INSTANTS)
    file: str | None = Field(
        default=None,
        exclude=True,
        description="required: CSV of time_s and columns SURFACE.dx_um, .dy_um, .dz_um, .rx_urad, .ry_urad, "
        ".rz_urad, SURFACE.zN_nm (Noll coefficient N of its figure) and line_of_sight.x_mas, .y_mas, for any "
        "surface or body (read when the study is loaded)",
    )
    file_csv: str | None = Field(default=None, description="the text of that file")

    @model_validator(mode="before")
    @classmethod
    def _instants_are_the_rows(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        text = given.get("file_csv")
        if not isinstance(text, str):
            raise ValueError(f"a history needs a file, a CSV of time_s and columns such as {_WHAT}")
        try:
            time = read_history(text).time
        except UserError as error:
            raise ValueError(f"the history {given.get('file') or 'file_csv'}: {error}") from None
        return given | own_axis(time, given, f"the history has {len(time)} rows")

    @property
    def of(self) -> tuple[str, ...]:
        """Names of the surfaces and bodies that move or deform."""
        return history_of(self).names


def own_axis(time: Array, given: dict[str, Any], what: str) -> dict[str, Any]:
    """Return `instants` and `duration_s` of what has the instants `time`.

    Raises
    ------
    ValueError
        If others are given.
    """
    own = {"instants": len(time), "duration_s": float(time[-1]) if time[-1] > 0.0 else 0.1}
    other = next((key for key, value in own.items() if given.get(key, value) != value), None)
    if other is not None:
        raise ValueError(f"{what}, which are its instants: leave {other} = {given[other]} out")
    return own


def history_of(parameters: SurfaceHistory) -> ElementHistory:
    """Return what a history holds."""
    return read_history(parameters.file_csv or "")


def same_instants(one: Array, other: Array) -> bool:
    """Return whether two time axes are the same but for rounding."""
    return one.shape == other.shape and bool(np.all(np.abs(one - other) <= _SAME * np.abs(one).max()))


@lru_cache(maxsize=8)
def read_history(text: str) -> ElementHistory:
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
    places = [_place(column) for column in _columns(header)]
    twice = next((place for place in places if places.count(place) > 1), None)
    if twice is not None:
        raise UserError(f"there are two columns {header[1 + places.index(twice)]!r}; keep one of them.")
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
    return _history(values[:, 0].copy(), places, values[:, 1:])


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
        raise UserError(f"it is empty; its first line must name its columns: time_s, then {_WHAT}.")
    if header[0] != "time_s":
        first = ",".join(header)[:60]
        divider = next((mark for mark in (";", "\t") if mark in first), None)
        if divider:
            raise UserError(f"its columns are divided by {divider!r}; divide them by commas.")
        raise UserError(
            f"it begins with {first!r}, but its first line must name its columns: time_s, then {_WHAT}."
        )
    if len(header) < 2:
        raise UserError(f"there is no column beside time_s; add some, {_WHAT}.")
    return header[1:]


def _place(column: str) -> tuple[str, str, int]:
    """Return the element, "rigid", "figure" or "sight", and which number of it a column holds."""
    element, _, kind = column.rpartition(".")
    term = _TERM.fullmatch(kind)
    if not element:
        raise UserError(f"the column {column!r} does not say what moves; write {_WHAT}.")
    if (element == SIGHT) != (kind in SIGHT_AXES):
        raise UserError(
            f"the column {column!r} is unknown; light turns by {SIGHT}.x_mas and {SIGHT}.y_mas alone."
        )
    if element == SIGHT:
        return element, "sight", SIGHT_AXES.index(kind)
    if term:
        if not 1 <= int(term[1]) <= MOST_TERMS:
            raise UserError(
                f"the column {column!r} is no Noll coefficient; they are counted from 1, to {MOST_TERMS}."
            )
        return element, "figure", int(term[1]) - 1
    if kind in RIGID:
        return element, "rigid", RIGID.index(kind)
    near = difflib.get_close_matches(kind, (*RIGID, "z4_nm"), n=1)
    hint = f"{element}.{near[0]} would be one." if near else f"write {_WHAT}."
    raise UserError(f"the column {column!r} is no motion with a known unit; {hint}")


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


def _history(time: Array, places: list[tuple[str, str, int]], values: Array) -> ElementHistory:
    """Return the motions in SI units that the columns of `values` (n, columns) hold."""
    terms: dict[str, int] = {}
    for element, kind, number in places:
        if kind == "figure":
            terms[element] = max(terms.get(element, 0), number + 1)
    moving = dict.fromkeys(element for element, kind, _ in places if kind == "rigid")
    size = len(time) * (6 * len(moving) + sum(terms.values()))
    if size > MOST_NUMBERS:
        raise UserError(
            f"{len(time)} rows of {len(moving)} moving elements and of {sum(terms.values())} coefficients, "
            f"up to the highest of each figure, are {size} numbers; {MOST_NUMBERS} are possible."
        )
    rigid = {element: np.zeros((len(time), 6)) for element in moving}
    figure = {element: np.zeros((len(time), count)) for element, count in terms.items()}
    sight = np.zeros((len(time), 2))
    for (element, kind, number), column in zip(places, values.T, strict=True):
        if kind == "rigid":
            rigid[element][:, number] = column * _MICRO
        elif kind == "figure":
            figure[element][:, number] = column * _NANO
        else:
            sight[:, number] = column * RAD_PER_MAS
    for one in (time, *rigid.values(), *figure.values(), sight):
        one.flags.writeable = False
    return ElementHistory(time, rigid, figure, sight)
