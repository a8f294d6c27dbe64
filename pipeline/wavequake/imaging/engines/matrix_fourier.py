"""Point spread functions by two matrix products: the Fourier transform at just the pixels that are wanted."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

from wavequake.errors import UserError
from wavequake.imaging.pupils.pupil_function import PupilGrid, pupil_field, pupil_function, single_patches
from wavequake.kernels.device.devices import NUMPY, Device
from wavequake.kernels.transforms.folded import (
    FoldedTransform,
    folded_images,
    folded_sum,
    folded_transform,
    launches,
)
from wavequake.kernels.transforms.folded_pupils import LitPhase, Pupils

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Pupils that are transformed at once: bounds the memory, changes no bit of any image.
_BATCH = 8
# Samples that no pupil has.
_MOST = 1e9


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
    folded : FoldedTransform, optional
        The same transform on an OpenCL device.
    starts : ndarray of int32, shape (n, 2), optional
        Of the left and right half of each row, where the patches of each are one piece in each: what is
        added to a column gives the patch.
    gather : ndarray of int, shape (n * n,), optional
        Else, where no cell holds several patches, the patch of each cell; any for a dark cell, whose phase
        does not matter.
    """

    pupil: PupilGrid
    kernel: Complex
    axis: Real
    peak: float
    folded: FoldedTransform | None = None
    starts: NDArray[np.int32] | None = None
    gather: NDArray[np.intp] | None = None


def matrix_fourier(
    pupil: PupilGrid, pixels: int, sampling: float, device: Device = NUMPY, dtype: DTypeLike = np.float64
) -> MatrixFourier:
    """Prepare the transform of a pupil to `pixels` x `pixels` at `sampling` wavelengths / diameter.

    Parameters
    ----------
    pupil : PupilGrid
    pixels : int
    sampling : float
        Distance of the pixels in wavelengths / diameter.
    device : Device
        Where to run; OpenCL devices differ from NumPy by less than 1e-14 of the peak.
    dtype : float64 or float32
        Precision on an OpenCL device; float32 is good to 2e-6 of the peak.

    Raises
    ------
    UserError
        If the image is impossible or reaches beyond the period of the sampled pupil's transform.
    """
    if pixels < 1 or not (np.isfinite(sampling) and sampling > 0.0):
        raise UserError(f"an image needs pixels and a sampling above 0, not {pixels} pixels at {sampling:g}")
    axis = np.asarray((np.arange(pixels) - pixels // 2) * sampling, dtype=np.float64)
    samples = len(pupil.axis)
    if pixels * sampling > samples:
        raise UserError(
            f"an image of {pixels} pixels at {sampling:g} lambda/D is {pixels * sampling:g} lambda/D wide, "
            f"but a pupil of {samples} samples repeats every {samples} lambda/D; sample the pupil more finely"
        )
    kernel = np.exp(-1j * np.pi * np.outer(axis, pupil.axis))  # x in radii: f x = axis x / 2
    peak = float(pupil.amplitude.sum() ** 2)
    if device.kind == "numpy":
        return MatrixFourier(pupil, kernel, axis, peak)
    folded = folded_transform(pupil.amplitude, pixels, sampling, 1.0 / peak, device, dtype)
    starts, gather = None, None
    if single_patches(pupil):
        starts = _starts(pupil)
        if starts is None:
            gather = np.zeros(samples * samples, dtype=np.intp)
            gather[pupil.cells] = np.arange(pupil.cells.size)
    return MatrixFourier(pupil, kernel, axis, peak, folded, starts, gather)


def _starts(pupil: PupilGrid) -> NDArray[np.int32] | None:
    """Return where half rows start in patches that are sorted by cells, or None if one is in pieces."""
    samples = len(pupil.axis)
    row, column = np.divmod(pupil.cells, samples)
    place = np.arange(row.size) - column
    # Of a dark half: anywhere near the patches of its row.
    starts = np.repeat(np.searchsorted(row, np.arange(samples))[:, None] - samples // 2, 2, axis=1)
    for side, lit in enumerate((column < (samples + 1) // 2, column >= samples // 2)):
        starts[row[lit], side] = place[lit]
        if not np.array_equal(starts[row[lit], side], place[lit]):
            return None
    return starts.astype(np.int32)


def psf(transform: MatrixFourier, phase: Real) -> Real:
    """Return point spread functions, whose unit is the peak of the perfect one.

    Parameters
    ----------
    transform : MatrixFourier
    phase : ndarray, shape (batch, m)
        2 pi OPD / wavelength at the pupil's patches, rad; tilt places the image.

    Returns
    -------
    ndarray, shape (batch, pixels, pixels)
        Rows are y. NaN phases give NaN images.

    Raises
    ------
    UserError
        If the phase has the wrong shape.
    """
    check_phase(transform, phase)
    folded = transform.folded
    images = np.empty((len(phase), *2 * transform.axis.shape))
    for part in _parts(transform, len(phase)):
        if folded is not None:
            images[part] = folded_images(folded, _pupils(transform, phase[part]))
        else:
            images[part] = _images(transform, pupil_function(transform.pupil, phase[part]))
    return images


def amplitude_images(transform: MatrixFourier, amplitude: Complex) -> Real:
    """Return images of complex amplitudes, as `psf` does of phases alone.

    Parameters
    ----------
    transform : MatrixFourier
    amplitude : ndarray, shape (batch, m)
        At the pupil's patches; 1 everywhere is the perfect pupil.

    Returns
    -------
    ndarray, shape (batch, pixels, pixels)
        Irradiance; 1 is the perfect peak.

    Raises
    ------
    UserError
        If the amplitude has the wrong shape.
    """
    check_phase(transform, amplitude)
    images = np.empty((len(amplitude), *2 * transform.axis.shape))
    for part in _parts(transform, len(amplitude)):
        field = pupil_field(transform.pupil, amplitude[part])
        if transform.folded is not None:
            images[part] = folded_images(transform.folded, field)
        else:
            images[part] = _images(transform, field)
    return images


def _parts(transform: MatrixFourier, count: int) -> Iterator[slice]:
    """Yield which of `count` images are made at once, which bounds the memory."""
    if transform.folded is not None:
        return launches(transform.folded, count)
    return (slice(first, first + _BATCH) for first in range(0, count, _BATCH))


def _images(transform: MatrixFourier, field: Complex) -> Real:
    kernel = transform.kernel
    image = kernel @ field @ kernel.T  # a product per pupil: the bits do not depend on the batch
    return np.asarray((image.real**2 + image.imag**2) / transform.peak)


def psf_sum(transform: MatrixFourier, phase: Real, weights: Real) -> Real:
    """Return the weighted sum of point spread functions, as an exposure collects it.

    On an OpenCL device the images stay there.

    Parameters
    ----------
    transform : MatrixFourier
    phase : ndarray, shape (batch, m)
        As for `psf`.
    weights : ndarray, shape (batch,)
        An instant of weight 0 does not count, whatever its phase.

    Returns
    -------
    ndarray, shape (pixels, pixels)
        Its bits are those of adding one image after the other.

    Raises
    ------
    UserError
        If the phase has the wrong shape, or the weights are not one finite number for each instant.
    """
    check_phase(transform, phase)
    weights = np.asarray(weights, dtype=np.float64)
    if weights.shape != (len(phase),) or not np.isfinite(weights).all():
        raise UserError(f"{len(phase)} instants need as many finite weights, not {weights.shape}")
    total = np.zeros(2 * transform.axis.shape)
    for part in _parts(transform, len(phase)):
        if transform.folded is not None:
            total = folded_sum(transform.folded, _pupils(transform, phase[part]), weights[part], total)
            continue
        for weight, image in zip(weights[part], psf(transform, phase[part]), strict=True):
            total += weight * image if weight else 0.0
    return total


def check_phase(transform: MatrixFourier, phase: Real | Complex) -> None:
    """Raise UserError if phases have not the shape (batch, m) of the transform's pupil."""
    if phase.ndim != 2 or phase.shape[1] != len(transform.pupil.cells):
        raise UserError(
            f"the phase has the shape {phase.shape}; it must be (batch, {len(transform.pupil.cells)})"
        )


def _pupils(transform: MatrixFourier, phase: Real) -> Pupils:
    """Return phases, or complex amplitudes (batch, n, n) if cells hold several patches."""
    pupil, gather = transform.pupil, transform.gather
    if transform.starts is not None:
        return LitPhase(phase, transform.starts)
    if gather is None:
        return pupil_function(pupil, phase)
    assert transform.folded is not None
    full = np.empty((len(phase), gather.size), transform.folded.amplitude.dtype)
    for row, values in zip(full, phase.astype(full.dtype, copy=False), strict=True):
        np.take(values, gather, out=row, mode="clip")  # faster than to scatter, or to take many at once
    return full.reshape(-1, *pupil.amplitude.shape)


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
        together; at most 1e9.
    """
    cycles = 2.0 * phase_slope / (2.0 * np.pi) + field / 2.0
    return int(np.ceil(min(2.0 * cycles, _MOST)))
