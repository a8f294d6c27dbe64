"""Images in light of several wavelengths on one grid of pixels."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import matrix_fourier, psf
from wavequake.imaging.pupils.nyquist import samples_for, warn_of_coarse
from wavequake.imaging.pupils.pupil_function import PupilGrid
from wavequake.kernels.device.devices import NUMPY, Device

Real = NDArray[np.float64]


def polychromatic_psf(
    grid: PupilGrid,
    phase: Real,
    wavelengths: ArrayLike,
    flux: ArrayLike,
    pixels: int,
    sampling: float,
    device: Device = NUMPY,
) -> Real:
    """Return the sum of the point spread functions of several wavelengths, at one optical path difference.

    Of light that is shorter by a factor the phases are larger and the image is smaller and brighter.

    Parameters
    ----------
    grid : PupilGrid
    phase : ndarray, shape (batch, m)
        2 pi OPD / (first wavelength) at the pupil's patches, rad.
    wavelengths : array_like, shape (K,)
        In any unit; the first is the one to which phase and sampling refer.
    flux : array_like, shape (K,)
        Light of each wavelength that passes the pupil, in units that the detector counts.
    pixels : int
        An image has pixels x pixels points.
    sampling : float
        Distance of the points in units of (first wavelength) / diameter.
    device : Device
        Where to run.

    Returns
    -------
    ndarray, shape (batch, pixels, pixels)
        Relative to the peak of the perfect pupil in the same light.

    Raises
    ------
    UserError
        If a wavelength or the light is impossible, or the grid is too coarse for the shortest wavelength.
    """
    wavelengths, flux = np.asarray(wavelengths, dtype=np.float64), np.asarray(flux, dtype=np.float64)
    if wavelengths.ndim != 1 or not wavelengths.size or flux.shape != wavelengths.shape:
        raise UserError(f"{wavelengths.size} wavelengths need as many fluxes, not {flux.size}")
    if not (np.isfinite(wavelengths).all() and (wavelengths > 0.0).all()):
        raise UserError("wavelengths must be above 0 and finite")
    if not (np.isfinite(flux).all() and (flux >= 0.0).all() and flux.sum() > 0.0):
        raise UserError("the flux of each wavelength must be at least 0, and one above 0")
    scale = wavelengths[0] / wavelengths
    brightness = flux * scale**2
    total = np.zeros((len(phase), pixels, pixels))
    shortest = float(scale[flux > 0.0].max())
    field = pixels * sampling * shortest
    if phase.ndim == 2 and phase.shape[1] == grid.cells.size:
        warn_of_coarse(len(grid.axis), samples_for(grid, phase * shortest, field), field)
    for factor, share in zip(scale, brightness / brightness.sum(), strict=True):
        transform = matrix_fourier(grid, pixels, sampling * float(factor), device)
        total += share * psf(transform, phase * factor)
    return total
