"""Point spread functions straight from Zernike coefficients: a pupil's phases never leave the device.

A wavefront of Zernike terms is a polynomial in x and y. A device is sent its few coefficients; it makes the
phases row by row, even and odd parts apart, transforms, squares, and adds up the exposure. Only cells whose
light is not centered (on rims, beside vanes) get their phases from outside.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

from wavequake.errors import UserError
from wavequake.imaging.engines.matrix_fourier import MatrixFourier, matrix_fourier, psf, psf_sum
from wavequake.imaging.pupils.nyquist import warn_of_coarse, zernike_samples_for
from wavequake.imaging.pupils.pupil_function import PupilGrid
from wavequake.kernels.device.devices import NUMPY, Device
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.transforms.folded import FoldedTransform, folded_images, folded_sum, folded_transform
from wavequake.kernels.transforms.folded_pupils import Rim, SmoothPhase
from wavequake.optics.polynomials.zernike import annular_zernike, noll_to_nm

Real = NDArray[np.float64]

# Light counts as centered in its cell within this distance, in radii of the pupil.
_CENTERED = 1e-12
# Instants whose phases NumPy makes at once: bounds the memory.
_BATCH = 8


@dataclass(frozen=True)
class ZernikeImager:
    """A prepared transform from Zernike coefficients to images.

    Attributes
    ----------
    transform : MatrixFourier
        From phases to images by NumPy.
    modes : ndarray, shape (m, J)
        Zernike polynomials at the patches of the pupil or, with a device, at those of its rim.
    folded : FoldedTransform, optional
        The transform on a device.
    polynomials : ndarray, shape (J, K, K)
        Chebyshev coefficients, y first, of the Zernike polynomials.
    obscuration : float
        Inner over outer radius of the polynomials.
    """

    transform: MatrixFourier
    modes: Real
    folded: FoldedTransform | None
    polynomials: Real
    obscuration: float


def zernike_imager(
    pupil: PupilGrid,
    pixels: int,
    sampling: float,
    terms: int,
    obscuration: float = 0.0,
    device: Device = NUMPY,
    dtype: DTypeLike = np.float64,
) -> ZernikeImager:
    """Prepare the images of wavefronts of the Noll terms j = 1..terms.

    Parameters
    ----------
    pupil : PupilGrid
    pixels, sampling
        As for `wavequake.imaging.engines.matrix_fourier.matrix_fourier`.
    terms : int
        Number J of Zernike terms.
    obscuration : float
        Inner over outer radius of the polynomials.
    device : Device
        Where to run.
    dtype : float64 or float32
        Precision on an OpenCL device; float64 agrees with NumPy to 1e-13 of the peak, float32 to 2e-6.

    Raises
    ------
    UserError
        If there are no terms, or the image is impossible.
    """
    transform = matrix_fourier(pupil, pixels, sampling)
    if device.kind == "numpy":
        modes = annular_zernike(pupil.x, pupil.y, terms, obscuration)
        return ZernikeImager(transform, modes, None, np.empty((terms, 0, 0)), obscuration)
    rows, columns = np.divmod(pupil.cells, len(pupil.axis))
    beside = np.hypot(pupil.x - pupil.axis[columns], pupil.y - pupil.axis[rows]) > _CENTERED
    beside |= np.bincount(pupil.cells, minlength=pupil.amplitude.size)[pupil.cells] > 1
    amplitude = np.zeros(pupil.amplitude.shape)
    amplitude.flat[pupil.cells[~beside]] = pupil.light[~beside]
    rim = Rim(pupil.cells[beside], pupil.light[beside])
    folded = folded_transform(amplitude, pixels, sampling, 1.0 / transform.peak, device, dtype, rim)
    modes = annular_zernike(pupil.x[beside], pupil.y[beside], terms, obscuration)
    return ZernikeImager(transform, modes, folded, _chebyshev(terms, obscuration), obscuration)


def zernike_images(imager: ZernikeImager, coefficients: Real, check: bool = True) -> Real:
    """Return point spread functions (batch, pixels, pixels), whose unit is the peak of the perfect one.

    Parameters
    ----------
    imager : ZernikeImager
    coefficients : ndarray, shape (batch, J)
        Noll terms j = 1..J of the OPD in waves. NaN gives an image of NaN.
    check : bool
        Whether to warn if the pupil is too coarse for the steepest wavefront.

    Raises
    ------
    UserError
        If the coefficients have the wrong shape.
    """
    coefficients = _checked(imager, coefficients)
    if check:
        _warn_of_coarse(imager, coefficients)
    if imager.folded is not None:
        return np.asarray(folded_images(imager.folded, _smooth(imager, coefficients)), dtype=np.float64)
    images = np.empty((len(coefficients), *2 * imager.transform.axis.shape))
    for first in range(0, len(coefficients), _BATCH):
        part = slice(first, first + _BATCH)
        images[part] = psf(imager.transform, _phase(imager, coefficients[part]))
    return images


def zernike_sum(imager: ZernikeImager, coefficients: Real, weights: Real, check: bool = True) -> Real:
    """Return the weighted sum (pixels, pixels) of point spread functions, as an exposure collects it.

    Tilts (terms 2 and 3) place the images. On a device only the sum leaves it.

    Parameters
    ----------
    imager : ZernikeImager
    coefficients : ndarray, shape (batch, J)
        As for `zernike_images`.
    weights : ndarray, shape (batch,)
        An instant of weight 0 does not count, whatever its coefficients.
    check : bool
        As for `zernike_images`.

    Raises
    ------
    UserError
        If the shapes do not fit, or a weight is not finite.
    """
    coefficients = _checked(imager, coefficients)
    weights = np.asarray(weights, dtype=np.float64)
    if weights.shape != (len(coefficients),) or not np.isfinite(weights).all():
        raise UserError(f"{len(coefficients)} instants need as many finite weights, not {weights.shape}")
    if check:
        _warn_of_coarse(imager, coefficients[weights != 0.0])
    total = np.zeros(2 * imager.transform.axis.shape)
    if imager.folded is not None:
        return folded_sum(imager.folded, _smooth(imager, coefficients), weights, total)
    for first in range(0, len(coefficients), _BATCH):
        part = slice(first, first + _BATCH)
        total += psf_sum(imager.transform, _phase(imager, coefficients[part]), weights[part])
    return total


def _checked(imager: ZernikeImager, coefficients: Real) -> Real:
    coefficients = np.asarray(coefficients, dtype=np.float64)
    terms = len(imager.polynomials)
    if coefficients.ndim != 2 or coefficients.shape[1] != terms:
        raise UserError(f"{terms} Zernike terms come as (batch, {terms}), not {coefficients.shape}")
    return coefficients


def _warn_of_coarse(imager: ZernikeImager, coefficients: Real) -> None:
    field = 2.0 * float(np.abs(imager.transform.axis).max())
    needed = zernike_samples_for(coefficients, imager.obscuration, field)
    warn_of_coarse(len(imager.transform.pupil.axis), needed, field, 4)


def _phase(imager: ZernikeImager, coefficients: Real) -> Real:
    """Return phases (batch, m) in rad."""
    return _in_tiles(coefficients, imager.modes.T)


def _smooth(imager: ZernikeImager, coefficients: Real) -> SmoothPhase:
    flat = imager.polynomials.reshape(len(imager.polynomials), -1)
    polynomials = _in_tiles(coefficients, flat)
    return SmoothPhase(polynomials.reshape(-1, *imager.polynomials.shape[1:]), _phase(imager, coefficients))


def _in_tiles(coefficients: Real, functions: Real) -> Real:
    """Return 2 pi times products (batch, m), of constant shape: bits do not depend on the batch."""
    tiles = np.zeros((-(-len(coefficients) // TILE), TILE, coefficients.shape[1]))
    tiles.reshape(-1, coefficients.shape[1])[: len(coefficients)] = 2.0 * np.pi * coefficients
    return (tiles @ functions).reshape(-1, functions.shape[1])[: len(coefficients)]


def _chebyshev(terms: int, obscuration: float) -> Real:
    """Return the coefficients (J, K, K) of Zernike polynomials in T_l(y) T_k(x), by interpolation."""
    degree = max(noll_to_nm(j)[0] for j in range(1, terms + 1))
    count = max(degree + 1, 2)  # tilts are always there: they center the image
    nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    y, x = np.meshgrid(nodes, nodes, indexing="ij")
    values = annular_zernike(x.ravel(), y.ravel(), terms, obscuration).T.reshape(terms, count, count)
    inverse = np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, count - 1))
    order = np.arange(count)
    return np.asarray(np.where(order + order[:, None] <= degree, inverse @ values @ inverse.T, 0.0))
