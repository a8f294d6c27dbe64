"""How wide the beam of a .zmx file is."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.kernels.trace.status import OK
from wavequake.optics.media.glasses import refractive_index
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, Pupil, wavelength_of
from wavequake.optics.zemax.header import PUPILS
from wavequake.optics.zemax.lens_file import LensFile
from wavequake.optics.zemax.rows import Line, as_integer, as_number, fail

_AT_PUPIL, _AT_REAL_STOP = 0, 2  # second number of RAIM; 1 aims at the paraxial stop
_NOTED = 0.01  # relative difference of the stop's radius from which it is told
_NEUTRAL = Pupil("entrance_diameter", 1.0)


def with_pupil(system: OpticalSystem, file: LensFile, scale: float) -> OpticalSystem:
    """Return a system whose beam is as wide as the file says.

    An object's numerical aperture n sin(theta) is that of the real ray of the axis point: the radius of the
    stop is where it passes. If that ray does not come so far, the paraxial ray of the same angle says it.
    Where rays are aimed by a real ray (RAIM 0 2), an entrance pupil and an f-number set the radius of the
    stop by the real ray to the edge of the paraxial entrance pupil; else by the paraxial one.

    Raises
    ------
    UserError
        If the file gives no aperture, several, or one that the object cannot have.
    """
    given = [line for keyword in PUPILS for line in file.header.get(keyword, [])]
    if len(given) != 1:
        found = ", ".join(line.keyword for line in given) or "none"
        raise UserError(f"{file.where} needs one of {', '.join(PUPILS)} for the aperture; it has {found}.")
    line = given[0]
    if line.keyword == "FLOA":
        return replace(system, pupil=_of_stop(file, line, scale))
    value = as_number(line, 0)
    kind = as_integer(line, 1) if len(line.words) > 1 else 0
    if not value > 0:
        fail(line, f"the aperture must be positive, it is {value:g}")
    infinite = math.isinf(system.object_distance)
    if line.keyword in ("ENPD", "FNUM"):
        if line.keyword == "ENPD":
            pupil = Pupil("entrance_diameter", value * scale)
        elif kind or infinite:  # type 1 is that of the marginal ray
            pupil = Pupil("f_number", value)
        else:
            focal = paraxial(replace(system, pupil=_NEUTRAL)).focal_length
            if not math.isfinite(focal):
                fail(
                    line, "the f-number is that of an object at infinity, but the system has no focal length"
                )
            pupil = Pupil("entrance_diameter", abs(focal) / value)
        system = replace(system, pupil=pupil)
        return _of_real_ray(system) if _aiming(file) == _AT_REAL_STOP else system
    if infinite:
        fail(line, "an object at infinity has no numerical aperture; give the entrance pupil (ENPD)")
    index = refractive_index(system.medium, wavelength_of(system))
    if kind:  # half the cone's angle, degrees
        if value >= 90.0:
            fail(line, f"light leaves the object up to {value:g} degrees off the axis; below 90 is traced")
        value = index * math.sin(math.radians(value))
    if not 0.0 < value < index:
        fail(line, f"the numerical aperture {value:g} must be positive and less than the index {index:g}")
    return replace(system, pupil=_of_cone(system, value / index, line))


def beside_stop(system: OpticalSystem, file: LensFile) -> list[str]:
    """Return a sentence if the file's own beam, aimed at the paraxial pupil, does not just fill the stop."""
    if _aiming(file) != _AT_PUPIL or not (file.header.get("ENPD") or file.header.get("FNUM")):
        return []
    data, wide = paraxial(system), _of_real_ray(system).pupil
    share = wide.value / data.stop_radius if wide is not system.pupil else 1.0
    if abs(share - 1.0) <= _NOTED:
        return []
    return [
        f"The file aims rays at the paraxial entrance pupil, where its beam fills {share:.4g} of the stop's "
        "radius on the axis; here rays are aimed at the stop and fill it."
    ]


def _aiming(file: LensFile) -> int | None:
    line = next(iter(file.header.get("RAIM", [])), None)
    return as_integer(line, 1) if line is not None and len(line.words) > 1 else None


def _of_stop(file: LensFile, line: Line, scale: float) -> Pupil:
    stop = next(row for row in file.rows if "STOP" in row.lines)
    radius = stop.one("DIAM")
    if radius is None or as_number(radius, 0) <= 0:
        fail(line, f"the stop, {stop.label}, limits the beam but has no semi-diameter (DIAM)")
    return Pupil("stop", as_number(radius, 0) * scale)


def _of_cone(system: OpticalSystem, sine: float, line: Line) -> Pupil:
    """Return the radius of the stop at which the axis point's ray of this sine passes it."""
    origin = np.array([0.0, 0.0, system.surfaces[0].position[2] - system.object_distance])
    slopes = np.array([[0.0, 0.0], [0.0, sine], [0.0, -sine]]).T
    direction = np.stack([*slopes, np.sqrt(1.0 - (slopes**2).sum(axis=0))])
    radius = _radius_at_stop(system, np.repeat(origin[:, None], 3, axis=1), direction)
    if radius is None:
        index = refractive_index(system.medium, wavelength_of(system))
        tangent = index * sine / math.sqrt(1.0 - sine**2)
        whole_stop = replace(system, pupil=Pupil("object_na", min(tangent, 0.999 * index)))
        return Pupil("stop", paraxial(whole_stop).stop_radius)
    if not radius > 0.0:
        fail(line, "the stop lies in an image of the object and limits no cone of light")
    return Pupil("stop", radius)


def _of_real_ray(system: OpticalSystem) -> OpticalSystem:
    """Return a system whose stop is as wide as the real ray to the edge of the paraxial entrance pupil says.

    So OpticStudio does where it aims rays by a real ray (RAIM 0 2). Where that ray is lost or the entrance
    pupil is at infinity, the stop stays the paraxial one.
    """
    data = paraxial(system)
    vertex = float(system.surfaces[0].position[2])
    edge = data.entrance_pupil_diameter / 2.0
    if not (math.isfinite(data.entrance_pupil) and math.isfinite(edge)):
        return system
    heights = np.array([0.0, edge, -edge])
    if math.isinf(system.object_distance):
        position = np.stack([0.0 * heights, heights, np.full(3, vertex)])
        direction = np.repeat(np.array([[0.0], [0.0], [1.0]]), 3, axis=1)
    else:
        way = data.entrance_pupil + system.object_distance
        position = np.repeat(np.array([[0.0], [0.0], [vertex - system.object_distance]]), 3, axis=1)
        direction = np.stack([0.0 * heights, heights / way, np.ones(3)])
        direction /= np.linalg.norm(direction, axis=0)
    radius = _radius_at_stop(system, position, direction)
    return replace(system, pupil=Pupil("stop", radius)) if radius else system


def _radius_at_stop(
    system: OpticalSystem, position: NDArray[np.float64], direction: NDArray[np.float64]
) -> float | None:
    """Return how far two rays meet the stop from the first one, in the mean; None if one is lost before."""
    count = system.stop + 1
    whole = pack(system, wavelength_of(system))
    rest = moving(system, rest_states(system))
    first = replace(whole.elements[count - 1], action="pass")
    sequence = replace(whole, elements=(*whole.elements[: count - 1], first))
    poses = replace(
        rest, poses=rest.poses[:, :count], deformations=rest.deformations[:count], grids=rest.grids[:count]
    )
    traced = trace_sequence_numpy(sequence, Rays(position, direction, np.zeros(3)), poses, True)
    if (traced.status[0] != OK).any():
        return None
    heights = np.hypot(traced.x[0] - traced.x[0, 0], traced.y[0] - traced.y[0, 0])
    return float(heights[1:].mean())
