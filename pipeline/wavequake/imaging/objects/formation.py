"""Images of extended objects: coherent, incoherent and in between (Störkle 2018, Eq. 3.66-3.77).

Lengths are those of the image in wavelengths / diameter, which is wavelength / (2 NA): the pupil then passes
frequencies up to 1/2 cycle per unit, an irradiance has none above 1. An object is a picture on the image's
grid, its geometric image (`geometric_image`); it repeats beyond its borders, as a grating does, and needs a
dark border where it shall not.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # its Fourier transforms load much, and only when they are called
from numpy.typing import ArrayLike, NDArray

from wavequake.errors import UserError
from wavequake.imaging.exposures.mtf import optical_transfer_function
from wavequake.imaging.pupils.pupil_shape import PupilShape, coherent_transfer

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Of the largest: what Fourier transforms leave where there is no light.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Source:
    """A light source as incoherent points, each of which lights the object by a plane wave.

    Attributes
    ----------
    points : ndarray, shape (k, 2)
        Where they are imaged to in the pupil, in pupil radii: 0 is the axis, 1 the rim.
    weights : ndarray, shape (k,)
        Their shares of the light; the sum is 1.
    """

    points: Real
    weights: Real


def disk_source(outer: float, inner: float = 0.0, across: int = 21) -> Source:
    """Return a round or annular source of partial coherence sigma = `outer`, by a square grid of points.

    Raises
    ------
    UserError
        If the radii are no radii, or so few points hold none of the source.
    """
    if not (np.isfinite([outer, inner]).all() and 0.0 <= inner < outer):
        raise UserError(f"a source reaches from {inner} to {outer} pupil radii; give 0 <= inner < outer")
    if across < 1:
        raise UserError(f"a source needs at least 1 point across, not {across}")
    axis = outer * ((2.0 * np.arange(across) + 1.0) / across - 1.0)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    radius = np.hypot(*points.T)
    points = points[(radius <= outer) & (radius >= inner)]
    if not len(points):
        raise UserError(
            f"{across} points across hold none of the ring from {inner:g} to {outer:g}; take more"
        )
    return Source(points, np.full(len(points), 1.0 / len(points)))


def geometric_image(field: ArrayLike, pitch: float, magnification: float) -> tuple[Complex, float]:
    """Return what geometrical optics images: U_o(x / M) / |M|, and its pitch (Störkle 2018, Excursion 3).

    Parameters
    ----------
    field : array_like, shape (rows, columns)
        Complex amplitude of the object.
    pitch : float
        Distance of its pixels, in any unit.
    magnification : float
        Negative for an inverted image; -1 for the 4-f system.

    Raises
    ------
    UserError
        If the magnification is 0 or not finite, or the field not a finite picture.
    """
    amplitude = _field(field)
    if not (np.isfinite(magnification) and magnification != 0.0):
        raise UserError(f"the magnification is {magnification}; it must be a number other than 0")
    if magnification < 0.0:
        # About the middle pixel, which is that of the axis; an even grid has one more on the other side.
        amplitude = amplitude[::-1, ::-1]
        even = [1 - length % 2 for length in amplitude.shape]
        amplitude = np.roll(amplitude, even, axis=(0, 1))
    return amplitude / abs(magnification), pitch * abs(magnification)


def coherent_image(field: ArrayLike, sampling: float, pupil: PupilShape) -> Real:
    """Return |P * U|² of a field (rows, columns) under one plane wave (Störkle 2018, Eq. 3.72 and 3.77).

    Parameters
    ----------
    field : array_like, shape (rows, columns)
        Complex amplitude of the geometric image; axis 0 is y.
    sampling : float
        Distance of the pixels, wavelengths / diameter; at most 0.5.
    pupil : PupilShape

    Raises
    ------
    UserError
        If the picture is not finite, or too coarse for the irradiance.
    """
    return _through(scipy.fft.fft2(_field(field)), sampling, pupil, 0.0, 0.0)


def partially_coherent_image(field: ArrayLike, sampling: float, pupil: PupilShape, source: Source) -> Real:
    """Return the image of a field lit by a source, summed over its points (Abbe).

    A point off the axis tilts the wave that lights the object, which shifts the object's spectrum across the
    pupil. Other arguments and errors are those of `coherent_image`.
    """
    spectrum = scipy.fft.fft2(_field(field))
    total = np.zeros(spectrum.shape)
    for (x, y), weight in zip(source.points, source.weights, strict=True):
        total += weight * _through(spectrum, sampling, pupil, 0.5 * x, 0.5 * y)
    return total


def incoherent_image(intensity: ArrayLike, sampling: float, pupil: PupilShape) -> Real:
    """Return |P|² * |U|² of an intensity (rows, columns), its energy kept (Störkle 2018, Eq. 3.77).

    Other arguments and errors are those of `coherent_image`; intensities are at least 0.
    """
    picture = checked_intensity(intensity)
    _check_sampling(sampling)
    transfer = optical_transfer_function(pupil, *_frequencies(picture.shape, sampling))
    return np.asarray(scipy.fft.ifft2(scipy.fft.fft2(picture) * transfer).real)


def star_field_image(psf: ArrayLike, positions: ArrayLike, fluxes: ArrayLike, sampling: float) -> Real:
    """Return the image of stars: a PSF at each of their places, also between pixels.

    Parameters
    ----------
    psf : array_like, shape (n, n)
        [n // 2, n // 2] is the star; it repeats beyond its borders.
    positions : array_like, shape (stars, 2)
        x and y, wavelengths / diameter.
    fluxes : array_like, shape (stars,)
        At least 0.
    sampling : float

    Raises
    ------
    UserError
        If shapes do not fit, a number is not finite or a flux negative.
    """
    image = checked_intensity(psf)
    places, light = np.asarray(positions, dtype=np.float64), np.asarray(fluxes, dtype=np.float64)
    if places.ndim != 2 or places.shape[1:] != (2,) or light.shape != places.shape[:1]:
        raise UserError(
            f"stars need positions (stars, 2) and fluxes (stars,), not {places.shape}, {light.shape}"
        )
    if not (np.isfinite(places).all() and np.isfinite(light).all() and (light >= 0.0).all()):
        raise UserError("positions of stars must be finite, and their fluxes finite and at least 0")
    _check_sampling(sampling)
    rates = [np.fft.fftfreq(size, sampling) for size in image.shape]
    y, x = (np.exp(-2j * np.pi * np.outer(places[:, i], rates[1 - i])) for i in (1, 0))
    return np.asarray(scipy.fft.ifft2(scipy.fft.fft2(image) * ((light[:, None] * y).T @ x)).real)


def checked_intensity(picture: ArrayLike) -> Real:
    """Return a picture as float64.

    Raises
    ------
    UserError
        If it has not two axes, is empty, or holds a number that is not finite, or negative by more than the
        rounding of what was placed between pixels.
    """
    numbers = _numbers(picture)
    if np.iscomplexobj(picture):
        raise UserError("the object's intensity is complex; give an amplitude to a coherent image instead")
    intensity = np.ascontiguousarray(numbers.real)
    least = -_ROUNDING * np.max(intensity, initial=0.0, where=np.isfinite(intensity))
    for bad, words in ((~np.isfinite(intensity), "not finite"), (intensity < least, "negative")):
        if bad.any():
            row, column = np.argwhere(bad)[0]
            value = intensity[row, column]
            raise UserError(f"the object's intensity at row {row}, column {column} is {words} ({value})")
    return intensity


def _field(picture: ArrayLike) -> Complex:
    field = _numbers(picture)
    if not np.isfinite(field).all():
        row, column = np.argwhere(~np.isfinite(field))[0]
        raise UserError(f"the object's amplitude at row {row}, column {column} is not finite")
    return field


def _numbers(picture: ArrayLike) -> Complex:
    try:
        values = np.asarray(picture, dtype=np.complex128)
    except (TypeError, ValueError) as error:
        raise UserError(f"an object is a picture of numbers in rows and columns: {error}") from None
    if values.ndim != 2 or not values.size:
        raise UserError(f"an object is a picture of rows and columns; this one has the shape {values.shape}")
    return values


def _check_sampling(sampling: float) -> None:
    if not 0.0 < sampling <= 0.5:
        raise UserError(
            f"an object must be sampled at most 0.5 wavelengths/diameter apart, not {sampling}, because its "
            "irradiance has frequencies up to 1 cycle per wavelength/diameter"
        )


def _frequencies(shape: tuple[int, ...], sampling: float) -> tuple[Real, Real]:
    """Frequencies (1, columns) along x and (rows, 1) along y of a picture's transform."""
    y, x = (np.asarray(np.fft.fftfreq(size, sampling), dtype=np.float64) for size in shape)
    return x[None, :], y[:, None]


def _through(spectrum: Complex, sampling: float, pupil: PupilShape, x: float, y: float) -> Real:
    """Return the irradiance of a spectrum whose zero frequency passes the pupil at twice x and y."""
    _check_sampling(sampling)
    along_x, along_y = _frequencies(spectrum.shape, sampling)
    image = scipy.fft.ifft2(spectrum * coherent_transfer(pupil, along_x - x, along_y - y))
    return np.asarray(image.real**2 + image.imag**2)
