"""What the pixels of a detector count: light integrated over each pixel, in photons."""

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError

Real = NDArray[np.float64]

_MOST_ACROSS = 4096


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


def detector_pixels(images: NDArray[np.floating], sampling: float, width: float) -> Real:
    """Return the mean irradiance over the pixels of a detector, as many as the frame holds.

    They are next to each other and square; the middle of pixel [p // 2, p // 2] is the origin of the frame,
    [n // 2, n // 2]. As in `pixel_means`, of which this is a resampling, the image is interpolated as if the
    frame were periodic.

    Parameters
    ----------
    images : ndarray, shape (..., n, n)
    sampling : float
        Distance of the points, at most 0.5 wavelengths / diameter.
    width : float
        Of a pixel, wavelengths / diameter.

    Returns
    -------
    ndarray, shape (..., p, p)
        p pixels lie wholly inside of the frame, so that none sees light of the opposite rim.

    Raises
    ------
    UserError
        If the sampling is impossible, or no pixel or more than 4096 fit into the frame.
    """
    points = images.shape[-1]
    if not 0.0 < sampling <= 0.5:
        raise UserError(f"an image must be sampled at most 0.5 wavelengths/diameter apart, not {sampling}")
    across = pixels_across(points, sampling, width)
    centers = (np.arange(across) - across // 2) * (width / sampling)
    places = np.arange(points) - points // 2
    k = np.fft.fftfreq(points)
    waves = np.cos(2.0 * np.pi * np.multiply.outer(centers[:, None] - places, k))
    means = (waves * np.sinc(width / sampling * k)).sum(axis=-1) / points
    return np.asarray(means @ np.asarray(images, dtype=np.float64) @ means.T)


def pixels_across(points: int, sampling: float, width: float) -> int:
    """Return how many pixels of a width lie wholly inside of a frame, [p // 2] about its origin.

    UserError if none does, or more than 4096.
    """
    frame = points * sampling
    across = 1_000_000
    if width > frame / 1e6:
        # From the origin, which is not the middle of the frame if its points are even.
        rims = np.array([points // 2 + 0.5, points - points // 2 - 0.5]) * sampling
        left, right = np.floor(rims / width * (1.0 + 1e-12) - 0.5 + 1e-9).astype(int)
        across = int(min(left, right + 1) + min(left, right) + 1)
    if not 1 <= across <= _MOST_ACROSS:
        raise UserError(
            f"a pixel of {width:.3g} wavelengths/diameter does not suit a frame of {frame:.4g}, which should "
            f"hold 1 to {_MOST_ACROSS} of them along each axis"
        )
    return across


def read_out(expected: Real, read_noise: float, random: np.random.Generator) -> Real:
    """Return what a detector reads: photoelectrons by Poisson's law, and a normal error of reading.

    Parameters
    ----------
    expected : ndarray
        Mean number of electrons of each pixel; what an interpolation leaves below 0 counts as 0.
    read_noise : float
        Standard deviation of a reading, electrons.
    random : numpy.random.Generator
    """
    caught = random.poisson(np.maximum(expected, 0.0)).astype(np.float64)
    return caught + read_noise * random.standard_normal(expected.shape)
