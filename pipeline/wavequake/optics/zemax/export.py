"""Write optical systems to Zemax's sequential lens files (.zmx).

The system's z axis becomes the file's axis; a surface that is shifted or tilted stands between two coordinate
breaks, the second of which undoes the first. An obscured pupil becomes a dark center of the stop, a numerical
aperture in the image its f-number, annular Zernike polynomials the circular ones of which they are sums.
Further apertures of a surface stand on equal surfaces before it. What the format cannot hold is refused by
name.
"""

import math
import os
import uuid
from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal
from itertools import islice, permutations
from pathlib import Path
from typing import TypeGuard

import numpy as np

from wavequake.errors import UserError
from wavequake.optics.checks import require_fields, require_kind
from wavequake.optics.media.agf import EXPORTED, agf_text, has_formula
from wavequake.optics.media.glasses import AIR, Medium, catalogues, medium_label
from wavequake.optics.media.gradients import GradientIndex
from wavequake.optics.polynomials.transforms import transform_coefficients
from wavequake.optics.shapes.shapes import (
    Conic,
    EvenAsphere,
    ExtendedPolynomial,
    GridSag,
    Opening,
    Shape,
    ZernikeSag,
)
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, Surface, wavelength_of
from wavequake.optics.zemax.gradients import gradient_lines
from wavequake.optics.zemax.grids import grid_lines
from wavequake.optics.zemax.media import MODEL_GLASS, GlassShelf
from wavequake.optics.zemax.openings import apertures
from wavequake.optics.zemax.own_glasses import is_known, of_maker, own_glasses, own_name
from wavequake.optics.zemax.phases import MAX_EVEN_TERMS, phase_lines
from wavequake.optics.zemax.rows import written
from wavequake.optics.zemax.surfaces import MAX_TERMS, cardan_angles

MAX_FIELDS = 12
MAX_WAVELENGTHS = 24

# Circular over annular coefficients: beyond, a surface would lose more than 1e-8 of its heights.
_MOST_GROWTH = 1e7
_LISTS = {  # of coefficients: the surface type, what it is, and how many it may have
    EvenAsphere: ("EVENASPH", "an even asphere", MAX_EVEN_TERMS),
    ExtendedPolynomial: ("XPOLYNOM", "an extended polynomial", MAX_TERMS["XPOLYNOM"]),
    ZernikeSag: ("SZERNSAG", "a Zernike sag", MAX_TERMS["SZERNSAG"]),
}


def write_zmx(system: OpticalSystem, path: str | Path) -> Path:
    """Write a system as a sequential .zmx file (UTF-16); an existing file is replaced in one step.

    Glasses that no catalogue has stand beside it in one of their own: ``lens.agf`` for ``lens.zmx``. It
    replaces no catalogue that was not written so.

    Returns
    -------
    Path

    Raises
    ------
    UserError
        If the folder is missing, another catalogue would be replaced, or the system has something that the
        format cannot hold: names it.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from wavequake.optics.catalog.names import optical_system
    >>> with TemporaryDirectory() as folder:
    ...     write_zmx(optical_system("double-gauss"), Path(folder) / "lens.zmx").name
    'lens.zmx'
    """
    target = Path(path) if isinstance(path, str | Path) else Path()
    if not target.name:
        raise UserError(f"The path {path!r} of the lens file is no name of a file, such as 'lens.zmx'.")
    beside = target.with_suffix(".agf")
    text, own = zmx_text(system, beside.stem), own_glasses(system)
    if own:
        if beside.exists() and not beside.read_bytes().startswith(EXPORTED.encode("utf-16")):
            raise UserError(
                f"{beside} is a catalogue that another lens file may need, and the glasses of {target.name} "
                "would replace it; choose another name."
            )
        _replace(beside, agf_text(own).encode("utf-16"))
    _replace(target, text.replace("\n", "\r\n").encode("utf-16"))
    return target


def _replace(target: Path, content: bytes) -> None:
    partial = target.with_name(f".{target.name}.partial-{uuid.uuid4().hex}")
    try:
        partial.write_bytes(content)
        os.replace(partial, target)
    except OSError as error:
        raise UserError(f"The lens file {target} cannot be written: {error.strerror}.") from None
    finally:
        partial.unlink(missing_ok=True)


def zmx_text(system: OpticalSystem, catalogue: str = "") -> str:
    """Return the text of a .zmx file; the origin moves along z to the first surface.

    ``catalogue`` names that of the system's `own_glasses`.
    """
    require_kind(system, OpticalSystem, "what is written", ", such as load_system('double-gauss') returns")
    require_fields(system, f"the system {system.name}")
    _require_one_line(system.name, "the system")
    lines = ["MODE SEQ", f"NAME {system.name}", "UNIT MM X W X CM MR CPMM", *_pupil(system)]
    lines += [*_apodization(system), *_fields(system)]
    lines += [*_catalogues(system, catalogue), "RAIM 0 1 1 1 0 0 0 0 0 1"]  # aimed at the paraxial stop
    lines += [*_environment(system), *_wavelengths(system), *_note(system)]
    infinite = math.isinf(system.object_distance)
    distance = "INFINITY" if infinite else written(system.object_distance)
    rows = [["TYPE STANDARD", "CURV 0.0", f"DISZ {distance}", *_glass(system.medium, system.name)]]
    begins = Surface("object", medium=system.medium)
    for index, surface in enumerate(system.surfaces):
        before = begins.medium
        if surface.action == "refract":
            begins = surface
        rows += _rows(system, index, before, begins)
    for number, row in enumerate(rows):
        lines += [f"SURF {number}", *(f"  {line}" for line in row)]
    return "\n".join(lines) + "\n"


def _require_one_line(name: str, what: str) -> None:
    if not name.isprintable() or name != name.strip().strip('"'):
        raise UserError(f"The name {name!r} of {what} must be one line without blanks or quotes at its ends.")


def _pupil(system: OpticalSystem) -> list[str]:
    pupil = system.pupil
    if pupil.kind == "entrance_diameter":
        return [f"ENPD {written(pupil.value)}"]
    if pupil.kind == "object_na":
        return [f"OBNA {written(pupil.value)} 0"]
    if pupil.kind == "stop":
        return ["FLOA"]
    f_number = 0.5 / pupil.value if pupil.kind == "image_na" else pupil.value
    return [f"FNUM {written(f_number)} 1"]


def _apodization(system: OpticalSystem) -> list[str]:
    given = system.pupil.apodization
    if given is None:
        return []
    return [f"GFAC {written(given.factor)} 1" if given.kind == "gaussian" else "GFAC 0.0 2"]


def _fields(system: OpticalSystem) -> list[str]:
    count, waves = len(system.fields), len(system.wavelengths)
    if not (1 <= count <= MAX_FIELDS and 1 <= waves <= MAX_WAVELENGTHS):
        raise UserError(
            f"{system.name} has {count} fields and {waves} wavelengths; a lens file holds 1 to {MAX_FIELDS} "
            f"and 1 to {MAX_WAVELENGTHS}."
        )
    heights = not math.isinf(system.object_distance)
    values = system.fields if heights else np.rad2deg(system.fields)
    padded = np.zeros((MAX_FIELDS, 2))
    padded[:count] = values
    return [
        f"FTYP {int(heights)} {int(system.telecentric)} {count} {waves} 0 0 0",
        "XFLN " + " ".join(written(value) for value in padded[:, 0]),
        "YFLN " + " ".join(written(value) for value in padded[:, 1]),
        *_vignetting(system),
    ]


def _vignetting(system: OpticalSystem) -> list[str]:
    """Return which part of the stop the light of each field fills, if not all of it."""
    if not system.vignetting:
        return []
    factors = np.zeros((MAX_FIELDS, 5))
    factors[: len(system.vignetting)] = system.vignetting
    factors[:, 4] = np.rad2deg(factors[:, 4])
    rows = zip(("VDXN", "VDYN", "VCXN", "VCYN", "VANN"), factors.T, strict=True)
    return [f"{keyword} {' '.join(written(value) for value in values)}" for keyword, values in rows]


def _wavelengths(system: OpticalSystem) -> list[str]:
    # A shift of the decimal point is exact, a multiplication is not.
    microns = [Decimal(written(value)).scaleb(3) for value in system.wavelengths]
    lines = [f"WAVM {number} {value} 1" for number, value in enumerate(microns, start=1)]
    return [*lines, f"PWAV {system.primary_wavelength + 1}"]


def _catalogues(system: OpticalSystem, catalogue: str) -> list[str]:
    """Return the line that names the catalogues of the glasses, in an order in which each is found."""
    own = own_glasses(system)
    first = ["".join(c if c.isalnum() else "_" for c in catalogue).upper() or "OWN"] if own else []
    media = (system.medium, *(surface.medium for surface in system.surfaces))
    plain = [replace(one, environment=None) for one in media if isinstance(one, Medium)]
    used = [one for one in plain if one == of_maker(one)]
    makers = [name for name in catalogues() if any(one.catalogue == name for one in used)]
    for order in islice(permutations(makers), 1000):
        shelf = GlassShelf({}, order)
        if all(shelf.find(one.name) == one and own_name(one) not in own for one in used):
            return ["GCAT " + " ".join([*first, *order])] if first or order else []
    names = ", ".join(sorted({medium_label(one) for one in used}))
    raise UserError(
        f"{system.name} has glasses of equal names of several makers ({names}), which a lens file cannot "
        "tell apart."
    )


def _environment(system: OpticalSystem) -> list[str]:
    """Return the line of temperature and pressure, if glasses have them."""
    media = (system.medium, *(surface.medium for surface in system.surfaces))
    found = {one.environment for one in media if isinstance(one, Medium) and one.catalogue}
    if not found - {None}:
        return []
    if len(found) > 1:
        raise UserError(
            f"{system.name} has glasses at several temperatures or pressures; a lens file has room for one."
        )
    (around,) = found
    assert around is not None
    return [f"ENVD {written(around.temperature_c)} {written(around.pressure_atm)} 1"]


def _glass(medium: Medium, name: str) -> list[str]:
    if medium == AIR:
        return []
    medium = replace(medium, environment=None)
    if is_known(medium):
        return [f"GLAS {medium.name} 0 0 1.5 40 0 0 0 0 0 0"]
    if medium.formula == "constant":
        return [f"GLAS {MODEL_GLASS} 1 0 {written(medium.coefficients[0])} 0 0 0 0 0 0 0"]
    if has_formula(medium):
        return [f"GLAS {own_name(medium)} 0 0 1.5 40 0 0 0 0 0 0"]
    raise UserError(
        f"The medium {medium.name} of {name} is no glass of the catalogue, and its formula "
        f"({medium.formula}) is none that catalogues have."
    )


def _rows(
    system: OpticalSystem, index: int, before: Medium | GradientIndex, begins: Surface
) -> list[list[str]]:
    """Return the rows of a surface, with its coordinate breaks where it needs them.

    ``before`` is the medium before it; ``begins`` the surface that begins the medium behind it.
    """
    surface, last = system.surfaces[index], index == len(system.surfaces) - 1
    gap = 0.0 if last else float(system.surfaces[index + 1].position[2] - surface.position[2])
    *on_it, lines = _surface(system, index, before, begins)
    x, y = (float(value) for value in surface.position[:2])
    tilts = [float(angle) for angle in np.rad2deg(cardan_angles(surface.rotation))]
    if not any((x, y, *tilts)):
        return [*on_it, [*lines, f"DISZ {written(gap)}"]]
    there = _break([x, y, *tilts], 0, 0.0)
    back = _break([-value for value in (x, y, *tilts)], 1, gap)
    return [there, *on_it, [*lines, "DISZ 0.0"]] + ([] if last else [back])


def _break(numbers: Sequence[float], order: int, gap: float) -> list[str]:
    parameters = [f"PARM {k} {written(value)}" for k, value in enumerate([*numbers, order], start=1)]
    return ["TYPE COORDBRK", *parameters, f"DISZ {written(gap)}"]


def _surface(
    system: OpticalSystem, index: int, before: Medium | GradientIndex, begins: Surface
) -> list[list[str]]:
    """Return a surface's lines but the distance, after rows of equal ones that hold further apertures."""
    surface = system.surfaces[index]
    _require_one_line(surface.name, "a surface")
    if surface.deformation is not None:
        raise UserError(
            f"The surface {surface.name} of {system.name} has a deformation, which a lens file cannot hold."
        )
    medium, shape = begins.medium, _shape(surface, system.name)
    if isinstance(medium, GradientIndex):
        lines = [*gradient_lines(surface, medium, begins, wavelength_of(system)), *shape[1:]]
    elif surface.action == "reflect":
        lines = [*shape, "GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0"]
    else:
        lines = [*shape, *_glass(medium, surface.name)]
    opening = surface.opening or Opening()
    inner = system.pupil.obscuration if index == system.stop else 0.0
    dark = inner * paraxial(system).stop_radius if inner else 0.0
    parts = [Opening(inner=dark), opening]  # an obscured pupil is a dark center of the stop
    if opening.center == (0.0, 0.0):
        parts = [replace(opening, inner=max(dark, opening.inner))]
    found = [one for part in parts for one in apertures(part, surface.shape, surface.name)]
    own = next((one for one in reversed(found) if not one.turn), None)
    lines += own.lines if own else ()
    more = [one for one in found if one is not own]
    reach = np.hypot(*np.array(opening.dark).T).max() if opening.dark else 0.0
    semi_diameter = 2.0 * float(reach) if reach and math.isinf(opening.outer) else opening.outer
    if index == system.stop:
        lines.append("STOP")
        if system.pupil.kind == "stop":
            semi_diameter = system.pupil.value
    if math.isfinite(semi_diameter):
        lines.append(f"DIAM {written(semi_diameter)} 1 0 0 1")
    rows = [[f"COMM {surface.name}", *lines]]
    if not more:
        return rows
    if isinstance(before, GradientIndex):
        raise UserError(
            f"The surface {surface.name} has several apertures and {before.name} before it, whose index "
            "varies: a lens file holds one aperture there."
        )
    for k, one in reversed(list(enumerate(more, start=1))):
        same = _shape(replace(surface, shape=one.shape, phase=None), system.name)
        glass = _glass(before, surface.name)
        here = [[f"COMM {surface.name} aperture {k}", *same, *glass, *one.lines, "DISZ 0.0"]]
        if one.turn:
            turn = [0.0, 0.0, 0.0, 0.0, math.degrees(one.turn)]
            here = [_break(turn, 0, 0.0), *here, _break([-value for value in turn], 1, 0.0)]
        rows = [*here, *rows]
    return rows


def _shape(surface: Surface, system: str) -> list[str]:
    shape = surface.shape
    if surface.phase is not None:
        return phase_lines(surface.phase, shape, f"{surface.name} of {system}")
    numbers = [f"CURV {written(1.0 / shape.radius)}", f"CONI {written(shape.conic)}"]
    if isinstance(shape, Conic):
        return ["TYPE STANDARD", *numbers]
    where = f"{surface.name} of {system}"
    if isinstance(shape, GridSag):
        return ["TYPE GRID_SAG", *numbers, *_grid_sag(shape, where)]
    if not isinstance(shape, EvenAsphere | ExtendedPolynomial | ZernikeSag):
        if not shape.zemax:
            raise UserError(
                f"The surface {where} is a {type(shape).__name__}, for which lens files have no surface type."
            )
        return [f"TYPE {shape.zemax}", *numbers, *shape.zemax_lines(where)]
    return [f"TYPE {_LISTS[type(shape)][0]}", *numbers, *_coefficients(shape, where)]


def _grid_sag(shape: GridSag, where: str) -> list[str]:
    """Return the lines of heights on a grid with the even asphere and the polynomials below them."""
    even = EvenAsphere(shape.radius, shape.conic, shape.even)
    zernike = ZernikeSag(shape.radius, shape.conic, shape.zernike, shape.pupil_radius)
    below = _coefficients(even, where) + (_coefficients(zernike, where) if shape.zernike else [])
    return ["PARM 0 0", *below, *grid_lines(shape, where)]


def _coefficients(shape: EvenAsphere | ExtendedPolynomial | ZernikeSag, where: str) -> list[str]:
    _, form, most = _LISTS[type(shape)]
    if len(shape.coefficients) > most:
        raise UserError(
            f"The surface {where} has {form} of {len(shape.coefficients)} terms; a lens file cannot hold "
            f"more than {most} terms."
        )
    if isinstance(shape, EvenAsphere):
        return [f"PARM {k} {written(value)}" for k, value in enumerate(shape.coefficients, start=1)]
    if isinstance(shape, ExtendedPolynomial):
        return _extra_data(shape.coefficients, shape.normalization_radius)
    return _extra_data(_circular(shape, where), shape.pupil_radius)


def _is_annular(shape: Shape) -> TypeGuard[ZernikeSag]:
    return isinstance(shape, ZernikeSag) and shape.obscuration > 0.0 and bool(shape.coefficients)


def _circular(shape: ZernikeSag, where: str) -> tuple[float, ...]:
    """Return the coefficients over the full circle: annular polynomials are finite sums of circular ones."""
    if not _is_annular(shape):
        return shape.coefficients
    circular = transform_coefficients(np.array(shape.coefficients), shape.obscuration, 0.0)
    if np.abs(circular).max() > _MOST_GROWTH * np.abs(shape.coefficients).max():
        raise UserError(
            f"The surface {where} has a Zernike sag of {len(shape.coefficients)} terms over the narrow ring "
            f"of obscuration {shape.obscuration:g}: a lens file holds circular polynomials only, with "
            f"coefficients over {_MOST_GROWTH:.0e} times larger, in whose rounding its heights would drown."
        )
    return tuple(circular.tolist())


def _note(system: OpticalSystem) -> list[str]:
    """Return the line that says which surfaces had annular polynomials, if any had."""
    rings = [one for one in system.surfaces if _is_annular(one.shape)]
    if not rings:
        return []
    names = ", ".join(one.name for one in rings)
    return [f"NOTE 0 Annular Zernike polynomials of {names} are written as the equal sums of circular ones."]


def _extra_data(coefficients: tuple[float, ...], radius: float) -> list[str]:
    values = [float(len(coefficients)), radius, *coefficients]
    return [f"XDAT {k} {written(value)} 0 0" for k, value in enumerate(values, start=1)]
