"""A .zmx file as it is written: the lines before its surfaces, their rows, and its problems."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from wavequake.errors import UserError
from wavequake.optics.zemax.rows import OF_SURFACES, Line, Row, as_integer, as_number, fail

MM_PER_UNIT = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0}


@dataclass(frozen=True)
class LensFile:
    """The lines before the surfaces by keyword, the rows of the lens data editor, and the lines behind.

    Behind the surfaces stand merit functions, tolerances and configurations, whose operands may have the
    names of keywords.
    """

    where: str
    header: dict[str, list[Line]]
    rows: tuple[Row, ...]
    behind: tuple[Line, ...]

    def first(self, keyword: str) -> Line | None:
        """Return the first line of a keyword before the surfaces."""
        lines = self.header.get(keyword)
        return lines[0] if lines else None


class LensFileError(UserError):
    """Why a lens file cannot be traced: all its problems; ``read`` shows what could be read of it."""

    def __init__(self, message: str, read: str, details: str = "") -> None:
        super().__init__(message, details)
        self.read = read


@dataclass(frozen=True)
class Problems:
    """The problems of a file, each a sentence with its line."""

    found: list[str] = field(default_factory=list)

    @contextmanager
    def collected(self) -> Iterator[None]:
        """Keep the problem that ends what stands inside, and go on behind it."""
        try:
            yield
        except UserError as error:
            if str(error) not in self.found:
                self.found.append(str(error))

    def require_none(self, file: LensFile) -> None:
        """Raise LensFileError with all problems, if there are any."""
        if not self.found:
            return
        if len(self.found) == 1:
            raise LensFileError(self.found[0], listing(file))
        short = [one.removeprefix(f"{file.where}, ").rstrip(".") for one in self.found]
        lines = "\n".join(f"- {one}" for one in short)
        raise LensFileError(
            f"{file.where} cannot be traced, for {len(self.found)} reasons:", listing(file), lines
        )


def parsed(text: str, where: str) -> LensFile:
    """Return the lines of a .zmx file by where they stand.

    Raises
    ------
    UserError
        If it is no lens file.
    """
    header: dict[str, list[Line]] = {}
    rows: list[Row] = []
    behind: list[Line] = []
    inside = False
    for number, raw in enumerate(text.splitlines(), start=1):
        if not raw.strip():
            continue
        keyword, _, rest = raw.strip().partition(" ")
        line = Line(where, number, keyword.upper(), rest.strip())
        if line.keyword == "SURF":
            inside = True
            rows.append(Row(len(rows), line, {}))
            if as_integer(line, 0) != len(rows) - 1:
                fail(line, f"surface {rest.strip()} follows surface {len(rows) - 2}; they are counted from 0")
        elif inside and (raw[0] in " \t" or line.keyword in OF_SURFACES):
            rows[-1].lines.setdefault(line.keyword, []).append(line)
        elif rows:
            inside = False
            behind.append(line)
        else:
            header.setdefault(line.keyword, []).append(line)
    if len(rows) < 2:
        raise UserError(
            f"{where} is no sequential lens file: it has {len(rows)} SURF lines, an object and an image at "
            "least are needed."
        )
    return LensFile(where, header, tuple(rows), tuple(behind))


def scale_of(file: LensFile) -> float:
    """Return mm per unit of the file."""
    unit = file.first("UNIT")
    if unit is None:
        return 1.0
    if not unit.words or unit.words[0] not in MM_PER_UNIT:
        fail(unit, f"the unit {unit.rest[:12]!r} is not supported, one of {', '.join(MM_PER_UNIT)} is")
    return MM_PER_UNIT[unit.words[0]]


def listing(file: LensFile) -> str:
    """Return the surfaces as the file gives them, in its unit, as a table of plain text."""
    rows = [("", "surface", "type", "radius", "thickness", "glass")]
    for row in file.rows:
        curvature, thickness, glass = (row.one(keyword) for keyword in ("CURV", "DISZ", "GLAS"))
        stop = " (stop)" if "STOP" in row.lines else ""
        label = "object" if row.number == 0 else row.label
        rows.append(
            (
                str(row.number),
                label + stop,
                row.type,
                _radius(curvature),
                thickness.rest.lower() if thickness else "0",
                glass.words[0] if glass and glass.words else "",
            )
        )
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def _radius(line: Line | None) -> str:
    try:
        curvature = as_number(line, 0) if line else 0.0
    except UserError:
        return "?"
    return f"{1.0 / curvature:.8g}" if curvature else "infinite"
