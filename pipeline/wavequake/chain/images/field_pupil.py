"""The pupil of a field as its beam shows it: in direction cosines of the image, with what is dark in it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wavequake.imaging.pupils.outlines import Outline, annulus
from wavequake.imaging.pupils.pupil_function import PupilGrid, apodized, sampled_pupil
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.optics.rays.pupils import pupil_amplitude
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.wavefront import PreparedSystem, incoming_light

Array = NDArray[np.float64]

UNIT_DIAMETER = 2.0
"""Of a pupil in direction cosines over the largest numerical aperture."""

_MM_PER_UM = 1e-3


def defocus(prepared: PreparedSystem, cosines: Array, planes_um: Sequence[float]) -> Array:
    """Return the phase in waves (K, m) that light gains on its way to planes behind the image.

    A plane wave gains the optical path n s w on a way s along the axis, if w is the cosine of its angle with
    it. Where the chief ray meets a plane is the middle of its image: what is linear in the directions is left
    out. ``cosines`` (m, 2) are those of the pupil's patches relative to the chief ray's, times n.
    """
    if not planes_um:
        return np.zeros((0, len(cosines)))
    still = incoming_light(prepared, rest_states(prepared.system))
    traced = trace_sequence(prepared.sequence, prepared.chief, still, NUMPY, ignore_apertures=True)
    chief = np.array([traced.u[0, 0], traced.v[0, 0]])
    along = np.sqrt(1.0 - chief @ chief)
    own = cosines / prepared.image_index
    w = np.sqrt(np.maximum(1.0 - np.sum((own + chief) ** 2, axis=1), 0.0))
    path = prepared.image_index * (w - along + own @ chief / along)
    # A longer path is a smaller OPD.
    return np.outer(planes_um, -path * _MM_PER_UM / prepared.wavelength)


def mapped_pupil(prepared: PreparedSystem, aperture: float, samples: int) -> PupilGrid:
    """Return the pupil in direction cosines over an aperture: the annulus as the field's beam shows it."""
    ring = annulus(1.0, prepared.system.pupil.obscuration)
    to_cosines = prepared.image_index * prepared.cosines / aperture
    corners = ring.corners @ to_cosines.T
    if np.linalg.det(to_cosines) < 0.0:
        corners = corners[:, ::-1]  # mirrored: counter-clockwise all the same
    return sampled_pupil(Outline(corners, ring.sign, ring.piece), samples, UNIT_DIAMETER)


def with_light(
    prepared: PreparedSystem, grid: PupilGrid, x: Array, y: Array, lit: NDArray[np.bool_] | None
) -> tuple[PupilGrid, float]:
    """Return a pupil with the light that it has at rest, and how many even cells would shine as it does.

    Parameters
    ----------
    prepared : PreparedSystem
    grid : PupilGrid
        Of `mapped_pupil`.
    x, y : ndarray, shape (m,)
        Where its patches lie in the system's pupil.
    lit : ndarray of bool, shape (N,), optional
        Which rays arrive at rest; None: all.

    Returns
    -------
    PupilGrid
        Dark where no ray arrives, and apodized as the system's pupil is.
    float
        So many cells, evenly lit, bring as much light under as high a peak: the square of the sum of the
        amplitudes over the sum of their squares.
    """
    if lit is not None and not lit.all():
        grid = apodized(grid, seen_light(prepared, lit, x, y))
    cells = float(grid.light.sum())
    amplitude = pupil_amplitude(prepared.system, x, y)
    if amplitude is None:
        return grid, cells
    square = float(grid.light @ amplitude**2)
    grid = apodized(grid, amplitude)
    return grid, float(grid.light.sum()) ** 2 / square


def seen_light(prepared: PreparedSystem, lit: NDArray[np.bool_], x: Array, y: Array) -> Array:
    """Return 1 at the places whose nearest ray arrives at rest, else 0."""
    from scipy.spatial import cKDTree  # slow to import, and few systems vignette

    _, nearest = cKDTree(prepared.pupil).query(np.stack([x, y], axis=1))
    return np.asarray(lit[nearest], dtype=np.float64)
