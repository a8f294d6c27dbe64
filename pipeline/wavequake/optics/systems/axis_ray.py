"""The ray along the axis of a sequential system: its way from vertex to vertex and what it meets there."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.optics.media.glasses import refractive_index
from wavequake.optics.media.gradients import GradientIndex, axis_index, medium_index, paraxial_transfer
from wavequake.optics.shapes.phases import axis_effect
from wavequake.optics.shapes.sag import shape_sag, vertex_curvature
from wavequake.optics.systems.system import OpticalSystem, Surface, wavelength_of

Array = NDArray[np.float64]

_STEEPEST = 1e9  # curvature at a vertex, 1/mm: products of larger ones overflow
_DECENTERED = 0.05  # largest slope of a surface where the axis ray meets it that counts as centered
_GRAZING = 1e-6  # smallest cosine of incidence of the axis ray
_OBLIQUE = 1e-12  # largest angle of incidence, rad, that is rounding
_STEPS, _CLOSE = 50, 1e-14  # of Newton's iteration; its last step over the way


@dataclass(frozen=True)
class AxisStep:
    """The way from the previous surface and its matrix, the index at its end, the power of the surface.

    And the angle of incidence of the axis ray, rad, its direction behind, and whether it misses the vertex:
    it then meets the surface where it is, and follows the law of refraction.
    """

    way: float
    transfer: Array
    index: float
    power: float
    incidence: float
    direction: Array
    beside: bool = False


def first_vertex_z(system: OpticalSystem) -> float:
    """Return where the axis ray meets the vertex plane of the first surface."""
    surface = system.surfaces[0]
    normal = surface.rotation[:, 2]
    _require_crossing(system, surface.name, float(normal[2]))
    return float(normal @ surface.position / normal[2])


def follow_axis(system: OpticalSystem, wavelength: float) -> Iterator[AxisStep]:
    """Follow the axis ray: yield the way to each surface (first: 0) and what the surface does."""
    point, direction = np.array([0.0, 0.0, first_vertex_z(system)]), np.array([0.0, 0.0, 1.0])
    index = refractive_index(system.medium, wavelength)
    begins: Surface | None = None  # the surface with which a medium of varying index begins
    for number, surface in enumerate(system.surfaces):
        normal = surface.rotation[:, 2]
        cosine = float(direction @ normal)
        _require_crossing(system, surface.name, cosine)
        way = float(normal @ (surface.position - point)) / cosine
        transfer = np.array([[1.0, way / index], [0.0, 1.0]])
        if begins is not None:
            index, transfer = _through_gradient(begins, wavelength, point, way, direction)
        point = point + way * direction
        curvature = vertex_curvature(surface.shape)
        if not abs(curvature) <= _STEEPEST:
            raise UserError(
                f"the surface {surface.name} of {system.name} has the curvature {curvature:g} / mm at its "
                f"vertex; it must be at most {_STEEPEST:g} / mm"
            )
        last = number == len(system.surfaces) - 1
        acts = (surface.action != "pass" or surface.phase is not None) and not last
        beside = float(np.linalg.norm(point - surface.position))
        if acts and abs(curvature) * beside > _DECENTERED:
            after = index if surface.action == "reflect" else medium_index(surface.medium, wavelength)
            met = _off_vertex(system, surface, point, direction, index, after)
            point, direction, further, power, incidence = met
            begins = (
                surface if surface.action == "refract" and isinstance(surface.medium, GradientIndex) else None
            )
            transfer = np.array([[1.0, further / index], [0.0, 1.0]]) @ transfer
            yield AxisStep(way + further, transfer, index, power, incidence, direction, True)
            index = after
            continue
        sense = float(np.sign(cosine))
        after = index
        power = 0.0
        incidence = float(np.arccos(min(abs(cosine), 1.0)))
        if surface.action == "refract" and not last:
            after = medium_index(surface.medium, wavelength)
            begins = surface if isinstance(surface.medium, GradientIndex) else None
            power = (after - index) * curvature * sense
        elif surface.action == "reflect":
            power = -2.0 * index * curvature * sense
            direction = direction - 2.0 * cosine * normal
        slopes = (0.0, 0.0)
        if surface.phase is not None:
            more, slopes = axis_effect(surface.phase, wavelength)
            power += more
        if any(slopes) or (after != index and incidence > _OBLIQUE):
            direction = _bent(system, surface, direction, slopes, index, after)
        yield AxisStep(way, transfer, index, power, incidence, direction)
        index = after


def senses(system: OpticalSystem, wavelength: float) -> list[float]:
    """Return the cosine of the axis ray and the z axis of each surface before it: its sign is the sense."""
    found, direction = [], np.array([0.0, 0.0, 1.0])
    for surface, step in zip(system.surfaces, follow_axis(system, wavelength), strict=True):
        found.append(float(direction @ surface.rotation[:, 2]))
        direction = step.direction
    return found


def off_axis(system: OpticalSystem) -> list[Array]:
    """Return x and y of each vertex about the axis ray, in a frame that mirrors and gratings turn with it."""
    offsets = []
    point, frame = np.zeros(3), np.eye(3)
    steps = list(follow_axis(system, wavelength_of(system)))
    for number, surface in enumerate(system.surfaces):
        normal = surface.rotation[:, 2]
        direction = frame[:, 2]
        cosine = float(direction @ normal)
        point = point + float(normal @ (surface.position - point)) / cosine * direction
        offsets.append((surface.position - point) @ frame[:, :2])
        if surface.action == "reflect":
            frame = frame - 2.0 * np.outer(normal, normal @ frame)
        if np.abs(steps[number].direction - frame[:, 2]).max() > _OBLIQUE:
            frame = _turned_to(frame, steps[number].direction)
    return offsets


def _off_vertex(
    system: OpticalSystem, surface: Surface, point: Array, direction: Array, before: float, after: float
) -> tuple[Array, Array, float, float, float]:
    """Follow the axis ray to a surface beside its vertex.

    Returns
    -------
    tuple
        Where it meets the surface and its direction behind, in the system's frame; how far that is from where
        it crosses the vertex plane; the mean of the powers in the plane of incidence and across it, by the
        surface's curvatures there (Coddington's equations); the angle of incidence.

    Raises
    ------
    UserError
        If it does not meet the surface, or is totally reflected.
    """
    turn = surface.rotation
    place, d = turn.T @ (point - surface.position), turn.T @ direction
    way = _way_to_conic(surface, place, d)
    for _ in range(_STEPS):
        x, y, z = place + way * d
        sag, slope_x, slope_y = (float(one) for one in shape_sag(surface.shape, x, y))
        step = (sag - z) / (d[2] - slope_x * d[0] - slope_y * d[1])
        way += step
        if not abs(step) > _CLOSE * (1.0 + abs(way)):
            break
    hit = place + way * d
    lean = np.array([-slope_x, -slope_y, 1.0])
    normal = lean / np.linalg.norm(lean)
    cosine = float(normal @ d)
    if surface.action == "reflect":
        behind, cosine_behind = d - 2.0 * cosine * normal, -cosine
    else:
        tangent = before / after * (d - cosine * normal)
        cosine_behind = float(np.copysign(np.sqrt(1.0 - tangent @ tangent), cosine))
        behind = tangent + cosine_behind * normal
    if not np.isfinite([*hit, *behind]).all() or surface.phase is not None:
        raise UserError(
            f"the axis ray of {system.name} misses the vertex of {surface.name} by "
            f"{np.hypot(*place[:2]):.3g} mm, and the surface, or does not leave it"
        )
    across = np.cross(normal, d)
    along = np.cross(across, normal)
    tangential, sagittal = (_normal_curvature(surface, hit, lean, v) for v in (along, across))
    change = after * cosine_behind - before * cosine
    power = 0.5 * change * (tangential / abs(cosine * cosine_behind) + sagittal)
    return (
        surface.position + turn @ hit,
        turn @ behind,
        way,
        power,
        float(np.arccos(min(abs(cosine), 1.0))),
    )


def _way_to_conic(surface: Surface, place: Array, d: Array) -> float:
    """Return the way from the vertex plane to the conic under a surface; 0 if the ray misses it."""
    curvature, form = 1.0 / surface.shape.radius, np.array([1.0, 1.0, 1.0 + surface.shape.conic])
    along = curvature * float(form @ d**2)
    half = float(d[2]) - curvature * float(form @ (place * d))
    start = curvature * float(form @ place**2) - 2.0 * float(place[2])
    square = half**2 - along * start
    root = half + math.copysign(math.sqrt(square), half) if square >= 0.0 else 0.0
    return start / root if root else 0.0


def _normal_curvature(surface: Surface, hit: Array, lean: Array, direction: Array) -> float:
    """Return the curvature of a surface along a tangent, positive if the center lies on +z."""
    size = float(np.linalg.norm(direction[:2]))
    if size == 0.0:
        return vertex_curvature(surface.shape)
    step = 1e-4 * (1.0 + float(np.hypot(*hit[:2]))) * direction[:2] / size
    ends = np.array([hit[:2] + step, hit[:2] - step])
    _, slope_x, slope_y = shape_sag(surface.shape, ends[:, 0], ends[:, 1])
    second = (np.array([slope_x[0] - slope_x[1], slope_y[0] - slope_y[1]]) / 2.0) @ step
    rise = float(-lean[:2] @ step)
    return float(second / (step @ step + rise**2) / np.linalg.norm(lean))


def _turned_to(frame: Array, direction: Array) -> Array:
    """Return axes (columns) that are turned on the shortest way so that the third is a direction."""
    axis = np.cross(frame[:, 2], direction)
    cross = np.cross(np.eye(3), -axis)
    turn = np.eye(3) + cross + cross @ cross / (1.0 + frame[:, 2] @ direction)
    return np.asarray(turn @ frame)


def _bent(
    system: OpticalSystem,
    surface: Surface,
    direction: Array,
    slopes: tuple[float, float],
    before: float,
    after: float,
) -> Array:
    """Return the direction of the axis ray behind a vertex, by its refraction and the slopes of a grating."""
    normal = surface.rotation[:, 2]
    vector = before * direction + surface.rotation[:, :2] @ np.array(slopes)
    with np.errstate(over="ignore", invalid="ignore"):  # of slopes beyond any grating
        along = float(normal @ vector)
        square = float(np.float64(after) ** 2 - vector @ vector + np.square(along))
    if not square > 0.0:
        raise UserError(
            f"the axis ray of {system.name} is totally reflected at {surface.name}; turn the surface"
            if not any(slopes)
            else f"the order of the axis ray of {system.name} leaves {surface.name} at no real angle; choose "
            "another order or fewer grooves"
        )
    across = float(np.copysign(np.sqrt(square), normal @ direction))
    return np.asarray((vector + (across - along) * normal) / after)


def _through_gradient(
    begins: Surface, wavelength: float, point: Array, way: float, direction: Array
) -> tuple[float, Array]:
    """Return the index at the end of a way through a medium of varying index, and the way's matrix."""
    medium, axis = begins.medium, begins.rotation[:, 2]
    assert isinstance(medium, GradientIndex)
    start, sense = float(axis @ (point - begins.position)), float(axis @ direction)
    end = axis_index(medium, wavelength, np.array([start + sense * way]))
    return float(end[0]), paraxial_transfer(medium, wavelength, start, way, sense)


def _require_crossing(system: OpticalSystem, surface: str, cosine: float) -> None:
    if abs(cosine) < _GRAZING:
        raise UserError(
            f"the axis ray of {system.name} runs along the surface {surface}; it must cross every surface"
        )
