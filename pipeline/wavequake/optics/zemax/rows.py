"""Lines and rows of a .zmx file, and how their words become numbers."""

import math
from dataclasses import dataclass
from typing import NoReturn

from wavequake.errors import UserError

MAX_COUNT = 1000

OPENINGS = ("CLAP", "FLAP", "OBSC", "SQAP", "SQOB", "ELAP", "ELOB", "SPID", "USAP", "USOB")
OF_SURFACES = ("TYPE", "CURV", "CONI", "DISZ", "GLAS", "DIAM", "STOP", "PARM", "XDAT", "OBDC", "COMM")
_HEIGHTS = ("GDAT", "GARR")  # of a surface of the type GRID_SAG
# Drawing, coatings, mechanical diameters (OEMA is the edge between DIAM and MEMA), thermal data, physical
# optics; and the solves, variables and pickups whose results are in the file.
_HARMLESS = (
    *("HIDE", "MIRR", "SLAB", "POPS", "COAT", "MEMA", "OEMA", "FIMP", "EDGE", "TCED"),
    *("MAZH", "PZUP", "PPAR", "PKUP", "VDSZ", "VPAR", "VCON"),
)
_KNOWN = frozenset((*OF_SURFACES, *_HARMLESS, *OPENINGS, "UDAD", "SCBD"))
_MOVES_LIGHT = dict.fromkeys(  # unless all numbers after the first are zero
    ("UDAP", "UDOB"), "an aperture of another form"
)


@dataclass(frozen=True)
class Line:
    """A line of the file: where it stands, its keyword and the rest."""

    where: str
    number: int
    keyword: str
    rest: str

    @property
    def words(self) -> list[str]:
        """What follows the keyword, split at blanks."""
        return self.rest.split()


@dataclass(frozen=True)
class Row:
    """A surface as the file gives it: its number, its SURF line, and its lines by keyword."""

    number: int
    line: Line
    lines: dict[str, list[Line]]

    @property
    def type(self) -> str:
        """The surface type, STANDARD if none is given."""
        line = self.one("TYPE")
        return line.words[0] if line and line.words else "STANDARD"

    @property
    def label(self) -> str:
        """The comment, or the number."""
        line = self.one("COMM")
        return (line.rest.strip('"') if line else "") or f"surface {self.number}"

    def one(self, keyword: str) -> Line | None:
        """Return the line of a keyword that may stand once."""
        found = self.lines.get(keyword)
        return found[0] if found else None

    def table(self, keyword: str) -> dict[int, float]:
        """Return the numbers of lines ``keyword index value`` by index."""
        return {as_integer(line, 0): as_number(line, 1) for line in self.lines.get(keyword, [])}

    def unknown(self) -> list[Line]:
        """Return the first line of each keyword that is not understood."""
        known = (*_KNOWN, *_MOVES_LIGHT, *_HEIGHTS)
        return [lines[0] for keyword, lines in self.lines.items() if keyword not in known]

    def require_supported(self) -> None:
        """Refuse a property that changes the path of light and is not supported."""
        for keyword, what in _MOVES_LIGHT.items():
            for line in self.lines.get(keyword, []):
                if any(word.strip("+-0.eE") for word in line.words[1:]):
                    fail(line, f"{self.label} has {what}, which is not supported")
        for keyword in _HEIGHTS:
            if keyword in self.lines and self.type != "GRID_SAG":
                what = "heights on a grid, which a surface of the type GRID_SAG has"
                fail(self.lines[keyword][0], f"{self.label} has {what}, but it is of the type {self.type}")


def fail(line: Line, message: str) -> NoReturn:
    """Raise a UserError that names file and line."""
    raise UserError(f"{line.where}, line {line.number} ({line.keyword}): {message}.")


def as_number(line: Line, index: int) -> float:
    """Return a word of a line as a finite number."""
    words = line.words
    if index >= len(words):
        fail(line, f"the number {index + 1} after the keyword is missing")
    try:
        value = float(words[index])
    except ValueError:
        fail(line, f"{words[index]!r} is not a number")
    if not math.isfinite(value):
        fail(line, f"{words[index]!r} is not a finite number")
    return value


def as_integer(line: Line, index: int) -> int:
    """Return a word of a line as an integer."""
    value = as_number(line, index)
    if value != int(value):
        fail(line, f"{value:g} is not an integer")
    return int(value)


def as_count(line: Line, index: int) -> int:
    """Return a word of a line as a number of things, of which there is at least one."""
    value = as_integer(line, index)
    if not 1 <= value <= MAX_COUNT:
        fail(line, f"{value} is not a number of things from 1 to {MAX_COUNT}")
    return value


def require_no_numbers(row: Row, keyword: str, numbers: dict[int, float]) -> None:
    """Refuse numbers, by their index in the lines of a keyword, that ought to be 0."""
    what = "parameter" if keyword == "PARM" else "extra number"
    for index, value in numbers.items():
        if value:
            line = next(line for line in row.lines[keyword] if as_integer(line, 0) == index)
            fail(line, f"{row.label}: {what} {index} of the type {row.type} must be 0, it is {value:g}")


def numbered(row: Row, keyword: str, first: int, last: int) -> dict[int, float]:
    """Return the numbers of lines ``keyword index value`` from index `first` to `last`; others must be 0."""
    given = row.table(keyword)
    require_no_numbers(row, keyword, {k: value for k, value in given.items() if not first <= k <= last})
    return {k: value for k, value in given.items() if first <= k <= last}


def powers_scaled(given: dict[int, float], scale: float, first: int, step: int) -> tuple[float, ...]:
    """Return coefficients of powers `first`, `first` + `step`, ... of a length, numbered from 1, in mm.

    `scale` is mm per unit of the file.
    """
    count = max((k for k, value in given.items() if value), default=0)
    return tuple(given.get(k, 0.0) * scale ** (1 - first - step * (k - 1)) for k in range(1, count + 1))


def written(value: float) -> str:
    """Return a number as text that gives it back to the last bit; it must be finite."""
    if not math.isfinite(value):
        raise UserError(f"A lens file holds finite numbers only, not {value}.")
    return repr(float(value))
