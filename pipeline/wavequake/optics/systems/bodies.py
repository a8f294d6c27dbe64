"""Surfaces that move as one rigid body, such as the faces of a lens, and what a beam fills of a surface."""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.trace.sequence import Moving, Rays
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.optics.checks import array
from wavequake.optics.rays.aiming import aimed_rays
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.segments.kinematics import cardan, cardan_angles
from wavequake.optics.systems.kinematics import motion_about, rest_poses, rest_states
from wavequake.optics.systems.system import OpticalSystem, States, wavelength_of

Array = NDArray[np.float64]

_RIM_RAYS = 64
_PUPIL_RAYS = 1000


@dataclass(frozen=True)
class Body:
    """Surfaces, by index, that shift along the axes of ``rotation`` and turn about them through ``point``.

    ``point`` (3,) and ``rotation`` (3, 3), from the body's frame to the system's, are those at rest.
    """

    name: str
    surfaces: tuple[int, ...]
    point: Array
    rotation: Array


def surface_index(system: OpticalSystem, name: str) -> int:
    """Return the index of a surface by name; UserError if there is none, or more than one."""
    names = [surface.name for surface in system.surfaces]
    if name not in names:
        near = difflib.get_close_matches(name, names, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(names)}."
        raise UserError(f"{system.name} has no surface {name!r}; {hint}")
    if names.count(name) > 1:
        raise UserError(
            f"{system.name} has {names.count(name)} surfaces called {name!r}, which one is meant?"
        )
    return names.index(name)


def rigid_body(
    system: OpticalSystem, name: str, surfaces: Sequence[str], point: Sequence[float] | None = None
) -> Body:
    """Return the body of the named surfaces, with the axes of the first of them.

    Parameters
    ----------
    system : OpticalSystem
    name : str
    surfaces : sequence of str
    point : sequence of 3 floats, optional
        Where it turns, in the system's frame, mm; by default the middle between its first and last vertex.

    Raises
    ------
    UserError
        If a surface does not exist or is named twice, there is none, or the point is not 3 finite numbers.
    """
    if isinstance(surfaces, str) or not surfaces:
        raise UserError(f"The body {name!r} has the surfaces {surfaces!r}; give a list of at least one name.")
    try:
        chosen = tuple(surface_index(system, one) for one in surfaces)
    except UserError as error:
        raise UserError(f"The body {name!r}: {error}") from None
    if len(set(chosen)) < len(chosen):
        raise UserError(f"The body {name!r} names a surface twice; name each one once.")
    first, last = (system.surfaces[index] for index in (min(chosen), max(chosen)))
    middle = (first.position + last.position) / 2.0
    at = middle if point is None else array(point, f"the point of the body {name!r}").copy()
    if at.shape != (3,) or not np.isfinite(at).all():
        raise UserError(f"The body {name!r} turns about {point!r}; that must be 3 finite numbers, mm.")
    return Body(name, chosen, at, np.asarray(first.rotation, dtype=np.float64))


def with_bodies(system: OpticalSystem, own: Array, bodies: Sequence[tuple[Body, Array]]) -> Array:
    """Return the motions of surfaces that move by themselves and are carried by bodies.

    Parameters
    ----------
    system : OpticalSystem
    own : ndarray, shape (T, L, 6)
        Of each surface in its own frame at rest, mm and rad.
    bodies : sequence of (Body, ndarray of shape (T, 6))
        Of each body in its frame at rest; where bodies share a surface, later ones carry earlier ones.

    Returns
    -------
    ndarray, shape (T, L, 6)
        As ``States.surface_motion``; exact for large motions.
    """
    position, rotation = rest_poses(system)
    motion = own.copy()
    for body, moved in bodies:
        turn = body.rotation @ cardan(moved[:, 3:]) @ body.rotation.T
        shift = moved[:, :3] @ body.rotation.T
        for index in body.surfaces:
            home = rotation[index]
            # The surface's point p, away from the body's point by a, moves by G a - a + shift.
            away = position[index] + motion[:, index, :3] @ home.T - body.point
            change = shift - motion_about(away, turn)
            motion[:, index, :3] += change @ home
            motion[:, index, 3:] = cardan_angles(home.T @ turn @ home @ cardan(motion[:, index, 3:]))
    return motion


def beam_radii(system: OpticalSystem, surfaces: Sequence[int]) -> Array:
    """Return how far from their vertices the beams of all fields fill surfaces at rest, mm.

    Parameters
    ----------
    system : OpticalSystem
    surfaces : sequence of int
        Indices.

    Returns
    -------
    ndarray, shape (len(surfaces),)

    Raises
    ------
    UserError
        If no ray from the pupil's rim or within it reaches one of them.
    """
    return _reach(system, surfaces)[:, 2]


def beam_extents(system: OpticalSystem, surfaces: Sequence[int], states: States | None = None) -> Array:
    """Return the largest |x| and |y| (len(surfaces), 2) of the beams of all fields, mm; as `beam_radii`.

    Of light that is aimed at rest, by default also at rest, or in `states` of the system.
    """
    return _reach(system, surfaces, states)[:, :2]


def _reach(system: OpticalSystem, surfaces: Sequence[int], states: States | None = None) -> Array:
    """Return the largest |x|, |y| and distance from the vertex (len(surfaces), 3); raises as `beam_radii`."""
    wavelength = wavelength_of(system)
    if not surfaces:
        return np.zeros((0, 3))
    whole, light = pack(system, wavelength), moving(system, states or rest_states(system))
    reach = np.zeros((len(surfaces), 3))
    for field in system.fields:
        rays = _rays(system, field, wavelength)
        for place, surface in enumerate(surfaces):
            count = surface + 1
            sequence = replace(whole, elements=whole.elements[:count])
            poses = Moving(light.poses[:, :count], light.deformations[:count], light.grids[:count])
            traced = trace_sequence(sequence, rays, poses, NUMPY, ignore_apertures=True)
            away = np.nan_to_num([np.abs(traced.x), np.abs(traced.y), np.hypot(traced.x, traced.y)])
            reach[place] = np.maximum(reach[place], away.max(axis=(1, 2)))
    for surface, radius in zip(surfaces, reach[:, 2], strict=True):
        if radius == 0.0:
            name = system.surfaces[surface].name
            raise UserError(f"no ray from the rim of the pupil of {system.name} reaches the surface {name}")
    return reach


def _rays(system: OpticalSystem, field: Array, wavelength: float) -> Rays:
    """Return rays of the pupil's rim, or of all of it where some of the rim do not reach the stop."""
    angle = 2.0 * np.pi * np.arange(_RIM_RAYS) / _RIM_RAYS
    x, y = np.cos(angle), np.sin(angle)
    aimed = aimed_rays(system, field, wavelength, x, y)
    if aimed.lost.any():
        inside = sunflower(0.0, 1.0, _PUPIL_RAYS)
        x, y = np.concatenate([x, inside.x]), np.concatenate([y, inside.y])
        aimed = aimed_rays(system, field, wavelength, x, y)
    return aimed.rays
