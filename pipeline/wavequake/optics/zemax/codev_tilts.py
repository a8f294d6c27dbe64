"""Decenters and tilts of CODE V's sequence files as coordinate breaks.

Before a surface the axes move by XDE, YDE, ZDE, then turn by ADE and BDE, which are left-handed, and CDE
about x, y and z. They stay so (without a word), come back behind the surface (DAR), or turn by the same
angles once more as light does that a mirror folds (BEN); with REV they turn back behind the surface only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from wavequake.optics.zemax.rows import Line, Row, as_number, fail

_SHIFTS, _TURNS = ("XDE", "YDE", "ZDE"), ("ADE", "BDE", "CDE")
_KINDS = ("DAR", "BEN", "REV")
TILTS = (*_SHIFTS, *_TURNS, *_KINDS)
"""Commands that move the axes of a surface."""


@dataclass
class Tilt:
    """The commands of one surface."""

    numbers: dict[str, float] = field(default_factory=dict)
    kind: str = ""
    line: Line | None = None

    def take(self, line: Line) -> None:
        """Take a command."""
        self.line = self.line or line
        if line.keyword in _KINDS:
            if self.kind and self.kind != line.keyword:
                fail(line, f"{line.keyword} stands beside {self.kind}; one of them is supported")
            self.kind = line.keyword
        else:
            self.numbers[line.keyword] = as_number(line, 0)


def with_breaks(rows: Sequence[Row], tilts: Mapping[int, Tilt]) -> tuple[Row, ...]:
    """Return rows with coordinate breaks before and behind those that are tilted."""
    found: list[Row] = []
    for number, row in enumerate(rows):
        tilt = tilts.get(number)
        line = tilt.line if tilt else None
        if tilt is None or line is None or not any(tilt.numbers.values()):
            found.append(row)
            continue
        if number == 0:
            fail(line, "the object cannot be decentered or tilted")
        x, y, z = (tilt.numbers.get(key, 0.0) for key in _SHIFTS)
        alpha, beta, gamma = (tilt.numbers.get(key, 0.0) for key in _TURNS)
        turns = (-alpha, -beta, gamma)
        if tilt.kind in ("BEN", "REV") and any((x, y, z)):
            fail(line, f"{row.label} is decentered beside {tilt.kind}, which is not supported")
        if tilt.kind == "BEN" and gamma:
            fail(line, f"{row.label} has CDE beside BEN, which is not supported")
        if tilt.kind != "REV":
            found += [
                _break(row, line, (x, y), (0.0, 0.0, 0.0), 0, repr(z)),
                _break(row, line, (0.0, 0.0), turns, 0, "0"),
            ]
        way = row.one("DISZ")
        thickness = way.rest if way else "0"
        if not tilt.kind or number == len(rows) - 1:
            found.append(row)
            continue
        found.append(
            Row(row.number, row.line, {**row.lines, "DISZ": [Line(line.where, line.number, "DISZ", "0")]})
        )
        if tilt.kind == "BEN":
            found.append(_break(row, line, (0.0, 0.0), turns, 0, thickness))
        else:
            back = (-turns[0], -turns[1], -turns[2])
            found += [
                _break(row, line, (-x, -y), back, 1, repr(-z)),
                _break(row, line, (0.0, 0.0), (0.0, 0.0, 0.0), 0, thickness),
            ]
    return tuple(found)


def _break(
    row: Row, line: Line, shift: tuple[float, float], turns: tuple[float, float, float], order: int, way: str
) -> Row:
    """Return a coordinate break that says what a command says."""

    def said(keyword: str, *texts: str) -> list[Line]:
        return [Line(line.where, line.number, keyword, text) for text in texts]

    numbers = [f"{k} {value!r}" for k, value in enumerate((*shift, *turns, float(order)), start=1)]
    return Row(
        row.number,
        line,
        {"TYPE": said("TYPE", "COORDBRK"), "PARM": said("PARM", *numbers), "DISZ": said("DISZ", way)},
    )
