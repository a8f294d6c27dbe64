"""What the pixels of a detector count: light integrated over each pixel, in photons."""

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError

Real = NDArray[np.float64]


def pixel_means(images: NDArray[np.floating], sampling: float, width: float) -> Real:
    """Return the mean irradiance over square pixels about the points of images.

    The modulation transfer function of a pixel is a sinc along each direction, which is exact because an
    irradiance is band-limited (to 1 cycle per wavelength / diameter). The frame counts as periodic: what a
    pixel at a rim misses comes from the opposite rim, and the total of an image is kept.

    Parameters
    ----------
    images : ndarray, shape (..., n, n)
    sampling : float
        Distance of the points, at most 0.5 wavelengths / diameter.
    width : float
        Width of a pixel, wavelengths / diameter; the sampling for a detector without gaps.

    Raises
    ------
    UserError
        If the sampling or the width is impossible, or there is no image.
    """
    if not 0.0 < sampling <= 0.5:
        raise UserError(f"an image must be sampled at most 0.5 wavelengths/diameter apart, not {sampling}")
    if not (np.isfinite(width) and width >= 0.0):
        raise UserError(f"the width of a pixel must be at least 0 wavelengths/diameter, not {width}")
    if images.ndim < 2 or not images.size:
        raise UserError(f"images have rows and columns of pixels; these have the shape {images.shape}")
    rows, columns = images.shape[-2:]
    along_y = np.sinc(width / sampling * np.fft.fftfreq(rows))
    along_x = np.sinc(width / sampling * np.fft.rfftfreq(columns))
    spectrum = np.fft.rfft2(np.asarray(images, dtype=np.float64)) * along_y[:, None] * along_x
    return np.asarray(np.fft.irfft2(spectrum, s=(rows, columns)))


def expected_photons(
    images: NDArray[np.floating], sampling: float, area: float, diameter: float, photons: float
) -> Real:
    """Return how many photons each pixel of a detector without gaps receives on average.

    By Parseval's theorem the integral of an image whose unit is the perfect peak is diameter² / area in
    (wavelengths / diameter)², whatever the aberrations.

    Parameters
    ----------
    images : ndarray, shape (..., n, n)
        Mean irradiance over each pixel relative to the perfect peak.
    sampling : float
        Width of a pixel, wavelengths / diameter.
    area : float
        Transmitting area of the pupil (of the squared amplitude), for example mm².
    diameter : float
        Length that defines wavelength / diameter, for example mm.
    photons : float
        Photons that pass the pupil during the exposure.

    Raises
    ------
    UserError
        If a number is not above 0.
    """
    if not (np.isfinite([sampling, area, diameter, photons]).all() and min(sampling, area, diameter) > 0.0):
        raise UserError("sampling, area and diameter must be above 0 and finite")
    if photons < 0.0:
        raise UserError(f"the photons of an exposure must be at least 0, not {photons:g}")
    return np.asarray(images * (sampling**2 * area / diameter**2 * photons))
