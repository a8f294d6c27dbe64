"""Gratings and diffractive surfaces of CODE V's sequence files as those of .zmx files.

``DIF GRT`` is a linear grating of the order GRO, whose grooves are GRS units of the lens apart along the
vector GRX, GRY, GRZ (along y without it). ``DIF DOE`` with ``HCT R`` adds paths HCO C1 r^2 + HCO C2 r^4 + ...
at the wavelength HWL (nm) in the order HOR. Signs are those of .zmx files, as in Zemax' own converter.
"""

import math
from dataclasses import dataclass, field, replace

from wavequake.optics.zemax.rows import Line, Row, as_number, fail

_NUMBERS = ("GRO", "GRS", "GRX", "GRY", "GRZ", "HOR", "HWL")
_POINTS = tuple(f"H{what}{which}" for which in "12" for what in "XYZ")
COMMANDS = ("DIF", "GRT", *_NUMBERS, "HCT", "HCO", "HCC", "HV1", "HV2", *_POINTS)
"""Commands that say how a surface diffracts."""

_MM = {"MM": 1.0, "CM": 10.0, "IN": 25.4}


@dataclass
class Grating:
    """The commands of one surface; ``line`` is the first."""

    line: Line
    kind: str = ""
    numbers: dict[str, float] = field(default_factory=dict)
    paths: dict[int, float] = field(default_factory=dict)

    def take(self, line: Line) -> None:
        """Take a command."""
        keyword, words = line.keyword, line.words
        if keyword in ("DIF", "GRT"):
            self.kind = "GRT" if keyword == "GRT" else " ".join(words).upper()
            if self.kind not in ("GRT", "DOE"):
                fail(line, f"the diffractive surface DIF {self.kind} is not supported; GRT and DOE are")
        elif keyword in _NUMBERS:
            self.numbers[keyword] = as_number(line, 0)
        elif keyword == "HCT" and line.rest.upper() != "R":
            fail(line, f"the phase of type HCT {line.rest} is not supported; R, of even powers of r, is")
        elif keyword == "HCO":
            term = words[0].upper() if words else ""
            if not (term[:1] == "C" and term[1:].isdecimal() and 1 <= int(term[1:]) <= 100):
                fail(line, "HCO needs a coefficient from C1 to C100")
            self.paths[int(term[1:])] = as_number(line, 1)
        elif keyword in _POINTS and as_number(line, 0):
            fail(line, f"{keyword} makes a hologram of two points, which is not supported")


def with_grating(row: Row, given: Grating, unit: str) -> Row:
    """Return a row that diffracts; `unit` is that of the lens, MM, CM or IN."""
    return _linear(row, given, unit) if given.kind != "DOE" else _radial(row, given, unit)


def _linear(row: Row, given: Grating, unit: str) -> Row:
    line, numbers = given.line, given.numbers
    spacing = numbers.get("GRS", 0.0)
    if not (spacing > 0.0 and math.isfinite(spacing)):
        fail(line, f"{row.label} is a grating without a positive spacing of its grooves (GRS)")
    along = [numbers.get(key, float(key == "GRY")) for key in ("GRX", "GRY", "GRZ")]
    length = math.hypot(*along)
    if not length:
        fail(line, f"{row.label} has grooves in no direction (GRX, GRY, GRZ)")
    if along[2]:
        fail(
            line, f"{row.label} has grooves that are no sections along its axis (GRZ), which is not supported"
        )
    if "GRO" not in numbers:  # what CODE V takes then is not published
        fail(line, f"{row.label} is a grating without an order (GRO)")
    order = numbers["GRO"]
    if not along[0] and along[1] > 0.0 and not row.lines.get("PARM"):
        per_um = 1e-3 / (spacing * _MM[unit])
        return _diffracting(row, line, "DGRATING", {1: per_um, 2: order}, [])
    turns = [2.0 * math.pi * part / length / spacing for part in along[:2]]
    return _diffracting(row, line, "BINARY_1", {0: order, **row.table("PARM")}, turns)


def _radial(row: Row, given: Grating, unit: str) -> Row:
    wavelength = given.numbers.get("HWL", 0.0)
    if not wavelength > 0.0:
        fail(given.line, f"{row.label} diffracts without a wavelength of its paths (HWL)")
    per_path = 2.0 * math.pi / (wavelength * 1e-6 / _MM[unit])
    terms = [per_path * given.paths.get(k, 0.0) for k in range(1, max(given.paths, default=0) + 1)]
    order = given.numbers.get("HOR", 1.0)
    return _diffracting(row, given.line, "BINARY_2", {0: order, **row.table("PARM")}, terms)


def _diffracting(row: Row, line: Line, kind: str, parameters: dict[int, float], phase: list[float]) -> Row:
    """Return a row of a type; its phase, rad, is over a radius of one unit."""
    lines = {
        "TYPE": [kind],
        "PARM": [f"{k} {value!r}" for k, value in parameters.items()],
        "XDAT": [f"{k} {value!r}" for k, value in enumerate([float(len(phase)), 1.0, *phase], start=1)],
    }
    if kind == "DGRATING":
        del lines["XDAT"]
    made = {key: [Line(line.where, line.number, key, rest) for rest in rests] for key, rests in lines.items()}
    return replace(row, lines=row.lines | made)
