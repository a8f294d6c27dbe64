"""Read optical systems from Zemax's sequential lens files (.zmx).

What changes the light and an `OpticalSystem` cannot express is refused: all that a file has of it at once, by
name and line. What is not understood otherwise is named in the system's note. Solves and pickups need
nothing: the file holds the values that they gave. Two conventions differ from Zemax's default: rays are
always aimed at the real stop, and a semi-diameter stops light only where the surface has an aperture (as in
Zemax). Signs are the same: thicknesses are negative after an odd number of mirrors.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import MOST_SURFACES
from wavequake.optics.media.environment import Environment
from wavequake.optics.media.glasses import AIR, Medium
from wavequake.optics.media.gradients import GradientIndex
from wavequake.optics.rays.aiming import require_light
from wavequake.optics.shapes.shapes import Conic
from wavequake.optics.systems.apodization import Apodization
from wavequake.optics.systems.kinematics import Break, SurfaceRow, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil, require_system
from wavequake.optics.text_file import read_text
from wavequake.optics.zemax.apertures import beside_stop, with_pupil
from wavequake.optics.zemax.configurations import count_of, with_configuration, with_solved_image
from wavequake.optics.zemax.fields import is_afocal, is_telecentric, wavelengths, with_fields
from wavequake.optics.zemax.header import apodization_of, environment_of, left_aside, require_supported
from wavequake.optics.zemax.lens_file import LensFile, Problems, parsed, scale_of
from wavequake.optics.zemax.media import CRYSTALS, GlassShelf, medium_after, picked_up
from wavequake.optics.zemax.phases import phase
from wavequake.optics.zemax.rows import OPENINGS, Row, as_number, fail
from wavequake.optics.zemax.surfaces import (
    coordinate_break,
    opening,
    own_breaks,
    reaches_beyond,
    shape,
    tilted_image,
)


def read_zmx(
    path: str | Path, glasses: Mapping[str, Medium] | None = None, configuration: int | None = None
) -> OpticalSystem:
    """Read a sequential .zmx file in UTF-16, UTF-8 or Latin-1.

    The origin is where the first surface after the object stands.

    Parameters
    ----------
    path : str or Path
    glasses : mapping of str to Medium, optional
        Glasses by name, in upper case, that go before those of the catalogues, as
        `wavequake.optics.media.agf.read_agf` returns them.
    configuration : int, optional
        Which configuration, from 1; that in which the file was saved by default.

    Raises
    ------
    UserError
        If the file cannot be read, is no sequential lens file, or holds something that is not supported:
        the message names it, its line, and the surface.
    """
    return parse_zmx(read_text(path), str(path), glasses, configuration)


def parse_zmx(
    text: str, where: str, glasses: Mapping[str, Medium] | None = None, configuration: int | None = None
) -> OpticalSystem:
    """Return the system that the text of a .zmx file describes; `where` names it in messages."""
    return system_of(parsed(text, where), glasses, configuration)


def system_of(
    file: LensFile, glasses: Mapping[str, Medium] | None = None, configuration: int | None = None
) -> OpticalSystem:
    """Return the system that the lines of a lens file describe; raises as `read_zmx`."""
    file = with_configuration(file, configuration)
    where, problems = file.where, Problems()
    with problems.collected():
        file = _from_the_object(replace(file, rows=picked_up(file.rows)))
    catalogues = file.first("GCAT")
    shelf = GlassShelf(glasses or {}, tuple(catalogues.words) if catalogues else ())
    with problems.collected():
        require_supported(file.header)
        shelf = replace(shelf, environment=environment_of(file.header))
    apodization: Apodization | None = None
    with problems.collected():
        apodization = apodization_of(file.header)
    scale = 1.0
    with problems.collected():
        scale = scale_of(file)
    waves, primary = np.array([550e-6]), 0
    with problems.collected():
        waves, primary = wavelengths(file)
    medium: Medium = AIR
    with problems.collected():
        medium = _object_medium(file.rows[0], shelf)
    rows, stop = _prescription(file, scale, medium, shelf, problems)
    count = sum(isinstance(row, SurfaceRow) for row in rows)
    if count > MOST_SURFACES:  # before all that takes long with so many
        problems.found.append(f"{where} has {count} surfaces; at most {MOST_SURFACES} can be traced.")
    problems.require_none(file)
    surfaces = sequential(rows)
    distance = _thickness(file.rows[0], scale)
    if not math.isinf(distance):
        distance += float(surfaces[0].position[2])
    name = file.first("NAME")
    system = OpticalSystem(
        name=_called((name.rest if name else "") or Path(where).stem, configuration),
        surfaces=surfaces,
        stop=stop,
        pupil=Pupil("stop", 1.0),  # replaced below
        object_distance=distance,
        wavelengths=waves,
        primary_wavelength=primary,
        telecentric=is_telecentric(file) and not math.isinf(distance),
        medium=medium,
    )
    notes: list[str] = []
    with problems.collected():
        system = with_pupil(system, file, scale)
    if not problems.found:
        with problems.collected():
            if configuration is not None:
                system = with_solved_image(system, file, scale)
            system, notes = _with_real_chief_rays(system)
            notes += beside_stop(system, file)
            system = with_fields(system, file, scale)
            notes += _right_angles(system)
    problems.require_none(file)
    system = replace(system, pupil=replace(system.pupil, apodization=apodization))
    system = replace(system, note=" ".join([*_notes(file, configuration), *notes, *shelf.notes]))
    with problems.collected():
        try:
            require_system(system)
        except UserError as error:
            raise UserError(f"{where}: {error}.") from None
    problems.require_none(file)
    return system


def _with_real_chief_rays(system: OpticalSystem) -> tuple[OpticalSystem, list[str]]:
    """Return a system whose chief rays pass the center of the stop, and what is to be said of that."""
    if not system.telecentric:
        return system, []
    try:
        require_light(system)
    except UserError:
        sentence = (
            "The file says that chief rays leave the object parallel to the axis, but its stop stands where "
            "they do not; here they go through the center of the stop."
        )
        return replace(system, telecentric=False), [sentence]
    return system, []


def _right_angles(system: OpticalSystem) -> list[str]:
    """Return a sentence about fields at right angles to the axis, by the semi-diameters of four fish-eyes."""
    right = np.abs(np.abs(system.fields) - np.pi / 2.0) < 1e-9
    if math.isinf(system.object_distance) and right.any():
        return ["OpticStudio traces a field of 90 degrees as one of 89.8; here it is 90."]
    return []


def _called(name: str, configuration: int | None) -> str:
    return name if configuration is None else f"{name}, configuration {configuration}"


def _notes(file: LensFile, configuration: int | None) -> list[str]:
    """Return sentences about what the system leaves out of the file."""
    found = [left_aside(file.header, file.rows)]
    around = environment_of(file.header)
    if around is not None and around != Environment():
        found.append(
            f"Indices of glasses are those at {around.temperature_c:g} degrees Celsius and "
            f"{around.pressure_atm:g} atmospheres; shapes and distances are as the file gives them."
        )
    count, saved = count_of(file)
    if count > 1 and configuration is None:
        found.append(f"The file has {count} configurations; this is number {saved}, in which it was saved.")
    if is_afocal(file):
        found.append(
            "The file says that light leaves the system parallel; wavefronts need a focusing surface."
        )
    rings = [
        row.label
        for row in file.rows
        if (line := row.one("OBSC")) and as_number(line, 0) > 0.0 and not reaches_beyond(row, line)
    ]
    if rings:
        names = ", ".join(dict.fromkeys(rings))
        found.append(f"Ring-shaped obscurations stop here all light beyond their inner radius: {names}.")
    if crystals := ", ".join(dict.fromkeys(row.label for row in file.rows if row.type == CRYSTALS[0])):
        found.append(f"Of crystals the ordinary ray is traced, as the file does: {crystals}.")
    if ellipses := ", ".join(
        dict.fromkeys(row.label for row in file.rows if row.one("ELAP") or row.one("ELOB"))
    ):
        found.append(f"Elliptic apertures are polygons of 72 corners and the same area here: {ellipses}.")
    return [one for one in found if one]


def _prescription(
    file: LensFile, scale: float, medium: Medium | GradientIndex, shelf: GlassShelf, problems: Problems
) -> tuple[list[SurfaceRow | Break], int]:
    """Return the rows after the object, and the index of the stop among the surfaces."""
    rows: list[SurfaceRow | Break] = []
    stops: list[tuple[int, Row]] = []
    count = 0
    for row in file.rows[1:]:
        last = row is file.rows[-1]
        with problems.collected():
            row.require_supported()
        thickness = 0.0
        with problems.collected():
            thickness = 0.0 if last else _finite_thickness(row, scale)
        if "STOP" in row.lines:
            stops.append((count, row))
        if row.type == "COORDBRK":
            with problems.collected():
                if last:
                    fail(row.line, "the last surface is the image: it cannot be a coordinate break")
                _require_upright(row)
                at_stop = "STOP" in row.lines
                rows.append(coordinate_break(row, scale, 0.0 if at_stop else thickness))
                if at_stop:  # the plane to which it leads
                    rows.append(SurfaceRow(row.label, Conic(), thickness))
                    count += 1
            continue
        before, after = None, None
        with problems.collected():
            before, after = own_breaks(row, scale)
            after = None if last else after
        one = SurfaceRow(row.label, Conic(), thickness)
        with problems.collected():
            action, medium = medium_after(row, medium, scale, shelf)
            if not last:  # nothing happens behind the image
                one = replace(one, action=action, medium=medium if action == "refract" else AIR)
        with problems.collected():
            one = replace(one, shape=shape(row, scale), phase=phase(row, scale))
        if last and row.type == "TILTSURF":
            before, one = None, replace(one, shape=tilted_image(row))
        with problems.collected():
            one = replace(one, opening=opening(row, scale))
        if after is not None:
            one, after = replace(one, thickness=0.0), replace(after, thickness=thickness)
        rows.extend(part for part in (before, one, after) if part is not None)
        count += 1
    if len(stops) != 1:
        places = ", ".join(row.label for _, row in stops) or "none"
        problems.found.append(
            f"{file.where} needs exactly one surface with STOP after the object; it has {places}."
        )
        return rows, 0
    return rows, stops[0][0]


def _from_the_object(file: LensFile) -> LensFile:
    """Return the file without the planes that stand on its object and do nothing.

    Spectrographs have them: the slit as the object, and once more as the first surface.
    """
    first, *others = file.rows
    while len(others) > 2 and _thickness(first, 1.0) == 0.0 and _does_nothing(others[0]):
        line = others[0].one("DISZ") or first.line
        first, others = replace(first, lines=first.lines | {"DISZ": [line]}), others[1:]
    return replace(file, rows=(first, *others))


def _does_nothing(row: Row) -> bool:
    curvature = row.one("CURV")
    return (
        row.type == "STANDARD"
        and not (curvature and as_number(curvature, 0))
        and not {"STOP", "GLAS", "SCBD", "PARM", *OPENINGS} & set(row.lines)
    )


def _finite_thickness(row: Row, scale: float) -> float:
    thickness = _thickness(row, scale)
    if math.isinf(thickness):
        fail(row.lines["DISZ"][0], f"{row.label} has an infinite thickness, only the object may")
    return thickness


def _require_upright(row: Row) -> None:
    if own_breaks(row, 1.0) != (None, None):
        fail(
            row.lines["SCBD"][0],
            f"{row.label} has a tilt or decenter of its own, which is not supported there",
        )


def _object_medium(row: Row, shelf: GlassShelf) -> Medium:
    """Return the medium before the first surface; the object must be a plane without any property."""
    curvature = row.one("CURV")
    if row.type != "STANDARD" or (
        curvature and as_number(curvature, 0) and not math.isinf(_thickness(row, 1.0))
    ):
        fail(curvature or row.line, "the object is no plane; move the curvature to a surface of its own")
    _require_upright(row)
    action, medium = medium_after(row, AIR, 1.0, shelf)
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
