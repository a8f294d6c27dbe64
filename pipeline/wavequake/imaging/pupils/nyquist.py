"""Whether a sampled pupil is fine enough for its phase: two cells for each period of it, and of the image."""

import warnings

import numpy as np
from numpy.typing import NDArray

from wavequake.imaging.engines.matrix_fourier import samples_needed
from wavequake.imaging.pupils.pupil_function import PupilGrid
from wavequake.optics.polynomials.zernike import annular_zernike_gradient
from wavequake.prepared import prepared

Real = NDArray[np.float64]

# Radii and azimuths at which Zernike wavefronts are sought for their steepest place.
_RADII, _AZIMUTHS = 16, 96
# Nearest rays to which the phase of a ray is compared.
_NEIGHBORS = 4


def samples_for(grid: PupilGrid, phase: Real, field: float) -> int:
    """Return how many samples across the pupil its steepest phase and the image's field need.

    Parameters
    ----------
    grid : PupilGrid
    phase : ndarray, shape (batch, m)
        rad at the grid's patches; what is not a number does not count.
    field : float
        Width of the image in wavelengths / diameter.
    """
    steepest = 0.0
    for before, after in _neighbors(grid):
        step = np.abs(phase[:, after] - phase[:, before])
        steepest = max(steepest, float(np.nanmax(step, initial=0.0, where=np.isfinite(step))))
    return samples_needed(steepest * len(grid.axis) / 2.0, field)


def zernike_samples_for(coefficients: Real, obscuration: float, field: float) -> int:
    """Return the same of Noll coefficients (batch, J) in waves on an annulus."""
    finite = coefficients[np.isfinite(coefficients).all(axis=1)]
    if not finite.size:
        return samples_needed(0.0, field)
    gradient = _zernike_gradient(coefficients.shape[1], obscuration)
    # By blocks: an instant has as many slopes as there are places.
    steepest = max(
        float(np.abs(finite[first : first + 64] @ gradient).max()) for first in range(0, len(finite), 64)
    )
    return samples_needed(2.0 * np.pi * steepest, field)


def ray_samples_for(rays: tuple[Real, Real, NDArray[np.integer]], phase: Real, field: float) -> int:
    """Return the same of a pupil of scattered rays, by the steps of the phase between neighbors.

    Parameters
    ----------
    rays : tuple of three ndarray, shape (R,)
        x and y in pupil radii, and the piece of the wavefront (segment) of each; steps between pieces do not
        count.
    phase : ndarray, shape (batch, R)
        rad; what is not a number does not count.
    field : float
        Width of the image in wavelengths / diameter.
    """
    from scipy.spatial import cKDTree  # slow to import, and few studies need it

    x, y, piece = rays
    count = min(_NEIGHBORS, len(x) - 1) + 1
    distance, neighbor = cKDTree(np.stack([x, y], axis=1)).query(np.stack([x, y], axis=1), k=count)
    distance, neighbor = distance.reshape(len(x), -1), neighbor.reshape(len(x), -1)
    one, other = np.nonzero((piece[neighbor] == piece[:, None]) & (distance > 0.0))
    if not one.size:
        return samples_needed(0.0, field)
    apart, beside = distance[one, other], neighbor[one, other]
    steepest = 0.0
    for instant in phase:
        slope = np.abs(instant[beside] - instant[one]) / apart
        steepest = max(steepest, float(np.max(slope, initial=0.0, where=np.isfinite(slope))))
    return samples_needed(steepest, field)


def too_coarse(samples: int, needed: int, field: float) -> str:
    """Return the sentence about a pupil whose samples do not suffice; empty if they do."""
    if needed <= samples:
        return ""
    return (
        f"the pupil has {samples} samples across, but its phase and an image of {field:g} lambda/D need "
        f"{needed}: light is folded back into the image"
    )


def too_few_rays(rays: int, fill: float, needed: int, field: float) -> str:
    """Return the sentence about a pupil whose rays do not suffice; empty if they do.

    ``fill`` is the pupil's area over its squared diameter.
    """
    across = np.sqrt(rays / fill)
    if needed <= across:
        return ""
    enough = int(np.ceil(fill * needed**2))
    return (
        f"{rays} rays stand {across:.0f} across the pupil, but its phase and images of {field:g} lambda/D "
        f"(twice the frame, for light that moves in) need {needed}: light is folded back into the image; "
        f"take {enough} rays (optics.rays or rays_per_segment), or fewer imaging.pixels"
    )


def warn_of_coarse(samples: int, needed: int, field: float, depth: int = 3) -> None:
    """Warn of a pupil whose samples do not suffice, `depth` calls up."""
    if text := too_coarse(samples, needed, field):
        warnings.warn(text, stacklevel=depth)


@prepared(maxsize=8)
def _zernike_gradient(terms: int, obscuration: float) -> Real:
    """Slopes (J, places) along x, then along y, per pupil radius; the rims are among the places."""
    radius = np.linspace(obscuration, 1.0, _RADII)[:, None]
    angle = 2.0 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    x, y = (radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel()
    _, along_x, along_y = annular_zernike_gradient(x, y, terms, obscuration)
    return np.ascontiguousarray(np.concatenate([along_x, along_y]).T)


def _neighbors(grid: PupilGrid) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Return pairs of patches of one piece in whole cells side by side, and one above the other."""
    samples = len(grid.axis)
    whole = np.flatnonzero(grid.light > 0.5)
    order = whole[np.lexsort((grid.cells[whole], grid.piece[whole]))]
    place = grid.piece[order] * samples * samples + grid.cells[order]
    pairs = []
    for step in (1, samples):
        found = np.minimum(np.searchsorted(place, place + step), place.size - 1)
        met = place[found] == place + step
        if step == 1:
            met &= grid.cells[order] % samples < samples - 1
        pairs.append((order[met], order[found[met]]))
    return pairs
