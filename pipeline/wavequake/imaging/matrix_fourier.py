"""Point spread functions by two matrix products: the Fourier transform at just the pixels that are wanted."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.imaging.pupil_function import PupilGrid, pupil_function

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Pupils that are transformed at once: bounds the memory, changes no bit of any image.
_BATCH = 32


@dataclass(frozen=True)
class MatrixFourier:
    """The transform from a pupil grid to an image.

    Attributes
    ----------
    pupil : PupilGrid
    kernel : ndarray, shape (pixels, n)
        exp(-2 pi i f x), equal in both directions.
    axis : ndarray, shape (pixels,)
        Positions of the pixels in wavelengths / diameter; pixel ``pixels // 2`` is the origin.
    peak : float
        Irradiance of the unaberrated pupil at the origin.
    """

    pupil: PupilGrid
    kernel: Complex
    axis: Real
    peak: float


def matrix_fourier(pupil: PupilGrid, pixels: int, sampling: float) -> MatrixFourier:
    """Prepare the transform of a pupil to `pixels` x `pixels` at `sampling` wavelengths / diameter.

    Raises
    ------
    UserError
        If the image reaches beyond the period of the sampled pupil's transform.
    """
    axis = np.asarray((np.arange(pixels) - pixels // 2) * sampling, dtype=np.float64)
    samples = len(pupil.axis)
    if pixels * sampling > samples:
        raise UserError(
            f"an image of {pixels} pixels at {sampling:g} lambda/D is {pixels * sampling:g} lambda/D wide, "
            f"but a pupil of {samples} samples repeats every {samples} lambda/D; sample the pupil more finely"
        )
    kernel = np.exp(-1j * np.pi * np.outer(axis, pupil.axis))  # x in radii: f x = axis x / 2
    return MatrixFourier(pupil, kernel, axis, float(pupil.amplitude.sum() ** 2))


def psf(transform: MatrixFourier, phase: Real) -> Real:
    """Return point spread functions, whose unit is the peak of the perfect one.

    Parameters
    ----------
    transform : MatrixFourier
    phase : ndarray, shape (batch, m)
        2 pi OPD / wavelength at the pupil's lit cells, rad; tilt places the image.

    Returns
    -------
    ndarray, shape (batch, pixels, pixels)
        Rows are y. NaN phases give NaN images.

    Raises
    ------
    UserError
        If the phase has the wrong shape.
    """
    if phase.ndim != 2 or phase.shape[1] != len(transform.pupil.cells):
        raise UserError(
            f"the phase has the shape {phase.shape}; it must be (batch, {len(transform.pupil.cells)})"
        )
    kernel = transform.kernel
    images = np.empty((len(phase), len(kernel), len(kernel)))
    for first in range(0, len(phase), _BATCH):
        field = pupil_function(transform.pupil, phase[first : first + _BATCH])
        image = kernel @ field @ kernel.T  # a product per pupil: the bits do not depend on the batch
        images[first : first + _BATCH] = (image.real**2 + image.imag**2) / transform.peak
    return images


def samples_needed(phase_slope: float, field: float) -> int:
    """Return how many samples a pupil needs across its diameter.

    Parameters
    ----------
    phase_slope : float
        Largest slope of the phase, rad per pupil radius.
    field : float
        Width of the image in wavelengths / diameter.

    Returns
    -------
    int
        At least two samples per period of the phase and of the transform's kernel at the image's edge
        together.
    """
    cycles = 2.0 * phase_slope / (2.0 * np.pi) + field / 2.0
    return int(np.ceil(2.0 * cycles))
