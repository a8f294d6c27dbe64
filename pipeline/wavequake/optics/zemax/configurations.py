"""Configurations of a .zmx file: what a row of the multi-configuration editor puts in the place of a number.

Behind the surfaces, ``MNUM count saved`` is followed by lines ``OPERAND index configuration value``, each
operand for configurations 1 to count in turn. The rest of the file holds the configuration in which it was
saved; the distance of the image is found anew where a marginal ray gives it (``MAZH height zone``).
"""

from dataclasses import replace

import numpy as np

from wavequake.errors import UserError
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.rays.aiming import aimed_rays
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, wavelength_of
from wavequake.optics.zemax.lens_file import LensFile
from wavequake.optics.zemax.rows import Line, Row, as_integer, as_number, fail

_OF_SURFACES = {"THIC": "DISZ", "CRVT": "CURV", "CONN": "CONI", "SDIA": "DIAM"}
_OF_FIELDS = {
    "XFIE": "XFLN",
    "YFIE": "YFLN",
    **{f"F{key}": f"{key}N" for key in ("VDX", "VDY", "VCX", "VCY", "VAN")},
}
_APERTURES = ("ENPD", "FNUM", "OBNA")
_NOTHING = ("MOFF",)
READ = ("APER", "WAVE", *_OF_SURFACES, *_OF_FIELDS)
"""Operands that are read."""
_SOLVES = ("MAZH", "PZUP", "PKUP", "PPAR")  # of thicknesses, curvatures, conic constants and parameters
_INFINITE = 1e10


def count_of(file: LensFile) -> tuple[int, int]:
    """Return how many configurations a file has, and in which one it was saved, from 1."""
    lines = [line for line in file.behind if line.keyword == "MNUM"]
    if not lines:
        return 1, 1
    first, *others = lines
    count, saved = as_integer(first, 0), as_integer(first, 1) if len(first.words) > 1 else 1
    if not 1 <= saved <= count:
        fail(first, f"the file cannot have {count} configurations and be saved in number {saved}")
    if others:
        fail(others[0], "the number of configurations is given twice")
    return count, saved


def with_configuration(file: LensFile, number: int | None) -> LensFile:
    """Return a file as it is in one of its configurations; None leaves it in the one in which it was saved.

    Raises
    ------
    UserError
        If there is no such configuration, the file does not say what it changes, it changes something that
        is not read, or the file holds what was solved for the one in which it was saved.
    """
    if number is None:
        return file
    count, saved = count_of(file)
    if not 1 <= number <= count:
        raise UserError(f"{file.where} has {count} configurations; there is no number {number}.")
    if number == saved:
        return file
    lines = _operands(file, count)
    if not lines:
        raise UserError(f"{file.where} does not say what its {count} configurations change.")
    given = _numbers(lines)
    solved = {("DISZ", key[1]) for key in given if key[0] == "THIC"}
    for (operand, index, configuration), line in given.items():
        if configuration == number and (operand in READ or not _same(line, given[operand, index, saved])):
            file = _changed(file, line, operand, index)
    _require_no_solves(file, solved)
    return file


def _operands(file: LensFile, count: int) -> list[Line]:
    """Return the lines of the editor: each operand for all configurations in turn; others end them."""
    place = next(k for k, line in enumerate(file.behind) if line.keyword == "MNUM") + 1
    found: list[Line] = []
    while True:
        block = file.behind[place : place + count]
        heads = [(line.keyword, *line.words[:2]) for line in block]
        if len(block) < count or any(
            head != (heads[0][0], *heads[0][1:2], str(k)) for k, head in enumerate(heads, start=1)
        ):
            break
        found += block
        place += count
    torn = next((line for line in file.behind[place:] if line.keyword in READ), None)
    if torn is not None:
        fail(torn, f"{torn.keyword} must have a line for each of configurations 1 to {count}, in this order")
    return found


def _numbers(lines: list[Line]) -> dict[tuple[str, int, int], Line]:
    """Return the lines of the editor by operand, index and configuration."""
    given: dict[tuple[str, int, int], Line] = {}
    for line in lines:
        key = line.keyword, as_integer(line, 0), as_integer(line, 1)
        if key[0] not in _NOTHING and not _same(given.setdefault(key, line), line):
            fail(line, f"{key[0]} {key[1]} has another value in line {given[key].number}")
    return given


def _same(line: Line, other: Line) -> bool:
    return line.words[2:3] == other.words[2:3]


def _changed(file: LensFile, line: Line, operand: str, index: int) -> LensFile:
    """Return the file with the value of a line in its place."""
    if operand in _NOTHING:
        return file
    if operand not in READ:
        fail(line, f"the configuration changes {operand}, which is not supported; {', '.join(READ)} are")
    value = as_number(line, 2)
    if operand in _OF_SURFACES:
        if not 0 <= index < len(file.rows):
            fail(line, f"there is no surface {index}")
        keyword = _OF_SURFACES[operand]
        text = "INFINITY" if operand == "THIC" and abs(value) >= _INFINITE else repr(value)
        row = file.rows[index]
        changed = _with_word(row.one(keyword), line, keyword, 0, text)
        new = replace(row, lines={**row.lines, keyword: [changed]})
        return replace(file, rows=tuple(new if one is row else one for one in file.rows))
    if operand == "WAVE":
        waves = file.header.get("WAVM", [])
        which = next((k for k, wave in enumerate(waves) if wave.words[:1] == [str(index)]), None)
        if which is None:
            fail(line, f"there is no wavelength {index}")
        changed = _with_word(waves[which], line, "WAVM", 1, repr(value))
        waves = [*waves[:which], changed, *waves[which + 1 :]]
        return replace(file, header={**file.header, "WAVM": waves})
    keyword = _OF_FIELDS.get(operand) or next((key for key in _APERTURES if key in file.header), "")
    if not keyword:
        fail(line, "the configuration changes an aperture that the file does not have")
    word = index - 1 if operand in _OF_FIELDS else 0
    if not 0 <= word < 100:
        fail(line, f"there is no field {index}")
    header = {**file.header, keyword: [_with_word(file.first(keyword), line, keyword, word, repr(value))]}
    return replace(file, header=header)


def _with_word(line: Line | None, other: Line, keyword: str, place: int, text: str) -> Line:
    """Return a line with another word at a place; without one, zeros stand before it."""
    words = line.words if line is not None else []
    words = words + ["0"] * (place + 1 - len(words))
    words[place] = text
    return Line(other.where, line.number if line is not None else other.number, keyword, " ".join(words))


def _require_no_solves(file: LensFile, given: set[tuple[str, int]]) -> None:
    """Refuse numbers that a solve found for the configuration in which the file was saved."""
    for row in file.rows:
        line = _solve(row)
        if line is None or ("DISZ", row.number) in given or (line.keyword, row) == ("MAZH", file.rows[-2]):
            continue
        fail(
            line,
            f"{row.label} has a number that a solve or pickup found for configuration {count_of(file)[1]}, "
            "in which the file was saved; save it in the configuration that you want",
        )


def _solve(row: Row) -> Line | None:
    """Return the line of a solve or pickup of a surface; the word behind a curvature is 1 for a variable."""
    curvature = row.one("CURV")
    if curvature is not None and len(curvature.words) > 1 and curvature.words[1] not in ("0", "1"):
        return curvature
    return next((row.lines[key][0] for key in _SOLVES if key in row.lines), None)


def with_solved_image(system: OpticalSystem, file: LensFile, scale: float) -> OpticalSystem:
    """Return a system whose image stands where a marginal ray has its height, if the file says so.

    The zone 0 is that of paraxial rays; others are those of real rays of the point on the axis.
    """
    line = file.rows[-2].one("MAZH")
    if line is None:
        return system
    height, zone = as_number(line, 0) * scale, as_number(line, 1)
    if abs(zone) > 1.0:
        fail(line, f"{file.rows[-2].label} is solved for the zone {zone:g}; zones are between -1 and 1")
    axis = replace(system, fields=np.zeros((1, 2)), vignetting=())
    wave = wavelength_of(system)
    if not zone:
        if height:
            fail(line, f"{file.rows[-2].label} is solved for a paraxial height other than 0")
        way = -paraxial(axis).defocus
    else:
        aimed = aimed_rays(axis, axis.fields[0], wave, np.zeros(1), np.array([zone]), openings=False)
        rest = moving(axis, rest_states(axis))
        found = trace_sequence_numpy(pack(axis, wave), aimed.rays, rest, ignore_apertures=True)
        u, v = float(found.u[0, 0]), float(found.v[0, 0])
        w = float(found.w_sign[0, 0]) * np.sqrt(1.0 - u * u - v * v)
        way = float((height - found.y[0, 0]) * w / v) if v else np.nan
    if not np.isfinite(way):
        fail(line, f"the marginal ray of {file.rows[-2].label} does not come to an image")
    image = system.surfaces[-1]
    moved = replace(image, position=image.position + way * image.rotation[:, 2])
    return replace(system, surfaces=(*system.surfaces[:-1], moved))
