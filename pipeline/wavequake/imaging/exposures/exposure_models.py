"""Exposures of moving images, in full and by the shortcuts in use (Störkle 2018, Eq. 3.78-3.80).

An image that moves by s has its Fourier transform multiplied by exp(-2πi f·s). The exposure's transform is
therefore the mean over the instants of each instant's own transform times its factor (Eq. 3.79). If the image
does not change, what is left of the motion is the mean of the factors, the characteristic function of the
line of sight (Eq. 3.80); for normally distributed motion that is a Gaussian. All three keep the energy,
because every factor is 1 at f = 0, and place images between pixels without interpolation.

Images get a dark border as wide as the motion, so that nothing comes back in on the other side. The length of
the canvas is odd, so that each frequency has its opposite and the exposure is real.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import ArrayLike, NDArray

from wavequake.errors import UserError
from wavequake.imaging.exposures.exposure import encircled_energy_radius

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Standard deviations of a Gaussian that the border holds: 1e-15 of its light is farther out.
_WINGS = 8.0
# Instants at once: bounds the memory.
_BLOCK = 64
# Images at once whose spectra a processor's cache holds.
_CACHED = 4
# Longest canvas: its spectrum takes 288 MB; beyond the second, images come one by one.
_LONGEST, _LONG = 6000, 1500


@dataclass(frozen=True)
class ExposureError:
    """What a shortcut makes of an exposure, against the exposure in full.

    Attributes
    ----------
    l2 : float
        L2 norm of the difference of the images, each of unit energy.
    peak : float
        Difference of the largest irradiance, relative to that of the full exposure.
    ee50, ee80 : float
        Differences of the radii of 50 and 80 % encircled energy, wavelengths / diameter; NaN if one of the
        circles does not fit into the frame.
    """

    l2: float
    peak: float
    ee50: float
    ee80: float


def full_exposure(images: Iterable[NDArray[np.floating]], los: ArrayLike, sampling: float) -> Real:
    """Return the mean of local images, each placed at its own line of sight (Störkle 2018, Eq. 3.79).

    Parameters
    ----------
    images : iterable of ndarray, shape (block, n, n)
        Local images of the instants, in order, in blocks of any length, so that thousands need no memory;
        axis 1 is y, [n // 2, n // 2] is the line of sight.
    los : array_like, shape (instants, 2)
        Where x and y of the line of sight are, wavelengths / diameter.
    sampling : float
        Distance of the pixels, wavelengths / diameter.

    Returns
    -------
    ndarray, shape (N, N)
        The exposure on a canvas that holds all images whole, [N // 2, N // 2] is the origin (`cut` takes a
        frame out of it). Its energy is the mean of the images' energies.

    Raises
    ------
    UserError
        If a number is not finite, there are not as many square images as lines of sight, or the motion is
        beyond a canvas of 6000 pixels.
    """
    los = _checked(los, sampling)
    total: Complex | None = None
    done = size = canvas = 0
    for block in images:
        local = np.asarray(block, dtype=np.float64)
        size = size or local.shape[-1]
        if local.ndim != 3 or local.shape[1:] != (size, size):
            raise UserError(f"images of an exposure come as (instants, {size}, {size}), not {local.shape}")
        canvas = canvas or _canvas_length(size, los, sampling)
        if done + len(local) > len(los):
            raise UserError(f"there are more images than the {len(los)} lines of sight")
        if total is None:
            total = np.zeros((canvas, canvas // 2 + 1), dtype=np.complex128)
        together = _CACHED if canvas <= _LONG else 1
        for first in range(0, len(local), together):
            part = local[first : first + together]
            if not np.isfinite(part).all():
                bad = done + first + int(np.argmin(np.isfinite(part).all(axis=(1, 2))))
                raise UserError(f"the image of instant {bad} is not finite, so there is no exposure")
            along_y, along_x = place_factors(los[done + first : done + first + len(part)], canvas, sampling)
            rows = scipy.fft.rfft(part, canvas, axis=2)  # of the image alone: the border has none
            rows *= along_x[:, None, :]
            spectra = scipy.fft.fft(rows, canvas, axis=1)
            spectra *= along_y[:, :, None]
            for spectrum in spectra:  # one after the other: the bits do not depend on the blocks
                total += spectrum
        done += len(local)
    if total is None or done < len(los):
        raise UserError(f"there are {done} images for {len(los)} lines of sight")
    return image_of(total / done, size)


def los_exposure(static: NDArray[np.floating], los: ArrayLike, sampling: float) -> Real:
    """Return one image convolved with the trajectory of the line of sight (Störkle 2018, Eq. 3.80).

    Parameters
    ----------
    static : ndarray, shape (n, n)
        The image that is taken to stay the same.
    los, sampling
        As for `full_exposure`, whose canvas the result has.

    Raises
    ------
    UserError
        If a number is not finite, or the image is not square.
    """
    los = _checked(los, sampling)
    image, canvas = _static(static, los, sampling)
    trajectory = np.zeros((canvas, canvas // 2 + 1), dtype=np.complex128)
    for first in range(0, len(los), _BLOCK):
        along_y, along_x = place_factors(los[first : first + _BLOCK], canvas, sampling)
        trajectory += along_y.T @ along_x
    return image_of(scipy.fft.rfft2(image, s=(canvas, canvas)) * (trajectory / len(los)), len(image))


def gaussian_exposure(static: NDArray[np.floating], los: ArrayLike, sampling: float) -> Real:
    """Return one image blurred by a Gaussian of the trajectory's mean and covariance, the jitter kernel.

    Arguments, result and errors are those of `los_exposure`.
    """
    los = _checked(los, sampling)
    image, canvas = _static(static, los, sampling)
    middle = los.mean(axis=0)
    (xx, xy), (_, yy) = (los - middle).T @ (los - middle) / len(los)
    y, x = scipy.fft.fftfreq(canvas, sampling)[:, None], scipy.fft.rfftfreq(canvas, sampling)[None, :]
    blur = np.exp(-2.0 * np.pi**2 * (xx * x**2 + 2.0 * xy * x * y + yy * y**2))
    moved = np.exp(-2j * np.pi * (middle[0] * x + middle[1] * y))
    return image_of(scipy.fft.rfft2(image, s=(canvas, canvas)) * blur * moved, len(image))


def cut(canvas: Real, pixels: int) -> Real:
    """Return the frame (pixels, pixels) about the origin of a canvas; UserError if it is larger than that."""
    first = len(canvas) // 2 - pixels // 2
    if first < 0 or first + pixels > len(canvas):
        raise UserError(f"a frame of {pixels} pixels does not fit into a canvas of {len(canvas)}")
    return canvas[first : first + pixels, first : first + pixels]


def exposure_error(
    shortcut: Real, full: Real, sampling: float, area: float, diameter: float
) -> ExposureError:
    """Compare a shortcut's image (n, n) with the full exposure; the scale is that of `encircled_energy`.

    Raises
    ------
    UserError
        If an image holds no light, or their shapes differ.
    """
    if shortcut.shape != full.shape:
        raise UserError(f"the images have different shapes, {shortcut.shape} and {full.shape}")
    energies = shortcut.sum(), full.sum()
    if not all(energy > 0.0 for energy in energies):
        raise UserError("an exposure without light cannot be compared")
    difference = shortcut / energies[0] - full / energies[1]
    radii = [
        [float(encircled_energy_radius(image, share, sampling, area, diameter)) for image in (shortcut, full)]
        for share in (0.5, 0.8)
    ]
    ee50, ee80 = (one - two if np.isfinite([one, two]).all() else float("nan") for one, two in radii)
    return ExposureError(
        l2=float(np.sqrt(np.sum(difference**2))),
        peak=float(shortcut.max() / full.max() - 1.0),
        ee50=ee50,
        ee80=ee80,
    )


def _checked(los: ArrayLike, sampling: float) -> Real:
    trajectory = np.asarray(los, dtype=np.float64)
    if trajectory.ndim != 2 or trajectory.shape[1] != 2 or not len(trajectory):
        raise UserError(f"a line of sight has the shape (instants, 2), not {trajectory.shape}")
    if not np.isfinite(trajectory).all():
        bad = int(np.argmin(np.isfinite(trajectory).all(axis=1)))
        raise UserError(f"the line of sight at instant {bad} is not finite, so there is no exposure")
    if not (np.isfinite(sampling) and sampling > 0.0):
        raise UserError(f"the sampling of an image must be above 0 wavelengths/diameter, not {sampling}")
    return trajectory


def _static(static: NDArray[np.floating], los: Real, sampling: float) -> tuple[Real, int]:
    image = np.asarray(static, dtype=np.float64)
    if image.ndim != 2 or image.shape[0] != image.shape[1]:
        raise UserError(f"the image of an exposure is square, not {image.shape}")
    if not np.isfinite(image).all():
        raise UserError("the static image is not finite, so there is no exposure")
    return image, _canvas_length(len(image), los, sampling)


def _canvas_length(pixels: int, los: Real, sampling: float) -> int:
    """Return an odd length with a fast transform, wide enough for the images and for the Gaussian's wings."""
    farthest = float(np.abs(los).max())
    with np.errstate(over="ignore"):
        wings = np.abs(los.mean(axis=0)) + _WINGS * los.std(axis=0)
    reach = max(farthest, wings.max()) / sampling
    if not pixels + 2.0 * reach < _LONGEST:
        raise UserError(
            f"the line of sight moves by up to {farthest:.3g} wavelengths/diameter, which is too far for an "
            f"exposure: images of {pixels} pixels and {_WINGS:g} of its standard deviations to each side "
            f"have to fit into {_LONGEST} pixels of {sampling:g}"
        )
    length = (pixels + 2 * int(np.ceil(reach))) | 1
    while scipy.fft.next_fast_len(length) != length:
        length += 2
    return length


def place_factors(los: Real, canvas: int, sampling: float) -> tuple[Complex, Complex]:
    """Return factors that move images to `los` (block, 2): (block, N) in y and (block, N // 2 + 1) in x."""
    split = (_split_waves(places, canvas, sampling) for places in los.T)
    waves = ((coarse[:, :, None] * fine[:, None]).reshape(len(los), -1) for coarse, fine in split)
    along_x, along_y = (one[:, : canvas // 2 + 1] for one in waves)
    return np.concatenate([along_y, along_y[:, :0:-1].conj()], axis=1), along_x


def mean_factors(places: Real, canvas: int, sampling: float) -> Complex:
    """Return the means (block, N // 2 + 1) of what moves images to `places` (block, m) along one axis."""
    coarse, fine = _split_waves(places, canvas, sampling)
    mean = coarse.swapaxes(1, 2) @ fine / places.shape[1]
    return np.asarray(mean.reshape(len(places), -1)[:, : canvas // 2 + 1])


def _split_waves(places: Real, canvas: int, sampling: float) -> tuple[Complex, Complex]:
    """Return two factors (..., n) of all waves exp(-2 pi i f places): few exponentials."""
    step = int(np.ceil(np.sqrt(canvas // 2 + 1)))
    angles = 2.0 * np.pi / (canvas * sampling) * places[..., None] * np.arange(step)
    return _waves(step * angles), _waves(angles)


def _waves(angles: Real) -> Complex:
    """Return exp(-i angles); NumPy's own takes four times as long."""
    waves = np.empty(angles.shape, np.complex128)
    np.cos(angles, out=waves.real)
    np.sin(-angles, out=waves.imag)
    return waves


def image_of(spectrum: Complex, pixels: int) -> Real:
    """Transform back, and move the origin from [pixels // 2] to the middle of the canvas."""
    canvas = len(spectrum)
    image = scipy.fft.irfft2(spectrum, s=(canvas, canvas))
    offset = canvas // 2 - pixels // 2
    return np.asarray(np.roll(image, (offset, offset), axis=(0, 1)), dtype=np.float64)
