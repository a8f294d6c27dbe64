"""Field points, vignetting factors and wavelengths of a .zmx file."""

import math
from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import OK
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.rays.aiming import pupil_rays
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.paraxial import paraxial, way_from_object
from wavequake.optics.systems.system import OpticalSystem, wavelength_of
from wavequake.optics.zemax.lens_file import LensFile
from wavequake.optics.zemax.rows import Line, as_count, as_integer, as_number, fail

Array = NDArray[np.float64]

ANGLE, OBJECT_HEIGHT, PARAXIAL_IMAGE, REAL_IMAGE, THEODOLITE = range(5)
_KINDS = (ANGLE, OBJECT_HEIGHT, PARAXIAL_IMAGE, REAL_IMAGE, THEODOLITE)
_VIGNETTING = ("VDXN", "VDYN", "VCXN", "VCYN", "VANN"), ("ZVDX", "ZVDY", "ZVCX", "ZVCY", "ZVAN")
_CLOSE = 1e-9  # mm: how well a real image height is met
_STEPS = 30


def wavelengths(file: LensFile) -> tuple[Array, int]:
    """Return the wavelengths in mm and the index of the primary one."""
    kind, listed = file.first("FTYP"), file.first("WAVL")
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


def is_telecentric(file: LensFile) -> bool:
    """Tell whether the file says that chief rays leave the object parallel to the axis."""
    kind = file.first("FTYP")
    return bool(kind and len(kind.words) > 1 and as_integer(kind, 1))


def is_afocal(file: LensFile) -> bool:
    """Tell whether the file says that light leaves the system parallel."""
    kind = file.first("FTYP")
    return bool(kind and len(kind.words) > 6 and as_integer(kind, 6))


def with_fields(system: OpticalSystem, file: LensFile, scale: float) -> OpticalSystem:
    """Return a system with the field points of the file, as angles or object heights, and their vignetting.

    A paraxial image height h' is an angle atan(h' / f) or an object height h' / m, of a finite object of the
    magnification m. A real image height is where the chief ray of the primary wavelength meets the image. An
    angle of a finite object is that at the paraxial entrance pupil.

    Raises
    ------
    UserError
        If the kind of the fields does not suit the object, or no chief ray arrives at a real image height.
    """
    kind = file.first("FTYP")
    code = as_integer(kind, 0) if kind else ANGLE
    at = kind or file.rows[0].line
    if code not in _KINDS:
        fail(at, f"fields of type {code} are not known; 0 to {THEODOLITE} are")
    values = [_row(file, keywords) for keywords in (("XFLN", "XFLD"), ("YFLN", "YFLD"))]
    count = as_count(kind, 2) if kind and len(kind.words) > 2 else max(map(len, values))
    points = _padded(values, count)
    infinite = not math.isfinite(system.object_distance)
    if code == THEODOLITE:
        points = np.rad2deg(_from_theodolite(np.deg2rad(points)))
        code = ANGLE
    if not points.any():
        found = np.zeros((count, 2))
    elif code == ANGLE:
        angles = np.deg2rad(points)
        found = angles if infinite else _heights_of_angles(system, angles, at)
    elif code == OBJECT_HEIGHT:
        if infinite:
            fail(at, "fields are object heights, but the object is at infinity; angles are needed")
        found = points * scale
    else:
        found = _from_paraxial_images(system, points * scale, at)
        if code == REAL_IMAGE:
            found = _from_real_images(system, found, points * scale, at)
    return replace(system, fields=found, vignetting=_vignetting(file, count))


def _row(file: LensFile, keywords: tuple[str, ...]) -> list[float]:
    line = next((line for keyword in keywords for line in file.header.get(keyword, [])), None)
    return [as_number(line, index) for index in range(len(line.words))] if line else [0.0]


def _padded(rows: Sequence[list[float]], count: int) -> Array:
    return np.array([(row + [0.0] * count)[:count] for row in rows]).T


def _from_theodolite(angles: Array) -> Array:
    """Return angles in x and y for an azimuth and an elevation."""
    azimuth, elevation = angles.T
    return np.stack([azimuth, np.arctan(np.tan(elevation) / np.cos(azimuth))], axis=1)


def _heights_of_angles(system: OpticalSystem, angles: Array, at: Line) -> Array:
    pupil = paraxial(system).entrance_pupil
    if not math.isfinite(pupil):
        fail(at, "fields of a near object are angles, but its entrance pupil is at infinity; give heights")
    return -np.tan(angles) * (way_from_object(system) + pupil)


def _from_paraxial_images(system: OpticalSystem, heights: Array, at: Line) -> Array:
    data = paraxial(system)
    if not math.isfinite(system.object_distance):
        if not math.isfinite(data.focal_length):
            fail(at, "fields are image heights, but the system has no focal length")
        return np.arctan(heights / data.focal_length)
    if not (math.isfinite(data.magnification) and data.magnification):
        fail(at, "fields are image heights, but the object has no image of finite size")
    return heights / data.magnification


def _from_real_images(system: OpticalSystem, start: Array, targets: Array, at: Line) -> Array:
    """Return the field points whose chief rays meet the image at the targets, by Newton's iteration."""
    found = []
    for point, target in zip(start, targets, strict=True):
        current = np.array(point)
        scale = max(float(np.abs(start).max()), 1e-12)
        for _ in range(_STEPS):
            here = image_point(system, current, at)
            if np.abs(here - target).max() <= _CLOSE:
                break
            step = 1e-6 * scale
            slopes = np.stack(
                [(image_point(system, current + step * unit, at) - here) / step for unit in np.eye(2)], axis=1
            )
            current = current + np.linalg.solve(slopes, target - here)
        else:
            fail(at, f"no chief ray meets the image at ({target[0]:g}, {target[1]:g}) mm")
        found.append(current)
    return np.array(found)


def image_point(system: OpticalSystem, field: Array, at: Line) -> Array:
    """Return where the chief ray of the primary wavelength meets the image, in its own frame, mm."""
    wavelength = wavelength_of(system)
    try:
        chief = pupil_rays(system, field, wavelength, np.zeros(1), np.zeros(1))
    except UserError as error:
        fail(at, f"a field is given by where its light arrives, which cannot be found: {error}".rstrip("."))
    rest = moving(system, rest_states(system))
    traced = trace_sequence_numpy(pack(system, wavelength), chief, rest, True)
    if traced.status[0, 0] != OK:
        fail(at, "a field is given by where its light arrives, but no light arrives there")
    return np.array([traced.x[0, 0], traced.y[0, 0]])


def _vignetting(file: LensFile, count: int) -> tuple[tuple[float, float, float, float, float], ...]:
    """Return the vignetting factors of each field, or none."""
    for keywords in _VIGNETTING:
        factors = _padded([_row(file, (keyword,)) for keyword in keywords], count)
        if factors[:, :4].any():
            if (factors[:, 2:4] >= 1.0).any():
                line = next(file.header[one][0] for one in keywords[2:4] if one in file.header)
                fail(line, "a vignetting factor is 1 or more, which leaves no light")
            factors[:, 4] = np.deg2rad(factors[:, 4])
            return tuple((dx, dy, cx, cy, angle) for dx, dy, cx, cy, angle in factors.tolist())
    return ()
