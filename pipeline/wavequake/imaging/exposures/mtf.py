"""Optical and modulation transfer functions: what of an object's contrast arrives in its image.

Frequencies are in cycles per wavelength / diameter, which is 2 NA / wavelength: an incoherent image has none
above 1, the band limit, a coherent amplitude none above 1/2.
"""

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import ArrayLike, NDArray

from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import samples_needed
from wavequake.imaging.pupils.pupil_function import annular_pupil, pupil_function
from wavequake.imaging.pupils.pupil_shape import PupilShape
from wavequake.prepared import prepared

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Cells across the pupil: transfer functions are then good to 2e-4.
_SAMPLES = 512


def optical_transfer_function(pupil: PupilShape, x: ArrayLike, y: ArrayLike) -> Complex:
    """Return the normalized autocorrelation of the pupil function.

    Parameters
    ----------
    pupil : PupilShape
    x, y : array_like
        Frequencies along both axes, cycles per wavelength / diameter; of any shapes, all pairs are returned.

    Returns
    -------
    ndarray, shape (y.size, x.size)
        1 at 0, within 2e-4; 0 beyond the band limit.

    Raises
    ------
    UserError
        If the wavefront is not finite, or so steep that its phase is not sampled.
    """
    along_x, along_y = (np.asarray(values, dtype=np.float64).ravel() for values in (x, y))
    image, places = _response(pupil)
    transfer: Complex = (
        np.exp(-2j * np.pi * np.outer(along_y, places))
        @ image
        @ np.exp(-2j * np.pi * np.outer(places, along_x))
    )
    frequency = np.hypot(along_y[:, None], along_x)
    transfer[frequency >= 1.0] = 0.0
    transfer[frequency == 0.0] = 1.0
    return transfer


def modulation_transfer(psf: NDArray[np.floating], sampling: float) -> tuple[Real, Real]:
    """Return the MTF of a point spread function on a grid.

    Parameters
    ----------
    psf : ndarray, shape (n, n)
        Irradiance; light beyond its frame is missing, which raises the MTF by its share above the lowest
        frequencies.
    sampling : float
        Distance of the pixels, wavelengths / diameter.

    Returns
    -------
    frequency : ndarray, shape (n,)
        Cycles per wavelength / diameter, ascending; zero at n // 2.
    mtf : ndarray, shape (n, n)
        1 at zero; axis 0 is y.

    Raises
    ------
    UserError
        If the image is not finite, not square or without light, or the sampling is no positive number.
    """
    image = np.asarray(psf, dtype=np.float64)
    if image.ndim != 2 or image.shape[0] != image.shape[1]:
        raise UserError(f"a point spread function is square, not {image.shape}")
    if not np.isfinite(image).all() or not image.sum() > 0.0:
        raise UserError("a point spread function without light, or not finite, has no MTF")
    if not (np.isfinite(sampling) and sampling > 0.0):
        raise UserError(f"the sampling of an image must be above 0 wavelengths/diameter, not {sampling}")
    spectrum = np.abs(scipy.fft.fft2(image))
    return np.fft.fftshift(np.fft.fftfreq(len(image), sampling)), np.asarray(
        np.fft.fftshift(spectrum / spectrum[0, 0])
    )


def ideal_mtf(frequency: ArrayLike) -> Real:
    """Return the MTF of a perfect circular pupil: 2/pi (acos f - f sqrt(1 - f²)), 0 from f = 1 on."""
    f = np.minimum(np.abs(np.asarray(frequency, dtype=np.float64)), 1.0)
    return np.asarray(2.0 / np.pi * (np.arccos(f) - f * np.sqrt(1.0 - f**2)))


@prepared(maxsize=4)
def _response(pupil: PupilShape) -> tuple[Real, Real]:
    """Return a whole period of the sampled pupil's image, its sum 1, and the places of its pixels.

    A period at two pixels per wavelength / diameter has all of the sampled irradiance.
    """
    grid = annular_pupil(_SAMPLES, pupil.obscuration)
    waves = pupil.waves(grid.x, grid.y)
    if pupil.wavefront is not None:
        _check_steepness(grid.cells, waves)
    field = pupil_function(grid, 2.0 * np.pi * waves[None])[0]
    # The transform by exp(-2 pi i f x): +x is where rising OPDs move the image.
    image = np.abs(np.fft.fft2(field, s=(2 * _SAMPLES, 2 * _SAMPLES))) ** 2
    # The square of a rim cell's mean amplitude is not the mean square: only zero frequency would notice.
    energy = image.sum() * grid.amplitude.sum() / np.sum(grid.amplitude**2)
    return np.fft.fftshift(image / energy), np.fft.fftshift(np.fft.fftfreq(2 * _SAMPLES, 1.0 / _SAMPLES))


def _check_steepness(cells: NDArray[np.intp], waves: Real) -> None:
    flat = np.full(_SAMPLES * _SAMPLES, np.nan)
    flat[cells] = waves
    picture = flat.reshape(_SAMPLES, _SAMPLES)
    steepest = max(float(np.nanmax(np.abs(np.diff(picture, axis=axis)))) for axis in (0, 1))
    if steepest > 0.5:
        needed = samples_needed(steepest * np.pi * _SAMPLES, 0.0)
        raise UserError(
            f"the wavefront changes by {steepest:.2g} waves from cell to cell, which needs a pupil of "
            f"{needed} samples instead of {_SAMPLES}; it is too steep for an image"
        )
