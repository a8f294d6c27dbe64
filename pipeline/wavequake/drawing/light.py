"""Rays through a system at rest, as they are drawn: from the object or entry to where each one ends."""

from dataclasses import dataclass
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.trace.paths import trace_paths
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.status import OK
from wavequake.optics.rays.aiming import aimed_rays, point_name
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import OpticalSystem, wavelength_of

Array = NDArray[np.float64]

_INSIDE = 1e-6  # of the stop's radius: rays of the rim are not stopped by its rounding
_FAR = 3.0  # an object that many lengths of the system away is drawn no farther
_ENTRY = 0.12  # of the size of the system: how far before it light is drawn
_BENDS = 24  # points of a curved way, at most


@dataclass(frozen=True)
class Way:
    """How the N rays of a field go.

    Attributes
    ----------
    field : int
        Its number.
    direction : ndarray, shape (3, N)
        In which they set out.
    points : ndarray, shape (P, 3, N)
        Where they begin, then the way to every surface, in the system's frame, mm; NaN behind a ray's end.
    hits : ndarray, shape (L, 3, N)
        Those of the points that lie on the surfaces.
    arrives : ndarray of bool, shape (N,)
        Which rays reach the image.
    """

    field: int
    direction: Array
    points: Array
    hits: Array
    arrives: NDArray[np.bool_]


def way(system: OpticalSystem, field: int, x: Array, y: Array) -> Way:
    """Trace the rays of a field that meet the stop at (x, y) times its radius, at the primary wavelength.

    Rays that cannot be aimed, since their light is lost before, are left out.

    Raises
    ------
    UserError
        As `wavequake.optics.rays.aiming.aimed_rays`.
    """
    wavelength = wavelength_of(system)
    aimed = aimed_rays(system, system.fields[field], wavelength, x, y)
    known, rays = ~aimed.lost, aimed.rays
    rays = Rays(
        np.ascontiguousarray(rays.position[:, known]),
        np.ascontiguousarray(rays.direction[:, known]),
        np.ascontiguousarray(rays.path[known]),
    )
    traced = trace_paths(pack(system, wavelength), rays, moving(system, rest_states(system)))
    parts = [rays.position[None], *(_thinned(part[:, :, 0]) for part in traced.points)]
    return Way(
        field,
        rays.direction,
        np.concatenate(parts),
        np.stack([part[-1, :, 0] for part in traced.points]),
        traced.status[0] == OK,
    )


def _thinned(points: Array) -> Array:
    """Return some of the points (K, 3, N) of a curved way, the last one among them."""
    step = -(-len(points) // _BENDS)
    return points[::-1][::step][::-1]


def ring(radius: float, count: int) -> tuple[Array, Array]:
    """Return points of the stop on a circle of a share of its radius."""
    angle = 2.0 * np.pi * np.arange(count) / count
    return radius * np.cos(angle), radius * np.sin(angle)


def rim(system: OpticalSystem, field: int, count: int = 48) -> Way:
    """Return the rays of the pupil's rim; where it is obscured the second half is that of its inner rim."""
    parts = [ring(1.0 - _INSIDE, count)]
    if system.pupil.obscuration > 0.0:
        parts.append(ring(system.pupil.obscuration + _INSIDE, count))
    x, y = np.concatenate(parts, axis=1)
    return way(system, field, x, y)


def fan(system: OpticalSystem, field: int, normal: Array, count: int = 7) -> Way:
    """Return rays of a field in the plane with this normal (3,), as it cuts the stop."""
    across = in_surface(system.surfaces[system.stop].rotation, normal)
    inner, outer = system.pupil.obscuration, 1.0 - _INSIDE
    if inner > 0.0:
        half = np.linspace(inner + _INSIDE, outer, max(2, (count + 1) // 2))
        share = np.concatenate([-half[::-1], half])
    else:
        share = np.linspace(-outer, outer, count)
    return way(system, field, share * across[0], share * across[1])


def in_surface(rotation: Array, normal: Array) -> Array:
    """Return the direction (2,) in which a plane with this normal cuts a surface's own x-y plane."""
    local = rotation.T @ normal
    across = np.array([local[1], -local[0]])
    size = float(np.hypot(*across))
    return -across / size if size > 1e-6 else np.array([0.0, 1.0])


def beginnings(system: OpticalSystem, ways: list[Way]) -> list[Array]:
    """Return the points (P, 3, N) of ways whose rays begin where a drawing lets them.

    Light from infinity begins on one plane before everything; that of a far object near the system, too.
    """
    hits = np.concatenate([one.hits.reshape(-1, 3, one.hits.shape[2]) for one in ways], axis=2)
    low, high = np.nanmin(hits, axis=(0, 2)), np.nanmax(hits, axis=(0, 2))
    size = float((high - low).max()) or 1.0
    far = not isfinite(system.object_distance)
    begin = low[2] - _ENTRY * size if far else low[2] - _FAR * size
    found = []
    for one in ways:
        start, points = one.points[0], one.points.copy()
        if far or begin > start[2].min():
            points[0] = start + (begin - start[2]) / one.direction[2] * one.direction
        found.append(points)
    return found


def field_names(system: OpticalSystem) -> list[str]:
    """Return what the fields are called in a legend: as in tables."""
    return [point_name(system, point) for point in system.fields]


def all_ways(system: OpticalSystem, normal: Array | None = None, count: int = 7) -> list[Way]:
    """Return the rims or, with a normal, the fans of all fields whose light arrives somewhere.

    Raises
    ------
    UserError
        If no field has a chief ray: the message is that of the first one.
    """
    found, trouble = [], None
    for field in range(len(system.fields)):
        try:
            one = rim(system, field) if normal is None else fan(system, field, normal, count)
        except UserError as error:
            trouble = trouble or error
            continue
        if one.points.shape[2]:
            found.append(one)
    if not found:
        raise trouble or UserError(f"no ray of {system.name} can be drawn: none reaches its stop")
    return found
