"""Exposures in which the line of sight runs on between the instants whose images are known.

About each instant the image stays what it is and moves along a known way: its Fourier transform is multiplied
by the mean of exp(-2 pi i f.s) over the places s of that way (Störkle 2018, Eq. 3.79 and 3.80 together). For
normally distributed places of variance sigma^2 that mean is exp(-2 pi^2 sigma^2 f^2), for a sinusoid of
amplitude a it is J0(2 pi a f).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.imaging.exposures.exposure_models import image_of, mean_factors, place_factors

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Longest canvas: its spectrum takes 288 MB.
_LONGEST = 6000


@dataclass(frozen=True)
class Smeared:
    """The sum of images that moved.

    Attributes
    ----------
    canvas : int
        Odd length N of a canvas that holds them wherever they are.
    total : ndarray
        Their spectrum (N, N // 2 + 1), complex; or, where they all have one place along y, the sum
        (rows, columns) of rows that have moved along x, real: a product per image instead of its transform.
    """

    canvas: int
    total: NDArray[Any]


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


def empty_total(pixels: int, ways: Real, sampling: float, frame: int = 0) -> Smeared:
    """Return the total of no image yet, for images (pixels, pixels) that move along ways (n, m, 2).

    Where they all have one place along y, no more of the exposure is made than a frame about the origin.

    Parameters
    ----------
    pixels : int
    ways : ndarray, shape (n, m, 2)
        Wavelengths / diameter.
    sampling : float
    frame : int
        Length of what is wanted; 0 for the canvas.

    Raises
    ------
    UserError
        As `smear_canvas`.
    """
    canvas = smear_canvas(pixels, ways, sampling)
    place = ways.flat[1]
    if (ways[..., 1] != place).any():
        return Smeared(canvas, np.zeros((canvas, canvas // 2 + 1), dtype=np.complex128))
    columns = frame or canvas
    return Smeared(canvas, np.zeros((pixels if place else min(pixels, columns), columns)))


def add_smeared(smeared: Smeared, images: NDArray[np.floating], ways: Real, sampling: float) -> None:
    """Add images that move to a total, one after the other: blocks leave the bits alone.

    Parameters
    ----------
    smeared : Smeared
        Of `empty_total`; its total is changed.
    images : ndarray, shape (block, n, n)
        About the origin, [n // 2, n // 2]; axis 1 is y.
    ways : ndarray, shape (block, m, 2)
        Where x and y of the origin are while an image is exposed, wavelengths / diameter.
    sampling : float
    """
    canvas, total = smeared.canvas, smeared.total
    if np.iscomplexobj(total):
        for image, way in zip(images, ways, strict=True):
            rows = scipy.fft.rfft(np.asarray(image, dtype=np.float64), canvas, axis=1)  # none of the border
            spectrum = scipy.fft.fft(rows, canvas, axis=0)
            spectrum *= _mean_factors(way, canvas, sampling)
            total += spectrum
        return
    first = images.shape[1] // 2 - len(total) // 2
    spread = _spread(ways[..., 0], canvas, sampling)
    for image, one in zip(images, spread, strict=True):
        rows = np.asarray(image[first : first + len(total)], dtype=np.float64)
        total += rows @ _moving(one, images.shape[2], total.shape[1])


def smeared_image(smeared: Smeared, ways: Real, pixels: int, sampling: float) -> Real:
    """Return the exposure (N, N) of images (pixels, pixels) along all ways (n, m, 2), or a frame of it."""
    mean = smeared.total / len(ways)
    if np.iscomplexobj(mean):
        return image_of(mean, pixels)
    rows, columns = mean.shape
    if place := ways.flat[1]:
        moved = _moving(_spread(np.full((1, 1), place), smeared.canvas, sampling)[0], rows, columns)
        return np.asarray(moved.T @ mean)
    above = columns // 2 - rows // 2
    return np.pad(mean, ((above, columns - rows - above), (0, 0)))


def _spread(places: Real, canvas: int, sampling: float) -> Real:
    """Return what becomes of a bright pixel at the origin (block, N) that moves to places (block, m)."""
    return np.asarray(scipy.fft.irfft(mean_factors(places, canvas, sampling), canvas, axis=1))


def _moving(spread: Real, pixels: int, columns: int) -> Real:
    """Return what a row of pixels becomes, (pixels, columns) about the origin, as one of them spreads."""
    origin = pixels - 1 - pixels // 2 + columns // 2
    around = spread[(np.arange(pixels + columns - 1) - origin) % len(spread)]
    return np.ascontiguousarray(np.lib.stride_tricks.sliding_window_view(around, columns)[::-1])


def _mean_factors(way: Real, canvas: int, sampling: float) -> Complex:
    """Return the mean over a way (m, 2) of what moves images to its places, (N, N // 2 + 1)."""
    along_y, along_x = place_factors(way, canvas, sampling)
    return np.asarray((along_y.T @ along_x) / len(way))
