"""A system's first-order data, fields, wavelengths and surfaces as a table of plain text."""

from collections.abc import Iterable, Sequence
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.optics.media.glasses import medium_label
from wavequake.optics.media.gradients import GradientIndex
from wavequake.optics.rays.aiming import require_light
from wavequake.optics.rays.other_points import other_points
from wavequake.optics.rays.packing import pack
from wavequake.optics.rays.pupils import pupil_amplitude
from wavequake.optics.segments.kinematics import cardan_angles
from wavequake.optics.shapes.forms.biconic import Biconic
from wavequake.optics.shapes.forms.toroid import Toroid
from wavequake.optics.shapes.grid_cover import require_cover
from wavequake.optics.shapes.phases import effect_words
from wavequake.optics.shapes.shapes import Opening
from wavequake.optics.systems.image_aperture import real_apertures
from wavequake.optics.systems.paraxial import Paraxial, oblique_surfaces, paraxial
from wavequake.optics.systems.system import OpticalSystem, Surface, wavelength_of

Array = NDArray[np.float64]

_ARCMIN = 180.0 * 60.0 / np.pi
_WIDE = np.deg2rad(1.0)  # fields from which angles are told in degrees
_SAME = 0.01  # relative difference up to which an aperture is called the same
_ROUNDING = 1e-10  # mm or degrees, of places that rotations gave
_OBLIQUE = np.deg2rad(1.0)  # incidence from which powers along and across differ by 3e-4
_FIRST_DARK_RING = 3.8317059702075123 / np.pi  # first zero of J1: 1.22 wavelength times f-number


def info(system: OpticalSystem) -> str:
    """Return first-order data at the primary wavelength, fields, wavelengths and surfaces, as plain text.

    Surfaces off the axis or turned are listed once more, with their vertex and the angles about x, y and z.

    Raises
    ------
    UserError
        As `wavequake.optics.systems.paraxial.paraxial`, and as `wavequake.optics.rays.packing.pack` for any
        wavelength: what could not be traced is not described either.

    Examples
    --------
    >>> from wavequake.optics.catalog.names import optical_system
    >>> print(info(optical_system("euv")).splitlines()[0])
    euv
    """
    data = paraxial(system)
    for wavelength in system.wavelengths:
        pack(system, float(wavelength))
    require_light(system)
    parts = [
        [system.name],
        _columns(_first_order(system, data)),
        _columns([("field", *_fields(system)), ("wavelength (nm)", *_wavelengths(system))]),
        _columns(_surfaces(system.surfaces, system.stop), right=(1, 2, 3)),
    ]
    if off := _off_axis(system.surfaces):
        parts.append(_columns(off, right=(1, 2, 3, 4, 5)))
    parts += [lines for lines in (_vignetting(system), _oblique(system), _two_curvatures(system)) if lines]
    bent = [one for one in system.surfaces if isinstance(one.medium, GradientIndex)]
    if bent:
        parts.append([f"The index varies behind {bent[0].name}, and rays bend."])
    if names := other_points(system):
        parts.append(
            [
                "Light goes forwards where the axis ray goes back, or back where that goes forwards, and "
                f"meets {', '.join(names)} at another point than in OpticStudio."
            ]
        )
    parts += [[system.note]] if system.note else []
    try:
        require_cover(system)
    except UserError as error:  # such a system can be traced, but no study runs
        parts.append([str(error)])
    return "\n\n".join("\n".join(lines) for lines in parts)


def _first_order(system: OpticalSystem, data: Paraxial) -> list[tuple[str, ...]]:
    distance, first = system.object_distance, system.surfaces[0].name
    far = not isfinite(distance)
    kind = "infinity" if far else f"{_number(distance)} mm before {first}"
    if distance < 0.0:
        kind = f"virtual, {_number(-distance)} mm behind {first}"
    before, behind = real_apertures(system) or (None, None)
    rows: list[tuple[str, ...]] = [
        ("object", kind + (", telecentric" if system.telecentric else "")),
        ("focal length", _length(data.focal_length)),
        ("back focus", _length(data.back_focus)),
        ("front / rear principal plane", f"{_number(data.front_principal)} / {_length(data.rear_principal)}"),
        ("image beyond paraxial focus", _length(data.defocus)),
        ("f-number", _number(data.f_number)),
        ("NA in image", _aperture(data.image_na, behind)),
        ("resolution (Airy radius)", _resolution(system, data.f_number)),
        ("entrance pupil", _pupil(data.entrance_pupil, data.entrance_pupil_diameter, "from first surface")),
        ("exit pupil", _pupil(data.exit_pupil, data.exit_pupil_diameter, "from image")),
        ("stop", f"{system.surfaces[system.stop].name}, radius {_length(data.stop_radius)}"),
        ("obscuration", f"{_number(system.pupil.obscuration)} of the pupil's radius"),
    ]
    if system.pupil.apodization is not None:
        rows.append(("apodization", _apodization(system)))
    if isfinite(data.lagrange):
        rows.append(("Lagrange invariant", _length(data.lagrange)))
    if not far:
        rows[1:1] = [
            ("magnification", _number(data.magnification)),
            ("NA in object", _aperture(data.object_na, before)),
        ]
    return rows


def _apodization(system: OpticalSystem) -> str:
    """Say how the light falls towards the rim of the pupil."""
    given = system.pupil.apodization
    rim = pupil_amplitude(system, np.ones(1), np.zeros(1))
    light = "uniform here" if rim is None else f"{float(rim[0]) ** 2:.4g} of the central light at the rim"
    if given is not None and given.kind == "gaussian":
        return f"Gaussian, factor {_number(given.factor)}: {light}"
    return f"cosine cubed, of a point source: {light}"


def _aperture(paraxial_na: float, real: Array | None) -> str:
    """Name the numerical aperture of real rays, too, if it is another one."""
    text = _number(paraxial_na)
    if real is None or (np.abs(real - paraxial_na) <= _SAME * paraxial_na).all():
        return text
    largest, smallest = map(_number, real)
    across = "" if real[0] - real[1] <= _SAME * real[0] else f" to {smallest}"
    return f"{text}, of real rays {largest}{across}"


def _oblique(system: OpticalSystem) -> list[str]:
    """Return a sentence about surfaces that light meets so obliquely that first-order data are coarse."""
    found = oblique_surfaces(system, _OBLIQUE)
    if not found:
        return []
    listed = ", ".join(f"{name} ({np.rad2deg(angle):.3g})" for name, angle in found)
    return [
        "First-order data take these surfaces as upright, though the axis ray meets them obliquely "
        f"(degrees): {listed}. Rays are traced as they are."
    ]


def _two_curvatures(system: OpticalSystem) -> list[str]:
    """Return a sentence about surfaces that are curved otherwise along x than along y."""
    names = [one.name for one in system.surfaces if isinstance(one.shape, Biconic | Toroid)]
    if not names:
        return []
    return [
        f"First-order data take the mean of both curvatures of {', '.join(names)}. Rays are traced as they "
        "are."
    ]


def _resolution(system: OpticalSystem, f_number: float) -> str:
    """Say how far apart two points are that perfect optics just resolve (Störkle 2018, Eq. 3.76)."""
    wavelength = wavelength_of(system)
    radius = 1e3 * _FIRST_DARK_RING * wavelength * f_number
    if not isfinite(radius):
        return "infinite"
    return f"{radius:.5g} um at {_number(1e6 * wavelength)} nm, of perfect optics without obscuration"


def _pupil(position: float, diameter: float, origin: str) -> str:
    if not isfinite(position):
        return "at infinity"
    return f"{_length(position)} {origin}, diameter {_length(diameter)}"


def _fields(system: OpticalSystem) -> Iterable[str]:
    far = not isfinite(system.object_distance)
    wide = np.abs(system.fields).max(initial=0.0) >= _WIDE
    for x, y in system.fields:
        if far and wide:  # as in tables
            yield f"({np.rad2deg(x) + 0.0:.5g}, {np.rad2deg(y) + 0.0:.5g}) deg"
        elif far:
            yield f"({_number(x * _ARCMIN)}, {_number(y * _ARCMIN)}) arcmin"
        else:
            yield f"({_number(x)}, {_number(y)}) mm"


def _vignetting(system: OpticalSystem) -> list[str]:
    """Return a sentence about the share of the stop that vignetting factors leave, as ellipses."""
    shares = [100.0 * (1.0 - cx) * (1.0 - cy) for _, _, cx, cy, _ in system.vignetting]
    if not shares:
        return []
    return [
        "Vignetting factors leave of the stop, in % by field: "
        + ", ".join(f"{share:.4g}" for share in shares)
        + "."
    ]


def _wavelengths(system: OpticalSystem) -> Iterable[str]:
    for number, wavelength in enumerate(system.wavelengths):
        primary = number == system.primary_wavelength and len(system.wavelengths) > 1
        yield _number(1e6 * wavelength) + (" primary" if primary else "")


def _surfaces(surfaces: Sequence[Surface], stop: int) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [
        ("surface", "radius (mm)", "conic", "z (mm)", "action", "shape", "opening (mm)")
    ]
    for number, surface in enumerate(surfaces):
        shape = "; ".join(filter(None, (surface.shape.words(), effect_words(surface.phase))))
        deforms = " deforms" if surface.deformation is not None else ""
        action = surface.action + (f" {_medium(surface)}" if surface.action == "refract" else "")
        rows.append(
            (
                surface.name + (" (stop)" if number == stop else ""),
                _number(surface.shape.radius),
                _number(surface.shape.conic),
                _number(surface.position[2]),
                action,
                (shape + deforms).strip(),
                _opening(surface.opening),
            )
        )
    return rows


def _off_axis(surfaces: Sequence[Surface]) -> list[tuple[str, ...]]:
    """Return where surfaces stand that are off the axis or turned; nothing if none is."""
    turned = np.rad2deg(cardan_angles(np.stack([surface.rotation for surface in surfaces])))
    placed = np.array([surface.position[:2] for surface in surfaces])
    places = np.concatenate([placed, turned], axis=1)
    places[np.abs(places) < _ROUNDING] = 0.0
    rows = [
        (surface.name, *map(_number, place))
        for surface, place in zip(surfaces, places.tolist(), strict=True)
        if any(place)
    ]
    head = ("off the axis", "x (mm)", "y (mm)", "about x (deg)", "about y (deg)", "about z (deg)")
    return [head, *rows] if rows else []


def _medium(surface: Surface) -> str:
    medium = surface.medium
    return medium.name if isinstance(medium, GradientIndex) else medium_label(medium)


def _opening(opening: Opening | None) -> str:
    if opening is None:
        return ""
    text = f"polygon of {len(opening.corners)}" if opening.corners else _number(opening.outer)
    if opening.inner:
        text = f"{_number(opening.inner)} to {text}"
    text += f", {len(opening.arms)} arms" if opening.arms else ""
    text += f", dark polygon of {len(opening.dark)}" if opening.dark else ""
    x, y = opening.center
    return text + (f" about ({_number(x)}, {_number(y)})" if x or y else "")


def _length(value: float) -> str:
    return f"{_number(value)} mm" if isfinite(value) else "infinite"


def _number(value: float) -> str:
    return "infinite" if not isfinite(value) else f"{value + 0.0:.8g}"


def _columns(rows: Sequence[tuple[str, ...]], right: tuple[int, ...] = ()) -> list[str]:
    """Return lines in which the cells of a column stand below each other."""
    widths = [max(len(row[i]) for row in rows if i < len(row)) for i in range(max(map(len, rows)))]
    lines = []
    for row in rows:
        cells = [
            cell.rjust(width) if i in right else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=False))
        ]
        lines.append("  ".join(cells).rstrip())
    return lines
