"""Rays of one of a system's fields, with what its vignetting factors stop."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.trace.sequence import OK, VIGNETTED
from wavequake.optics.rays.aiming import AimedRays, aimed_rays
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem

Array = NDArray[np.float64]


def field_light(system: OpticalSystem, field: int, wavelength: float, x: Array, y: Array) -> AimedRays:
    """Return the rays of a field that meet the stop at (x, y), as `aimed_rays` does.

    Rays outside the ellipse that the system's vignetting factors leave of the stop are vignetted there.

    Parameters
    ----------
    system : OpticalSystem
    field : int
        Index of the field.
    wavelength : float
        mm.
    x, y : ndarray, shape (N,)
        Normalized coordinates in the stop; 1 is its rim.
    """
    aimed = aimed_rays(system, system.fields[field], wavelength, x, y)
    if not system.vignetting:
        return aimed
    # The factors are seen from the object, where the stop may appear upside down.
    sense = np.sign(paraxial(system).pupil_magnification)
    stopped = ~inside_ellipse(sense * x, sense * y, system.vignetting[field]) & (aimed.status == OK)
    if not stopped.any():
        return aimed
    gone = np.where(stopped, np.nan, 1.0)
    rays = replace(
        aimed.rays,
        position=aimed.rays.position * gone,
        direction=aimed.rays.direction * gone,
        path=aimed.rays.path * gone,
    )
    status = np.where(stopped, VIGNETTED, aimed.status).astype(np.int8)
    return AimedRays(rays, status, np.where(stopped, system.stop, aimed.surface).astype(np.int8))


def inside_ellipse(x: Array, y: Array, factors: tuple[float, ...]) -> NDArray[np.bool_]:
    """Tell which points of the unit circle vignetting factors leave.

    They take the unit circle (u, v) to x + iy = exp(i angle) (dx + (1 - cx) u + i (dy + (1 - cy) v)), with
    ``factors`` (dx, dy, cx, cy, angle).
    """
    dx, dy, cx, cy, angle = factors
    turned = (x + 1j * y) * np.exp(-1j * angle)
    u, v = (turned.real - dx) / (1.0 - cx), (turned.imag - dy) / (1.0 - cy)
    return np.asarray(u**2 + v**2 <= 1.0 + 1e-12)
