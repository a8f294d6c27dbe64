"""Surfaces that light meets against the sense of the axis ray, where programs take different points."""

import numpy as np

from wavequake.errors import UserError
from wavequake.kernels.trace.sequential_numpy import LOST_RAYS_ARE_DATA, walk
from wavequake.kernels.trace.status import OK
from wavequake.optics.rays.aiming import aimed_rays
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.systems.axis_ray import senses
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import OpticalSystem, Surface, is_wide, wavelength_of

# The chief ray and four marginal rays.
_X, _Y = np.array([0.0, 1.0, -1.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0, -1.0])


@LOST_RAYS_ARE_DATA
def other_points(system: OpticalSystem) -> list[str]:
    """Return the names of curved surfaces that a chief or marginal ray meets against the axis ray's sense.

    A ray that leaves a mirror forwards meets a sphere twice. Here it takes the point at which it crosses the
    sphere in the sense in which it crosses the vertex plane; OpticStudio takes the other one in its sample
    Shafer1980. Where a field's rays cannot be aimed it says nothing. Where fields are wide, all surfaces are
    met in the sense of the axis ray.
    """
    if np.isinf(system.object_distance) and is_wide(system.fields):
        return []
    wavelength = wavelength_of(system)
    sense = senses(system, wavelength)
    sequence, rest = pack(system, wavelength), moving(system, rest_states(system))
    found: set[int] = set()
    for field in system.fields:
        try:
            rays = aimed_rays(system, field, wavelength, _X, _Y, openings=False).rays
        except UserError:
            continue
        behind = rays.direction
        for number, (state, _) in enumerate(walk(sequence, rays, rest, ignore_apertures=True)):
            turn = rest.poses[0, number, :9].reshape(3, 3)
            against = (turn[2] @ behind) * sense[number] < 0.0
            if _decides(system, number) and (against & (state.status[0] == OK)).any():
                found.add(number)
            behind = state.direction[:, 0]
    return list(dict.fromkeys(system.surfaces[number].name for number in sorted(found)))


def _decides(system: OpticalSystem, number: int) -> bool:
    """Return whether it matters at which of two points light meets the surface."""
    surface: Surface = system.surfaces[number]
    acts = surface.action != "pass" or surface.phase is not None or surface.opening is not None
    return np.isfinite(surface.shape.radius) and (acts or number == len(system.surfaces) - 1)
