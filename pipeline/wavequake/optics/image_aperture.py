"""The cone of light in the image: how directions there follow from places in the pupil."""

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.devices import NUMPY
from wavequake.kernels.sequence import OK, Sequence
from wavequake.kernels.sequential import trace_sequence
from wavequake.optics.packing import moving
from wavequake.optics.ray_aiming import aimed_rays, losses
from wavequake.optics.system import OpticalSystem
from wavequake.optics.system_kinematics import rest_states

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
        Of u and v (rows) by x and y in the pupil.

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
            u, v = traced.u[0] / share, traced.v[0] / share
            cosines = np.array([[u[0] - u[1], u[2] - u[3]], [v[0] - v[1], v[2] - v[3]]]) / 2.0
            _require_cone(system, cosines)
            return cosines
    status = np.where(rim.lost, rim.status, traced.status[0])
    surface = np.where(rim.lost, rim.surface, traced.surface[0])
    raise UserError(
        f"{np.count_nonzero(status)} of 4 rays close to the chief ray of {system.name} are lost, "
        f"{losses(system, status, surface)}; make the field smaller"
    )


def _require_cone(system: OpticalSystem, cosines: Array) -> None:
    if not np.linalg.svd(cosines, compute_uv=False)[-1] > _PARALLEL:
        raise UserError(
            f"the rays of {system.name} arrive parallel to each other, so it has no image; it needs "
            "surfaces with power and a wider pupil"
        )
