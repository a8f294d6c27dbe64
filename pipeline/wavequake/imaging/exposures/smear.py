"""Exposures in which the line of sight runs on between the instants whose images are known.

About each instant the image stays what it is and moves along a known way: its Fourier transform is multiplied
by the mean of exp(-2 pi i f.s) over the places s of that way (Störkle 2018, Eq. 3.79 and 3.80 together). For
normally distributed places of variance sigma^2 that mean is exp(-2 pi^2 sigma^2 f^2), for a sinusoid of
amplitude a it is J0(2 pi a f).
"""

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.imaging.exposures.exposure_models import image_of, mean_factor, place_factors

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Longest canvas: its spectrum takes 288 MB.
_LONGEST = 6000


def smear_canvas(pixels: int, ways: Real, sampling: float) -> int:
    """Return the odd length of a canvas that holds images of so many pixels wherever they move.

    Parameters
    ----------
    pixels : int
    ways : ndarray, shape (..., 2)
        Places of the line of sight, wavelengths / diameter.
    sampling : float

    Raises
    ------
    UserError
        If that is beyond 6000 pixels, or a place is not finite.
    """
    reach = float(np.abs(ways).max(initial=0.0)) / sampling
    if not pixels + 2.0 * reach < _LONGEST:
        raise UserError(
            f"the line of sight moves by up to {reach * sampling:.3g} wavelengths/diameter, which is too far "
            f"for an exposure: it has to fit into {_LONGEST} pixels of {sampling:g}"
        )
    length = (pixels + 2 * int(np.ceil(reach))) | 1
    while scipy.fft.next_fast_len(length) != length:
        length += 2
    return length


def empty_total(pixels: int, ways: Real, sampling: float) -> Complex:
    """Return the total of no image yet, for images (pixels, pixels) that move along ways (n, m, 2).

    It is the images' spectrum (N, N // 2 + 1); or, where they all have one place along y, that of their rows,
    (pixels, N // 2 + 1), which spares a transform per image.

    Raises
    ------
    UserError
        As `smear_canvas`.
    """
    canvas = smear_canvas(pixels, ways, sampling)
    rows = pixels if (ways[..., 1] == ways.flat[1]).all() else canvas
    return np.zeros((rows, canvas // 2 + 1), dtype=np.complex128)


def add_smeared(total: Complex, images: NDArray[np.floating], ways: Real, sampling: float) -> None:
    """Add the spectra of images that move to a total, one after the other: blocks leave the bits alone.

    Parameters
    ----------
    total : ndarray
        Of `empty_total`; is changed.
    images : ndarray, shape (block, n, n)
        About the origin, [n // 2, n // 2]; axis 1 is y.
    ways : ndarray, shape (block, m, 2)
        Where x and y of the origin are while an image is exposed, wavelengths / diameter.
    sampling : float
    """
    canvas = 2 * total.shape[1] - 1
    for image, way in zip(images, ways, strict=True):
        rows = scipy.fft.rfft(np.asarray(image, dtype=np.float64), canvas, axis=1)  # the border has none
        if len(total) < canvas:
            rows *= mean_factor(way[:, 0], canvas, sampling)
            total += rows
            continue
        spectrum = scipy.fft.fft(rows, canvas, axis=0)
        spectrum *= _mean_factors(way, canvas, sampling)
        total += spectrum


def smeared_image(total: Complex, ways: Real, pixels: int, sampling: float) -> Real:
    """Return the exposure (N, N) of images (pixels, pixels) along all ways (n, m, 2) from their total."""
    canvas, mean = 2 * total.shape[1] - 1, total / len(ways)
    if len(total) < canvas:
        along_y, _ = place_factors(ways[0, :1], canvas, sampling)
        mean = scipy.fft.fft(mean, canvas, axis=0) * along_y.T
    return image_of(mean, pixels)


def _mean_factors(way: Real, canvas: int, sampling: float) -> Complex:
    """Return the mean over a way (m, 2) of what moves images to its places, (N, N // 2 + 1)."""
    along_y, along_x = place_factors(way, canvas, sampling)
    return np.asarray((along_y.T @ along_x) / len(way))
