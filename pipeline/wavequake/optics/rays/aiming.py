"""Rays of a field point that meet given points of the real stop."""

from dataclasses import dataclass, replace
from math import isfinite
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Moving, Rays, Sequence
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.kernels.trace.status import DIVERGED, MISS, NO_ORDER, OK, TOTAL_REFLECTION, VIGNETTED
from wavequake.optics.media.glasses import refractive_index
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.search import ends, search
from wavequake.optics.rays.stop_map import AIMED, Aim, Bundle, axes_across, determinant, newton, solved
from wavequake.optics.systems.axis_ray import first_vertex_z
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.once import once_per_system
from wavequake.optics.systems.paraxial import (
    Paraxial,
    entrance_pupil_center,
    paraxial,
    way_from_object,
)
from wavequake.optics.systems.system import OpticalSystem, field_direction, is_wide

Array = NDArray[np.float64]

_TOUCHES_MM = 1e-9
_DIFFERENCE = 1e-4  # step of the differences, as a share of the beam's radius
_TELECENTRIC = 100.0  # an entrance pupil that many object distances away makes chief rays parallel
LOSSES = {
    MISS: "it misses that surface",
    TOTAL_REFLECTION: "it is totally reflected there",
    DIVERGED: "that surface folds over",
    NO_ORDER: "its order of diffraction leaves at no real angle",
}
"""What happens to a ray that ends at a surface, by its status."""
_WHY = {
    VIGNETTED: "its opening stops them",
    MISS: "they miss it",
    TOTAL_REFLECTION: "they are totally reflected there",
    DIVERGED: "it folds over",
    NO_ORDER: "their order of diffraction leaves at no real angle",
}
_NM_PER_MM = 1e6
_FIRST_STEP, _SMALLEST_STEP = 1.0 / 16.0, 1.0 / 1024.0  # of a field, in which its chief ray is followed


@dataclass(frozen=True)
class AimedRays:
    """The rays of N points of the stop.

    Attributes
    ----------
    rays : Rays
        In the system's frame; NaN for a point that no ray reaches.
    status, surface : ndarray of int8, shape (N,)
        0 and -1, or for such a point why its light does not reach it, and the index of the surface at which
        that ends: the light next to the last ray that goes towards the point.
    """

    rays: Rays
    status: NDArray[np.int8]
    surface: NDArray[np.int8]

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Points (N,) that no ray reaches."""
        return np.asarray(self.status != OK)


def pupil_rays(system: OpticalSystem, field: Array, wavelength: float, x: Array, y: Array) -> Rays:
    """Return rays that meet the stop surface at (x, y) times the radius of the stop, to 1e-9 mm.

    The rays start on the plane through the first surface's vertex (object at infinity; the optical path
    counts from the wavefront through the entrance pupil's center) or at the object point. Openings are
    ignored: the chief ray of an annular pupil, at (0, 0), is virtual.

    Parameters
    ----------
    system : OpticalSystem
    field : ndarray, shape (2,)
        Angles in rad (object at infinity) or heights in mm.
    wavelength : float
        mm.
    x, y : ndarray, shape (N,)
        Normalized coordinates in the stop; 1 is its rim.

    Returns
    -------
    Rays
        In the system's frame.

    Raises
    ------
    UserError
        If the system is out of range, or no ray reaches some of the points: the message counts them by the
        surface at which their light is lost.
    """
    aimed = aimed_rays(system, field, wavelength, x, y, openings=False)
    if aimed.lost.any():
        raise UserError(
            f"{_where(system, field, wavelength)} {np.count_nonzero(aimed.lost)} of {aimed.lost.size} rays "
            f"of {system.name} cannot be aimed at the stop {system.surfaces[system.stop].name}: they are "
            f"lost, {losses(system, aimed.status, aimed.surface)}; make the pupil or the field smaller"
        )
    return aimed.rays


def aimed_rays(
    system: OpticalSystem, field: Array, wavelength: float, x: Array, y: Array, openings: bool = True
) -> AimedRays:
    """Return the rays of `pupil_rays` as far as there are any, and what happens to the light of the others.

    Newton's iteration starts at the paraxial rays; where it does not arrive, `wavequake.optics.rays.search`
    goes on. Rays are aimed beside openings, too; with `openings`, these stop light that does not reach its
    point, if it comes to one before the surface at which it would be lost.

    Raises
    ------
    UserError
        If the system is out of range, or has no chief ray.
    """
    field, x, y = (np.asarray(a, dtype=np.float64) for a in (field, x, y))
    if field.shape != (2,) or not np.isfinite(field).all():
        raise UserError(f"a field of {system.name} is {field.tolist()}; it must be 2 finite numbers")
    if x.ndim != 1 or x.shape != y.shape or not np.isfinite([*x, *y]).all():
        raise UserError("the pupil coordinates x and y must be two equally long lists of finite numbers")
    aim, chief, slopes, radius, beam = _chief_of(system, (float(field[0]), float(field[1])), wavelength)
    target = radius * np.stack([x, y])
    numbers = newton(aim, chief + solved(slopes, target), target, chief)
    status, surface = np.zeros(x.size, dtype=np.int8), np.full(x.size, -1, dtype=np.int8)
    bad = np.flatnonzero(~_aimed(aim, numbers, target))
    if bad.size:
        found, arrived = search(aim, chief, target[:, bad], beam)
        numbers[:, bad] = np.where(arrived, found, np.nan)
        gone = bad[~arrived]
        status[gone], surface[gone] = ends(aim, found[:, ~arrived], target[:, gone], beam, openings)
    return AimedRays(aim.bundle.rays(numbers), status, surface)


class _Chief(NamedTuple):
    """How a field's rays are aimed: the chief ray's numbers (2, 1), the stop's radius and the beam's size."""

    aim: Aim
    numbers: Array
    slopes: Array
    radius: float
    beam: float


@once_per_system  # light of a field is aimed several times, and this is half of it
def _chief_of(system: OpticalSystem, point: tuple[float, float], wavelength: float) -> _Chief:
    """Return the chief ray of a field point; UserError if there is none."""
    field = np.array(point)
    data = paraxial(system, wavelength)
    bundle, start = _bundle(system, data, field, wavelength, is_wide(field))
    to_stop, poses = _up_to_stop(system, wavelength)
    radius = data.stop_radius
    beam = _beam_size(system, data, wavelength)
    aim = Aim(to_stop, poses, bundle, _DIFFERENCE * beam)
    chief = newton(aim, start[:, None], np.zeros((2, 1)))
    if not _aimed(aim, chief, np.zeros((2, 1))).all():
        followed = _followed_chief(system, data, field, wavelength, aim)
        if followed is None or not _aimed(aim, followed, np.zeros((2, 1))).all():
            last = chief if followed is None else followed
            where = _where(system, field, wavelength)
            raise UserError(_no_chief(system, aim, start[:, None], last, beam, where))
        chief = followed
    _, slopes = aim.meet_with_slopes(chief)
    if abs(determinant(slopes)[0]) * beam**2 < 1e-12 * radius**2:
        raise UserError(
            f"the stop of {system.name} lies in an image of its object and limits no cone of light"
        )
    return _Chief(aim, chief, slopes, radius, beam)


def _followed_chief(
    system: OpticalSystem, data: Paraxial, field: Array, wavelength: float, aim: Aim
) -> Array | None:
    """Return the numbers (2, 1) of the chief ray, followed from the axis out to the field, or None.

    In lenses of wide angles the paraxial chief ray does not even enter; that of a field close by does.
    """
    zero = np.zeros((2, 1))
    before: tuple[float, Array] | None = None
    at, step = 0.0, _FIRST_STEP
    bundle, start = _bundle(system, data, 0.0 * field, wavelength, is_wide(field))
    at_axis = replace(aim, bundle=bundle)
    for begin in (start[:, None], zero):  # first-order data are coarse where all stands off the axis
        here = newton(at_axis, begin, zero)
        if _aimed(at_axis, here, zero).all():
            break
    else:
        return None
    while at < 1.0:
        goal = min(at + step, 1.0)
        bundle, start = _bundle(system, data, goal * field, wavelength, is_wide(field))
        one = replace(aim, bundle=bundle)
        guess = here if begin is zero else start[:, None]
        if before is not None:  # goes on straight
            guess = here + (here - before[1]) * (goal - at) / (at - before[0])
        found = newton(one, guess, zero)
        if np.isfinite(found).all() and _aimed(one, found, zero).all():
            before, here, at = (at, here), found, goal
        else:
            step /= 2.0
            if step < _SMALLEST_STEP:
                return None
    return here


def losses(system: OpticalSystem, status: NDArray[np.int8], surface: NDArray[np.int8]) -> str:
    """Say how many rays are lost where and why, the most first: ``81 at surface 5: they miss it``."""
    lost = np.flatnonzero(status != OK)
    kinds, counts = np.unique(np.stack([surface[lost], status[lost]]), axis=1, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    one = order.size == 1
    return ", ".join(
        f"{'' if one else f'{counts[k]} '}at {system.surfaces[kinds[0, k]].name}: {_WHY[int(kinds[1, k])]}"
        for k in order.tolist()
    )


def point_name(system: OpticalSystem, point: Array) -> str:
    """Return a field point in words, such as ``(0, 10) deg``."""
    x, y = point
    if np.isinf(system.object_distance):
        return f"({np.rad2deg(x) + 0.0:.4g}, {np.rad2deg(y) + 0.0:.4g}) deg"
    return f"({x:.4g}, {y:.4g}) mm"


def _aimed(aim: Aim, numbers: Array, target: Array) -> NDArray[np.bool_]:
    """Tell which rays meet their targets."""
    return np.asarray(np.max(np.abs(aim.meet(numbers) - target), axis=0) <= AIMED)


def _no_chief(system: OpticalSystem, aim: Aim, start: Array, numbers: Array, beam: float, where: str) -> str:
    """Say that there is no chief ray, and why."""
    if not np.isfinite(aim.meet(start)).all():  # the paraxial one shows at what
        traced = trace_sequence_numpy(aim.sequence, aim.bundle.rays(start), aim.poses, True)
        status, surface = int(traced.status[0, 0]), int(traced.surface[0, 0])
    else:
        why, at = ends(aim, numbers, np.zeros((2, 1)), beam, False)
        status, surface = int(why[0]), int(at[0])
    return (
        f"{where} the chief ray of {system.name} cannot be aimed at the stop "
        f"{system.surfaces[system.stop].name}: it is lost at {system.surfaces[surface].name}, "
        f"{LOSSES[status]}; make the field smaller"
    )


def require_light(system: OpticalSystem) -> None:
    """Raise UserError unless light of every field point and wavelength can set out for the stop."""
    for wavelength in map(float, system.wavelengths):
        data = paraxial(system, wavelength)
        for field in system.fields:
            _bundle(system, data, field, wavelength, is_wide(field))


def _require_distance(system: OpticalSystem) -> None:
    """Raise UserError if the object stands in the first surface; behind it, it is virtual."""
    if abs(way_from_object(system)) < _TOUCHES_MM:
        raise UserError(f"the object of {system.name} stands in the first surface; move it off")


def _bundle(
    system: OpticalSystem, data: Paraxial, field: Array, wavelength: float, wide: bool
) -> tuple[Bundle, Array]:
    """Return the bundle of a field point and the numbers of its paraxial chief ray.

    Light of `wide` fields sets out from a plane at right angles to it, through which it goes towards the
    center of the entrance pupil.
    """
    index = refractive_index(system.medium, wavelength)
    first = first_vertex_z(system)
    if not isfinite(system.object_distance):
        if not isfinite(data.entrance_pupil):
            raise UserError(
                f"the object and the entrance pupil of {system.name} are both at infinity; move the stop"
            )
        center = entrance_pupil_center(system, wavelength)
        if wide:
            direction = field_direction(field)
            origin = center - 2.0 * abs(first - center[2]) * direction
            return Bundle(origin, direction, center, index, axes_across(direction)), np.zeros(2)
        direction = np.array([*np.tan(field), 1.0])
        chief = center + (first - center[2]) * direction
        direction /= np.linalg.norm(direction)
        return Bundle(np.array([0.0, 0.0, first]), direction, center, index), chief[:2]
    _require_distance(system)
    origin = np.array([*field, system.surfaces[0].position[2] - system.object_distance])
    if system.telecentric or not isfinite(data.entrance_pupil):
        if abs(data.entrance_pupil) < _TELECENTRIC * abs(system.object_distance):
            raise UserError(
                f"the system {system.name} is declared telecentric, but its entrance pupil lies "
                f"{data.entrance_pupil:.6g} mm behind the first surface; place the stop in the focal plane "
                "of what stands before it"
            )
        return Bundle(origin, None, origin, index), np.zeros(2)
    towards = entrance_pupil_center(system, wavelength) - origin
    if abs(towards[2]) < 1e-9 * abs(system.object_distance):
        raise UserError(f"the entrance pupil of {system.name} lies in its object")
    return Bundle(origin, None, origin, index), towards[:2] / towards[2]


def _beam_size(system: OpticalSystem, data: Paraxial, wavelength: float) -> float:
    """Return the radius of the beam as the numbers of a bundle measure it."""
    if not isfinite(system.object_distance):
        return data.entrance_pupil_diameter / 2.0
    return data.object_na / refractive_index(system.medium, wavelength)


def _up_to_stop(system: OpticalSystem, wavelength: float) -> tuple[Sequence, Moving]:
    """Return the surfaces up to the stop, which does nothing, at rest."""
    whole, rest = pack(system, wavelength), moving(system, rest_states(system))
    count = system.stop + 1
    elements = whole.elements[:count]
    last = replace(elements[-1], action="pass")
    return (
        replace(whole, elements=(*elements[:-1], last)),
        Moving(rest.poses[:, :count], rest.deformations[:count], rest.grids[:count]),
    )


def _where(system: OpticalSystem, field: Array, wavelength: float) -> str:
    return f"at field {point_name(system, field)} and {_NM_PER_MM * wavelength:.6g} nm"
