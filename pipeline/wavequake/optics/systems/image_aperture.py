"""Cones of light: how directions in the image, and from a near object, follow from places in the pupil."""

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.trace.sequence import Sequence, TracedRays
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.kernels.trace.status import OK
from wavequake.optics.rays.aiming import aimed_rays, losses
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.shapes.shapes import Conic
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import OpticalSystem, wavelength_of

Array = NDArray[np.float64]

_PARALLEL = 1e-9  # smallest numerical aperture of an image; rounding of the rays would be 1e-7 of it
_SHARES = (1.0, 0.5, 0.125, 0.015625)  # of the pupil's radius, at which its numerical aperture is looked for
_RIM = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])


def image_cosines(system: OpticalSystem, sequence: Sequence, point: Array, wavelength: float) -> Array:
    """Return the change of direction cosines in the image from the pupil's center to its rim, shape (2, 2).

    The rim's where all four of its rays arrive, else that of rays closer to the center times their distance.

    Parameters
    ----------
    system : OpticalSystem
    sequence : Sequence
        Its surfaces at the wavelength.
    point : ndarray, shape (2,)
        Field point.
    wavelength : float
        mm.

    Returns
    -------
    ndarray, shape (2, 2)
        Of u and v (rows) by x and y in the pupil; in a curved image along its slopes in x and in y.

    Raises
    ------
    UserError
        If rays close to the chief ray are lost, or arrive parallel to each other.
    """
    rest = moving(system, rest_states(system))
    for share in _SHARES:
        rim = aimed_rays(system, point, wavelength, *(share * _RIM))
        traced = trace_sequence(sequence, rim.rays, rest, NUMPY, ignore_apertures=True)
        if (traced.status == OK).all():
            u, v = _along(system, traced) / share
            cosines = np.array([[u[0] - u[1], u[2] - u[3]], [v[0] - v[1], v[2] - v[3]]]) / 2.0
            _require_cone(system, cosines)
            return cosines
    status = np.where(rim.lost, rim.status, traced.status[0])
    surface = np.where(rim.lost, rim.surface, traced.surface[0])
    raise UserError(
        f"{np.count_nonzero(status)} of 4 rays close to the chief ray of {system.name} are lost, "
        f"{losses(system, status, surface)}; make the field smaller"
    )


def _along(system: OpticalSystem, traced: TracedRays) -> Array:
    """Return by how much each path (2, N) shortens where the image point moves on the image in x or in y."""
    u, v = traced.u[0], traced.v[0]
    w = traced.w_sign[0] * np.sqrt(1.0 - u**2 - v**2)
    _, slope_x, slope_y = shape_sag(system.surfaces[-1].shape, traced.x[0].mean(), traced.y[0].mean())
    return np.stack([u + slope_x * w, v + slope_y * w])


def real_apertures(system: OpticalSystem) -> tuple[Array, Array] | None:
    """Return the numerical apertures of the axis point's real rays, in the object and in the image.

    Paraxial ones differ from them where the sine condition does not hold, as that of a fast paraboloid.

    Returns
    -------
    two ndarray, shape (2,), or None
        n times half of what direction cosines change by across the pupil, the largest and the smallest over
        all azimuths; None if a ray of the rim does not arrive.
    """
    wavelength = wavelength_of(system)
    sequence, rest = pack(system, wavelength), moving(system, rest_states(system))
    try:
        rim = aimed_rays(system, np.zeros(2), wavelength, _RIM[0], _RIM[1], openings=False)
    except UserError:  # the axis point sends no chief ray
        return None
    traced = trace_sequence(sequence, rim.rays, rest, NUMPY, ignore_apertures=True)
    if rim.lost.any() or (traced.status != OK).any():
        return None
    near = sequence.index * rim.rays.direction[:2]
    far = image_index(sequence) * np.stack([traced.u[0], traced.v[0]])
    return _half_widths(near), _half_widths(far)


def _half_widths(cosines: Array) -> Array:
    """Return half of what rays of the rim (2, 4) span, at most and at least."""
    spread = (cosines[:, ::2] - cosines[:, 1::2]) / 2.0
    return np.asarray(np.linalg.svd(spread, compute_uv=False), dtype=np.float64)


def require_flat_image(system: OpticalSystem, what: str) -> None:
    """Raise UserError unless the image is a plane, which `what` needs."""
    shape = system.surfaces[-1].shape
    if not (isinstance(shape, Conic) and np.isinf(shape.radius)):
        raise UserError(
            f"the image of {system.name}, {system.surfaces[-1].name}, is curved; {what} needs a plane one"
        )


def image_index(sequence: Sequence) -> float:
    """Return the refractive index before the image."""
    refracting = [element.index for element in sequence.elements if element.action == "refract"]
    return float(refracting[-1] if refracting else sequence.index)


def _require_cone(system: OpticalSystem, cosines: Array) -> None:
    if not np.linalg.svd(cosines, compute_uv=False)[-1] > _PARALLEL:
        raise UserError(
            f"the rays of {system.name} arrive parallel to each other, so it has no image; it needs "
            "surfaces with power and a wider pupil"
        )
