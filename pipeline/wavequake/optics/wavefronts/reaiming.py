"""Rays aimed anew at a stop that moved, to first order: what derivatives need.

Light that follows the stop is moved as a whole (`wavequake.optics.rays.stop_following`), and rays beside the
chief ray miss their points of the moved stop by the distortion of the pupil. What they would show there
differs by the miss times the slopes over the stop at rest. Of that, an error of second order in the motion
remains, which central differences do not see.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.devices import NUMPY, Device
from wavequake.kernels.trace.sequence import TracedRays
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.optics.rays.aiming import aimed_rays
from wavequake.optics.rays.packing import moving
from wavequake.optics.rays.stop_following import meet_stop
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import States
from wavequake.optics.wavefronts.wavefront import (
    PreparedSystem,
    Traced,
    about_chief,
    chief_points,
    incoming_light,
    trace_light,
)
from wavequake.prepared import prepared

Array = NDArray[np.float64]

_STEP = 1e-3  # of the differences over the stop, of its radius
_SIDES = ((1.0, -1.0, 0.0, 0.0), (0.0, 0.0, 1.0, -1.0))  # of points, along x and y
_NAMES = ("x", "y", "u", "v")


@dataclass(frozen=True)
class StopSlopes:
    """How what rays show changes over the stop at rest.

    Attributes
    ----------
    met : ndarray, shape (2, N)
        Where the rays meet the stop, mm.
    opd : ndarray, shape (2, N)
        Derivatives of the OPD with x and y on the stop, waves per mm.
    image : ndarray, shape (4, 2, N)
        Those of x, y (mm per mm) and of u, v (per mm) at the image.
    """

    met: Array
    opd: Array
    image: Array


@prepared(maxsize=4)  # derivatives by motions and by figures need the same
def stop_slopes(prepared: PreparedSystem) -> StopSlopes:
    """Return the slopes at rest, by central differences of rays aimed beside their points.

    They are 0 where no ray reaches a point beside.
    """
    system = prepared.system
    light = moving(system, rest_states(system))
    chief, _ = chief_points(prepared, light)
    about = about_chief(prepared, light, chief)
    points, count = prepared.pupil.T, len(prepared.pupil)
    beside = (points[:, None] + _STEP * np.array(_SIDES)[..., None]).reshape(2, -1)
    rays = aimed_rays(system, system.fields[prepared.field], prepared.wavelength, *beside).rays
    traced = trace_sequence(prepared.sequence, rays, about, NUMPY, ignore_apertures=True)
    shown = np.stack([getattr(traced, one)[0] for one in ("path", *_NAMES)]).reshape(5, 2, 2, count)
    width = 2.0 * _STEP * paraxial(system, prepared.wavelength).stop_radius
    slopes = np.nan_to_num((shown[:, :, 0] - shown[:, :, 1]) / width).swapaxes(0, 1)  # (2, 5, N)
    met = meet_stop(prepared.sequence, prepared.rays, light, system.stop)[:, 0]
    return StopSlopes(met, -slopes[:, 0] / prepared.wavelength, np.moveaxis(slopes[:, 1:], 0, 1))


def trace_aimed(prepared: PreparedSystem, slopes: StopSlopes, states: States, device: Device) -> Traced:
    """Trace rays that meet their points of the stop where that is, to first order; as `trace_system`."""
    light = incoming_light(prepared, states, device)
    opd, traced, chief = trace_light(prepared, light, device)
    met = meet_stop(prepared.sequence, prepared.rays, light, prepared.system.stop)
    miss = met - slopes.met[:, None]
    if not np.nan_to_num(miss).any():
        return opd, traced, chief
    shown = {
        name: np.asarray(getattr(traced, name)) - (miss * slope[:, None]).sum(axis=0)
        for name, slope in zip(_NAMES, slopes.image, strict=True)
        if np.shape(getattr(traced, name)) == miss.shape[1:]
    }
    aimed: TracedRays = replace(traced, **shown)
    return np.asarray(opd) - (miss * slopes.opd[:, None]).sum(axis=0), aimed, chief
