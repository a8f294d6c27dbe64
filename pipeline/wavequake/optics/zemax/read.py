"""Read optical systems from Zemax's sequential lens files (.zmx).

What the file says and an `OpticalSystem` cannot express is refused by name and line, never left out; what is
not understood in its header is named in the system's note. Solves and pickups need nothing: the file holds
the values that they gave. Two conventions differ from Zemax's default: rays are always aimed at the real
stop, and a semi-diameter stops light only where the surface has an aperture (as in Zemax). Signs are the
same: thicknesses are negative after an odd number of mirrors.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np

from wavequake.errors import UserError
from wavequake.optics.media.glasses import AIR, Medium
from wavequake.optics.media.gradients import GradientIndex
from wavequake.optics.systems.kinematics import Break, SurfaceRow, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil, require_system
from wavequake.optics.zemax.header import PUPILS, left_aside, require_supported
from wavequake.optics.zemax.media import medium_after
from wavequake.optics.zemax.rows import Line, Row, as_count, as_integer, as_number, fail
from wavequake.optics.zemax.surfaces import coordinate_break, opening, shape
from wavequake.user_files import read_bytes

MM_PER_UNIT = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0}


@dataclass(frozen=True)
class _File:
    """The lines of the header by keyword, and the rows of the lens data editor."""

    where: str
    header: dict[str, list[Line]]
    rows: tuple[Row, ...]

    def first(self, keyword: str) -> Line | None:
        lines = self.header.get(keyword)
        return lines[0] if lines else None


def read_zmx(path: str | Path) -> OpticalSystem:
    """Read a sequential .zmx file in UTF-16, UTF-8 or Latin-1.

    The origin is where the first surface after the object stands.

    Raises
    ------
    UserError
        If the file cannot be read, is no sequential lens file, or holds something that is not supported:
        the message names it, its line, and the surface.
    """
    return parse_zmx(read_text(path), str(path))


def read_text(path: str | Path) -> str:
    """Return the text of a .zmx file, whose encoding is told by its first bytes."""
    if not isinstance(path, str | Path):
        raise UserError(f"The lens file is {path!r}; it must be the path of a file, as text.")
    try:
        data = read_bytes(path)
    except UserError as error:
        raise UserError(f"The lens file {error}") from None
    encodings = ("utf-16",) if data[:2] in (b"\xff\xfe", b"\xfe\xff") else ("utf-8-sig", "latin-1")
    for encoding in encodings:
        try:
            return data.decode(encoding)
        except UnicodeDecodeError:
            continue
    raise UserError(f"The lens file {path} says that it is UTF-16, but it is not.")


def parse_zmx(text: str, where: str) -> OpticalSystem:
    """Return the system that the text of a .zmx file describes; `where` names it in messages."""
    file = _parsed(text, where)
    require_supported(file.header)
    scale = _scale(file)
    rows, stop = _prescription(file, scale)
    surfaces = sequential(rows)
    distance = _thickness(file.rows[0], scale)
    if not math.isinf(distance):
        distance += float(surfaces[0].position[2])
    wavelengths, primary = _wavelengths(file)
    fields, telecentric = _fields(file, scale, infinite=math.isinf(distance))
    name = file.first("NAME")
    system = OpticalSystem(
        name=(name.rest if name else "") or Path(where).stem,
        surfaces=surfaces,
        stop=stop,
        pupil=_pupil(file, scale),
        object_distance=distance,
        fields=fields,
        wavelengths=wavelengths,
        primary_wavelength=primary,
        telecentric=telecentric,
        medium=_object_medium(file.rows[0]),
        note=left_aside(file.header, file.rows[0].line.number),
    )
    try:
        require_system(system)
    except UserError as error:
        raise UserError(f"{where}: {error}.") from None
    return system


def _parsed(text: str, where: str) -> _File:
    header: dict[str, list[Line]] = {}
    rows: list[Row] = []
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
        elif inside and raw[0] in " \t":
            rows[-1].lines.setdefault(line.keyword, []).append(line)
        else:
            inside = False
            header.setdefault(line.keyword, []).append(line)
    if len(rows) < 2:
        raise UserError(
            f"{where} is no sequential lens file: it has {len(rows)} SURF lines, an object and an image at "
            "least are needed."
        )
    return _File(where, header, tuple(rows))


def _scale(file: _File) -> float:
    unit = file.first("UNIT")
    if unit is None:
        return 1.0
    if not unit.words or unit.words[0] not in MM_PER_UNIT:
        fail(unit, f"the unit {unit.rest[:12]!r} is not supported, one of {', '.join(MM_PER_UNIT)} is")
    return MM_PER_UNIT[unit.words[0]]


def _prescription(file: _File, scale: float) -> tuple[list[SurfaceRow | Break], int]:
    """Return the rows after the object, and the index of the stop among the surfaces."""
    rows: list[SurfaceRow | Break] = []
    stops: list[tuple[int, Row]] = []
    medium: Medium | GradientIndex = _object_medium(file.rows[0])
    count = 0
    for row in file.rows[1:]:
        row.require_known()
        if "STOP" in row.lines:
            stops.append((count, row))
        thickness = 0.0 if row is file.rows[-1] else _thickness(row, scale)
        if math.isinf(thickness):
            fail(row.lines["DISZ"][0], f"{row.label} has an infinite thickness, only the object may")
        if row.type == "COORDBRK":
            if "STOP" in row.lines:
                fail(row.line, f"{row.label} is a coordinate break, which cannot be the stop")
            rows.append(coordinate_break(row, scale, thickness))
            continue
        action, medium = medium_after(row, medium, scale)
        rows.append(
            SurfaceRow(
                name=row.label,
                shape=shape(row, scale),
                thickness=thickness,
                action=action,
                medium=medium if action == "refract" else AIR,
                opening=opening(row, scale),
            )
        )
        count += 1
    if len(stops) != 1:
        places = ", ".join(row.label for _, row in stops) or "none"
        raise UserError(
            f"{file.where} needs exactly one surface with STOP after the object; it has {places}."
        )
    image = rows[-1]
    if isinstance(image, Break) or image.action != "pass":
        fail(
            file.rows[-1].line,
            "the last surface is the image: it cannot be a coordinate break or a mirror, nor end a glass "
            "(give it the same glass, or add a surface before it)",
        )
    return rows, stops[0][0]


def _object_medium(row: Row) -> Medium:
    """Return the medium before the first surface; the object must be a plane without any property."""
    curvature = row.one("CURV")
    if row.type != "STANDARD" or (
        curvature and as_number(curvature, 0) and not math.isinf(_thickness(row, 1.0))
    ):
        fail(curvature or row.line, "the object is no plane; move the curvature to a surface of its own")
    action, medium = medium_after(row, AIR, 1.0)
    if action == "reflect" or isinstance(medium, GradientIndex):
        fail(row.line, "the object cannot be a mirror")
    return medium


def _thickness(row: Row, scale: float) -> float:
    line = row.one("DISZ")
    if line is None:
        return 0.0
    if line.words[:1] == ["INFINITY"]:
        return math.inf
    return as_number(line, 0) * scale


def _pupil(file: _File, scale: float) -> Pupil:
    given = [line for keyword in PUPILS for line in file.header.get(keyword, [])]
    if len(given) != 1:
        found = ", ".join(line.keyword for line in given) or "none"
        raise UserError(f"{file.where} needs one of {', '.join(PUPILS)} for the aperture; it has {found}.")
    line = given[0]
    if line.keyword == "FLOA":
        stop = next(row for row in file.rows if "STOP" in row.lines)
        radius = stop.one("DIAM")
        if radius is None or as_number(radius, 0) <= 0:
            fail(line, f"the stop, {stop.label}, limits the beam but has no semi-diameter (DIAM)")
        return Pupil("stop", as_number(radius, 0) * scale)
    value = as_number(line, 0)
    kind = as_integer(line, 1) if len(line.words) > 1 else 0
    if not value > 0:
        fail(line, f"the aperture must be positive, it is {value:g}")
    if line.keyword == "ENPD":
        return Pupil("entrance_diameter", value * scale)
    if line.keyword == "FNUM":
        # Type 0 is focal length over entrance pupil, type 1 that of the marginal ray to the real image.
        if not kind and not math.isinf(_thickness(file.rows[0], scale)):
            fail(
                line, "the f-number of an object at infinity is given for a finite one; give the working one"
            )
        return Pupil("f_number", value)
    if kind:
        fail(line, "an aperture given by an object cone angle is not supported; give the object's NA")
    if math.isinf(_thickness(file.rows[0], scale)):
        fail(line, "an object at infinity has no numerical aperture; give the entrance pupil (ENPD)")
    return Pupil("object_na", value)


def _wavelengths(file: _File) -> tuple[np.ndarray, int]:
    kind = file.first("FTYP")
    listed = file.first("WAVL")
    if listed:
        values = [_from_microns(listed, index) for index in range(len(listed.words))]
    else:
        lines = sorted(file.header.get("WAVM", []), key=lambda line: as_integer(line, 0))
        if not lines:
            raise UserError(f"{file.where} gives no wavelength (WAVM or WAVL).")
        values = [_from_microns(line, 1) for line in lines]
    if kind and len(kind.words) > 3:
        values = values[: as_count(kind, 3)]
    chosen = file.first("PWAV")
    primary = as_integer(chosen, 0) - 1 if chosen else 0
    if not 0 <= primary < len(values):
        fail(
            chosen or Line(file.where, 0, "PWAV", ""),
            f"there are {len(values)} wavelengths, not {primary + 1}",
        )
    return np.array(values), primary


def _from_microns(line: Line, index: int) -> float:
    """Return a wavelength in mm; the decimal point is shifted, so 0.48 um is 480e-6 mm to the bit."""
    if not as_number(line, index) > 0:
        fail(line, f"the wavelength {line.words[index]} um is not positive")
    return float(Decimal(line.words[index]).scaleb(-3))


def _fields(file: _File, scale: float, infinite: bool) -> tuple[np.ndarray, bool]:
    kind = file.first("FTYP")
    code = as_integer(kind, 0) if kind else 0
    telecentric = bool(kind and len(kind.words) > 1 and as_integer(kind, 1))
    if kind and code not in (0, 1):
        names = {2: "paraxial image height", 3: "real image height", 4: "theodolite angle"}
        fail(
            kind,
            f"fields by {names.get(code, f'type {code}')} are not supported; use angles or object heights",
        )
    if kind and len(kind.words) > 6 and as_integer(kind, 6):
        fail(kind, "an afocal image space is not supported; add a focusing surface")
    if infinite != (code == 0):
        fail(
            kind or file.rows[0].line,
            "fields must be angles for an object at infinity and object heights for a finite one",
        )
    values = []
    for keywords in (("XFLN", "XFLD"), ("YFLN", "YFLD")):
        line = next((line for keyword in keywords for line in file.header.get(keyword, [])), None)
        values.append([as_number(line, index) for index in range(len(line.words))] if line else [0.0])
    count = as_count(kind, 2) if kind and len(kind.words) > 2 else max(map(len, values))
    padded: Sequence[list[float]] = [(row + [0.0] * count)[:count] for row in values]
    fields = np.array(padded).T
    return (np.deg2rad(fields) if infinite else fields * scale), telecentric
