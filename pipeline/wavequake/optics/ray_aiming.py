"""Rays of a field point that meet given points of the real stop."""

from dataclasses import dataclass, replace
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.sequence import (
    DIVERGED,
    MISS,
    OK,
    TOTAL_REFLECTION,
    Moving,
    Rays,
    Sequence,
)
from wavequake.kernels.sequential_numpy import trace_sequence_numpy
from wavequake.optics.media import refractive_index
from wavequake.optics.packing import moving, pack
from wavequake.optics.paraxial import Paraxial, entrance_pupil_center, first_vertex_z, paraxial
from wavequake.optics.system import OpticalSystem
from wavequake.optics.system_kinematics import rest_states

Array = NDArray[np.float64]

_AIMED = 1e-9  # largest distance from the point of the stop that is aimed at, mm
_STEPS = 30
_HALVINGS = 10
_DIFFERENCE = 1e-4  # step of the differences, as a share of the beam's radius
_TELECENTRIC = 100.0  # an entrance pupil that many object distances away makes chief rays parallel
LOSSES = {
    MISS: "it misses that surface",
    TOTAL_REFLECTION: "it is totally reflected there",
    DIVERGED: "that surface folds over",
}
"""What happens to a ray that ends at a surface, by its status."""


@dataclass(frozen=True)
class _Bundle:
    """The rays of a field point by two numbers each: where they cross a plane, or their slopes.

    ``origin`` (3,) is a point of that plane or the object point, ``direction`` (3,) that of all rays of an
    infinitely far object or None, ``reference`` (3,) where the wave of such an object has the phase 0.
    """

    origin: Array
    direction: Array | None
    reference: Array
    index: float

    def rays(self, numbers: Array) -> Rays:
        """Return the rays of the numbers (2, N)."""
        flat = np.concatenate([numbers, np.zeros((1, numbers.shape[1]))])
        if self.direction is None:
            direction = flat + np.array([[0.0], [0.0], [1.0]])
            direction /= np.sqrt(np.sum(direction**2, axis=0))
            position = np.broadcast_to(self.origin[:, None], direction.shape).copy()
            return Rays(position, direction, np.zeros(numbers.shape[1]))
        position = flat + self.origin[:, None]
        direction = np.broadcast_to(self.direction[:, None], position.shape).copy()
        path = self.index * (self.direction @ (position - self.reference[:, None]))
        return Rays(position, direction, path)


def pupil_rays(system: OpticalSystem, field: Array, wavelength: float, x: Array, y: Array) -> Rays:
    """Return rays that meet the stop surface at (x, y) times the radius of the stop, to 1e-9 mm.

    The rays start on the plane through the first surface's vertex (object at infinity; the optical path
    counts from the wavefront through the entrance pupil's center) or at the object point. Newton's iteration
    starts at the paraxial chief ray. Openings are ignored: the chief ray of an annular pupil, at (0, 0), is
    virtual.

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
        If the system is out of range, or rays do not reach the points of the stop: the message names the
        surface at which the first of them is lost.
    """
    field, x, y = (np.asarray(a, dtype=np.float64) for a in (field, x, y))
    if field.shape != (2,) or not np.isfinite(field).all():
        raise UserError(f"a field of {system.name} is {field.tolist()}; it must be 2 finite numbers")
    if x.ndim != 1 or x.shape != y.shape or not np.isfinite([*x, *y]).all():
        raise UserError("the pupil coordinates x and y must be two equally long lists of finite numbers")
    data = paraxial(system, wavelength)
    bundle, start = _bundle(system, data, field, wavelength)
    to_stop, poses = _up_to_stop(system, wavelength)
    radius = data.stop_radius
    beam = _beam_size(system, data, wavelength)
    aim = _Aim(to_stop, poses, bundle, _DIFFERENCE * beam)
    chief = _newton(aim, start[:, None], np.zeros((2, 1)))
    _require_aimed(system, aim, chief, np.zeros((2, 1)), "chief ray")
    target = radius * np.stack([x, y])
    _, slopes = aim.meet_with_slopes(chief)
    if abs(_determinant(slopes)[0]) * beam**2 < 1e-12 * radius**2:
        raise UserError(
            f"the stop of {system.name} lies in an image of its object and limits no cone of light"
        )
    guess = chief + _solved(slopes, target)
    numbers = _newton(aim, guess, target, chief)
    _require_aimed(system, aim, numbers, target, f"of {x.size} rays", guess)
    return bundle.rays(numbers)


@dataclass(frozen=True)
class _Aim:
    """The map from the numbers of rays to where they meet the stop."""

    sequence: Sequence
    poses: Moving
    bundle: _Bundle
    difference: float

    def meet(self, numbers: Array) -> Array:
        """Return x and y on the stop (2, N), NaN for lost rays."""
        traced = trace_sequence_numpy(self.sequence, self.bundle.rays(numbers), self.poses, True)
        return np.concatenate([traced.x, traced.y])

    def meet_with_slopes(self, numbers: Array) -> tuple[Array, Array]:
        """Return x and y on the stop (2, N) and their derivatives (N, 2, 2)."""
        steps = np.array([[0.0, 1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0, -1.0]]) * self.difference
        probes = (numbers[:, None, :] + steps[:, :, None]).reshape(2, -1)
        met = self.meet(probes).reshape(2, 5, -1)
        slopes = np.stack([met[:, 1] - met[:, 2], met[:, 3] - met[:, 4]], axis=1) / (2.0 * self.difference)
        return met[:, 0], np.moveaxis(slopes, -1, 0)


def _newton(aim: _Aim, numbers: Array, target: Array, safe: Array | None = None) -> Array:
    """Return numbers whose rays meet the target (2, N); a step that loses a ray is halved."""
    if safe is not None:
        numbers = _recovered(aim, np.broadcast_to(safe, numbers.shape), numbers)
    for _ in range(_STEPS):
        met, slopes = aim.meet_with_slopes(numbers)
        miss = target - met
        going = (np.max(np.abs(miss), axis=0) > 0.1 * _AIMED) & np.isfinite(slopes).all(axis=(1, 2))
        if not going.any():
            break
        going &= _determinant(slopes) != 0.0
        slopes = np.where(going[:, None, None], slopes, np.eye(2))
        step = _solved(slopes, np.where(going, miss, 0.0))
        numbers = _recovered(aim, numbers, numbers + step)
    return numbers


def _determinant(slopes: Array) -> Array:
    """Return the determinants (N,) of matrices (N, 2, 2)."""
    return np.asarray(slopes[:, 0, 0] * slopes[:, 1, 1] - slopes[:, 0, 1] * slopes[:, 1, 0])


def _solved(slopes: Array, right: Array) -> Array:
    """Return the solutions (2, N) of N systems, each by itself: a ray's bits do not depend on the others."""
    x = slopes[:, 1, 1] * right[0] - slopes[:, 0, 1] * right[1]
    y = slopes[:, 0, 0] * right[1] - slopes[:, 1, 0] * right[0]
    return np.stack([x, y]) / _determinant(slopes)


def _recovered(aim: _Aim, good: Array, numbers: Array) -> Array:
    """Return numbers, or points half way, a quarter of the way ... from good ones, that reach the stop."""
    for _ in range(_HALVINGS):
        lost = ~np.isfinite(aim.meet(numbers)).all(axis=0)
        if not lost.any():
            break
        numbers = np.where(lost, 0.5 * (good + numbers), numbers)
    return numbers


def require_real_object(system: OpticalSystem) -> None:
    """Raise UserError unless the object stands before the first surface, from where its light can come."""
    if not system.object_distance > 0.0:
        raise UserError(
            f"the object of {system.name} stands {system.object_distance:g} mm before the first surface; "
            "the distance must be positive"
        )


def _bundle(system: OpticalSystem, data: Paraxial, field: Array, wavelength: float) -> tuple[_Bundle, Array]:
    """Return the bundle of a field point and the numbers of its paraxial chief ray."""
    index = refractive_index(system.medium, wavelength)
    first = first_vertex_z(system)
    if not isfinite(system.object_distance):
        if not isfinite(data.entrance_pupil):
            raise UserError(
                f"the object and the entrance pupil of {system.name} are both at infinity; move the stop"
            )
        center = entrance_pupil_center(system, wavelength)
        direction = np.array([*np.tan(field), 1.0])
        chief = center + (first - center[2]) * direction
        direction /= np.linalg.norm(direction)
        return _Bundle(np.array([0.0, 0.0, first]), direction, center, index), chief[:2]
    require_real_object(system)
    origin = np.array([*field, first - system.object_distance])
    if system.telecentric or not isfinite(data.entrance_pupil):
        if abs(data.entrance_pupil) < _TELECENTRIC * system.object_distance:
            raise UserError(
                f"the system {system.name} is declared telecentric, but its entrance pupil lies "
                f"{data.entrance_pupil:.6g} mm behind the first surface; place the stop in the focal plane "
                "of what stands before it"
            )
        return _Bundle(origin, None, origin, index), np.zeros(2)
    towards = entrance_pupil_center(system, wavelength) - origin
    if abs(towards[2]) < 1e-9 * abs(system.object_distance):
        raise UserError(f"the entrance pupil of {system.name} lies in its object")
    return _Bundle(origin, None, origin, index), towards[:2] / towards[2]


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


def _require_aimed(
    system: OpticalSystem,
    aim: _Aim,
    numbers: Array,
    target: Array,
    which: str,
    guess: Array | None = None,
) -> None:
    """Raise UserError if rays do not meet their points of the stop; name the surface that loses the first."""
    miss = np.max(np.abs(aim.meet(numbers) - target), axis=0)
    bad = np.flatnonzero(~(miss <= _AIMED))
    if not bad.size:
        return
    # Where the ray goes on its way to the target, not where the iteration has retreated to.
    met, slopes = aim.meet_with_slopes(numbers[:, bad[:1]])
    ahead = numbers[:, bad[:1]]
    if np.isfinite(slopes).all() and _determinant(slopes)[0] != 0.0:
        ahead = ahead + _solved(slopes, target[:, bad[:1]] - met)
    if guess is not None and np.isfinite(aim.meet(ahead)).all():
        ahead = guess[:, bad[:1]]  # it got stuck; the paraxial ray shows at what
    traced = trace_sequence_numpy(aim.sequence, aim.bundle.rays(ahead), aim.poses, True)
    status, surface = int(traced.status[0, 0]), int(traced.surface[0, 0])
    count = f"{bad.size} {which}" if which.startswith("of") else f"the {which}"
    stop = system.surfaces[system.stop].name
    if status == OK:
        raise UserError(
            f"{count} of {system.name} cannot be aimed at the stop {stop}: the iteration ends "
            f"{np.nanmin(miss[bad]):.3g} mm beside the point"
        )
    raise UserError(
        f"{count} of {system.name} cannot be aimed at the stop {stop}: the ray is lost at "
        f"{system.surfaces[surface].name}, {LOSSES[status]}; make the pupil or the field smaller"
    )
