"""Images of equal segments on a regular lattice, with pistons and slopes: one launch for many images."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from wavequake.kernels.device.first_batch import Pick, compare_first, is_trusted
from wavequake.kernels.device.opencl import Device, opencl_handle
from wavequake.kernels.device.program import launch
from wavequake.kernels.device.steps import vector_width
from wavequake.kernels.transforms.lattice_numpy import lattice_field, moment_waves

Floating = NDArray[np.float32] | NDArray[np.float64]
Real = NDArray[np.float64]

# Bytes of local memory that are left to the compiler.
_LOCAL_SPARE = 1 << 12
# By how much amplitudes of an image may differ from NumPy's, relative to the peak or to what adds up to it.
# Slopes that let more than the last number add up are beyond any series.
_TOLERANCE = {"float64": 1e-11, "float32": 1e-4}
_HOPELESS = 1e6


@dataclass(frozen=True)
class LatticeKernel:
    """The tables of one lattice and one image for a device.

    Attributes
    ----------
    device : Device
    constants : tuple of (str, int)
        Compile-time constants of ``kernels/lattice.cl``.
    ramp : ndarray, shape (S,)
        Phase that puts an even number of pixels symmetric about 0.
    tables : tuple of ndarray
        Places of the segments in a quarter of the lattice, what each adds to the parts even and odd in x and
        y, waves along x and along y, and the irradiance of a segment, or its moments.
    shape : tuple of int
        Of an image.
    degree : int
        Of the moments, 0 for pistons alone.
    scale : float
        Length in mm that makes slopes and moments dimensionless.
    places : ndarray, shape (2, S)
        Along x and y.
    step : float
        Distance of the pixels in cycles per unit of the places.
    """

    device: Device
    constants: tuple[tuple[str, int], ...]
    ramp: Real
    tables: tuple[NDArray[Any], ...]
    shape: tuple[int, int]
    degree: int
    scale: float
    places: Real
    step: float


def lattice_kernel(
    numbers: tuple[NDArray[np.intp], NDArray[np.intp]],
    lines: tuple[Real, Real],
    moments: NDArray[np.complex128],
    scale: float,
    step: float,
    device: Device,
    dtype: DTypeLike,
) -> LatticeKernel | None:
    """Prepare the images of a lattice; none if the device is no OpenCL processor, or the image too large.

    Parameters
    ----------
    numbers : tuple of ndarray of int, shape (S,)
        Column and row of each segment.
    lines : tuple of ndarray
        Places of the columns along x and of the rows along y, evenly spaced about 0.
    moments : ndarray, shape (J, pixels, pixels)
        Transforms of a segment times monomials of a complete degree, in the order of
        `wavequake.imaging.engines.segment_moments.exponents`, relative to the peak of the whole pupil.
    scale : float
        Length in mm that makes monomials dimensionless.
    step : float
        Distance of the pixels in cycles per unit of the places.
    device : Device
    dtype : float32 or float64
        Precision of the images.
    """
    if device.kind != "cpu":
        return None  # a GPU wants more work-items than there are images
    dtype, pixels, segments = np.dtype(dtype), moments.shape[1], numbers[0].size
    degree = (math.isqrt(8 * len(moments) + 1) - 3) // 2
    width = vector_width(device, dtype, long=True)
    while width > segments:
        width //= 2
    wide = 1 if width * dtype.itemsize < 64 else 2  # as many sums as there are registers
    quarter = (pixels + 1) // 2
    padded = -(-quarter // (wide * width)) * wide * width
    columns, rows = ((len(line) + 1) // 2 for line in lines)
    numbers_kept = len(moments) * 8 * columns * (rows + padded) + 8 * padded
    if numbers_kept * dtype.itemsize + _LOCAL_SPARE > opencl_handle(device).local_mem_size:
        return None  # PoCL does not notice, and crashes
    frequency = np.asarray((np.arange(padded) + 0.5 * (1 - pixels % 2)) * step, np.float64)
    (column, even_x, odd_x), (row, even_y, odd_y) = (
        _folded(number, len(line)) for number, line in zip(numbers, lines, strict=True)
    )
    shares = np.stack([even_x * even_y, even_x * odd_y, odd_x * even_y, odd_x * odd_y], axis=1)
    ramp = np.pi * step * (1 - pixels % 2) * (lines[0][numbers[0]] + lines[1][numbers[1]])
    constants = {"W": width, "SINGLE": int(dtype == np.float32), "WIDE": wide, "SEGMENTS": segments}
    constants |= {"ROWS": rows, "COLUMNS": columns, "PIXELS": pixels, "QUARTER": quarter, "WAVES": padded}
    constants |= {"DEGREE": degree}
    parts = np.stack([moments.real, moments.imag], axis=1)
    segment = parts if degree else (parts[0] ** 2).sum(axis=0)
    return LatticeKernel(
        device,
        tuple(constants.items()),
        ramp,
        (
            (row * columns + column).astype(np.int32),
            shares.astype(dtype),
            _waves(lines[0], frequency, dtype),
            _waves(lines[1], frequency, dtype),
            np.pad(segment.astype(dtype).ravel(), width),
        ),
        (pixels, pixels),
        degree,
        scale,
        np.stack([line[number] for line, number in zip(lines, numbers, strict=True)]),
        step,
    )


def lattice_images(kernel: LatticeKernel, motion: Real) -> Floating:
    """Return images (batch, pixels, pixels) of pistons and slopes.

    Parameters
    ----------
    kernel : LatticeKernel
    motion : ndarray, shape (batch, S, 3)
        Pistons in waves and slopes in waves per mm; a number that is not finite makes an image of NaN. Slopes
        do not count where the kernel has none.
    """
    dtype = kernel.tables[-1].dtype
    images = np.empty((len(motion), *kernel.shape), dtype)
    numbers = np.where(np.isfinite(motion), motion, np.nan)
    given = np.empty((len(motion), 3 if kernel.degree else 1, motion.shape[1]), dtype)
    given[:, 0] = 2.0 * np.pi * (numbers[..., 0] - np.rint(numbers[..., 0])) + kernel.ramp
    if kernel.degree:
        given[:, 1:] = 2.0 * np.pi * kernel.scale * numbers[..., 1:].swapaxes(1, 2)
    inputs = [np.int32(len(images)), given, *kernel.tables]
    launch(kernel.device, "lattice", kernel.constants, (1, len(images), 1), inputs, [images], group=1)
    program = "lattice", kernel.constants
    if not is_trusted(kernel.device, program):
        _compare(kernel, program, numbers, images)
    return images


def _compare(kernel: LatticeKernel, program: Any, motion: Real, images: Floating) -> None:
    """Compare rows of the first image of known motion with NumPy.

    These are amplitudes, whose errors do not depend on the irradiance.
    """
    known = np.isfinite(motion if kernel.degree else motion[..., :1]).all(axis=(1, 2))
    if not known.any():
        return
    number = int(known.argmax())
    width = dict(kernel.constants)["W"]
    segment = kernel.tables[-1][width:-width].astype(np.float64).reshape(-1, *kernel.shape)
    # Of pistons alone the table is an irradiance.
    moments = segment[::2] + 1j * segment[1::2] if kernel.degree else np.sqrt(segment).astype(np.complex128)
    waves = moment_waves(motion[number], len(moments), kernel.scale)
    most = float((np.abs(moments).max(axis=(1, 2)) * np.abs(waves).sum(axis=1)).sum())
    if not most < _HOPELESS:
        return

    def twin(pick: Pick) -> list[Real]:
        return list(np.abs(lattice_field(kernel.places, moments, kernel.step, waves, pick)).T)

    found = np.sqrt(np.maximum(images[number].astype(np.float64), 0.0))
    tolerance = _TOLERANCE[images.dtype.name]
    compare_first(kernel.device, program, list(found.T), twin, most, "rows of the image", tolerance)


def _folded(number: NDArray[np.intp], length: int) -> tuple[NDArray[np.intp], Real, Real]:
    """Return places in the upper half of a line, and shares in what is even and odd about its middle."""
    upper = np.where(number < length // 2, length - 1 - number, number) - length // 2
    return upper, np.ones(number.size), np.sign(number - 0.5 * (length - 1))


def _waves(line: Real, frequency: Real, dtype: DTypeLike) -> Floating:
    """Return cosines and sines (2, half, frequencies) at the upper half of a line of places."""
    cycles = np.outer(line[len(line) // 2 :], frequency)
    angle = 2.0 * np.pi * (cycles - np.rint(cycles))
    return np.stack([np.cos(angle), np.sin(angle)]).astype(dtype)
