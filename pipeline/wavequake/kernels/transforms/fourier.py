"""Two-dimensional discrete Fourier transforms of many images, by OpenCL or by SciPy, whichever is faster."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import DTypeLike, NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.first_batch import Pick, compare_first, is_trusted
from wavequake.kernels.device.opencl import NUMPY, Device, opencl_handle
from wavequake.kernels.device.steps import Step, run_steps, vector_width
from wavequake.kernels.transforms.fourier_source import factors, kernel_source, radices, row_lanes

Complex = NDArray[np.complex64] | NDArray[np.complex128]

ENGINES = ("auto", "opencl", "scipy")
# Below this many numbers (an image of 256 x 256) handing the work to the device's own thread can take longer
# than the kernels gain.
_SMALL = 1 << 16
# Images are transformed along rows and columns in groups of about this size, while caches still hold them.
_TOGETHER_BYTES = 1 << 20
# What is larger is in no cache when it is read again, and is stored past them.
_LARGE_BYTES = 1 << 22
_VECTOR_BYTES = 64
# Rows of a program's first image that are compared with NumPy, and by how much they may differ: a hundred
# times their rounding or more.
_COMPARED_ROWS = 16
_TOLERANCE = {"complex64": 1e-4, "complex128": 1e-11}
# What a work-item may keep in local memory.
_LOCAL_BYTES = {"cpu": 1 << 20, "gpu": 32 << 10}


@dataclass(frozen=True)
class Choice:
    """Which engine transforms, "opencl" or "scipy", and why."""

    engine: str
    reason: str


def choose_fourier(shape: tuple[int, ...], dtype: DTypeLike, device: Device = NUMPY) -> Choice:
    """Choose who transforms images of shape (..., rows, columns) the fastest.

    The choice depends on its arguments alone, so that results are the same in every run.
    """
    rows, columns = shape[-2:]
    unable = _unable((rows, columns), np.dtype(dtype), device)
    if unable:
        return Choice("scipy", unable)
    if device.kind == "gpu":
        return Choice("scipy", "the kernels are shaped for processors with vectors and caches, not for GPUs")
    lanes = row_lanes(columns, vector_width(device, _real(dtype), long=True))
    if lanes < 4:
        return Choice("scipy", f"rows of {columns} leave {lanes} of the vectors' lanes busy")
    if np.dtype(dtype) == np.complex64 and (rows & (rows - 1) or columns & (columns - 1)):
        return Choice("scipy", f"in complex64 the kernels gain by powers of 2 only, not by {rows}x{columns}")
    if np.prod(shape) < _SMALL:
        return Choice("scipy", f"{'x'.join(map(str, shape))} numbers are too few for a launch")
    return Choice("opencl", f"{rows}x{columns} has factors 2, 3 and 5 and fills {lanes} lanes")


def fourier_2d(
    values: NDArray[Any],
    inverse: bool = False,
    device: Device = NUMPY,
    engine: str = "auto",
    out: Complex | None = None,
) -> Complex:
    """Return the discrete Fourier transform over the last two axes, as `scipy.fft.fft2` or `ifft2`.

    Parameters
    ----------
    values : ndarray, shape (..., rows, columns), complex64 or complex128
    inverse : bool
        Whether to transform back, with the factor 1 / (rows columns).
    device : Device
        Where to run.
    engine : {"auto", "opencl", "scipy"}
        "auto" is what `choose_fourier` says.
    out : ndarray, optional
        Where the result goes, of the shape and type of the values and no part of them: new memory takes a
        fifth of the time of large transforms.

    Raises
    ------
    UserError
        If the values are no images of complex numbers, or the engine cannot transform them.
    """
    values = np.asarray(values)
    if values.dtype not in (np.complex64, np.complex128) or values.ndim < 2 or 0 in values.shape[-2:]:
        raise UserError(
            f"a transform takes complex64 or complex128 of shape (..., rows, columns), not {values.dtype} of "
            f"shape {values.shape}"
        )
    if out is not None and (out.shape, out.dtype, out.flags.c_contiguous) != (
        values.shape,
        values.dtype,
        True,
    ):
        raise ValueError(f"out must be a contiguous {values.dtype} array of shape {values.shape}")
    if out is not None and np.may_share_memory(out, values):
        raise ValueError("out must not share memory with the values")
    if engine not in ENGINES:
        raise UserError(f"the engine of a Fourier transform is one of {', '.join(ENGINES)}, not {engine!r}")
    if engine == "auto":
        engine = choose_fourier(values.shape, values.dtype, device).engine
    if engine == "scipy":
        transform = scipy.fft.ifft2 if inverse else scipy.fft.fft2
        transformed = np.asarray(transform(values))
        if out is None:
            return transformed
        out[...] = transformed
        return out
    unable = _unable(values.shape[-2:], values.dtype, device)
    if unable:
        raise UserError(f'the OpenCL transform cannot run: {unable}; use engine="scipy"')
    out = np.empty(values.shape, values.dtype) if out is None else out
    _opencl(values, inverse, device, out)
    return out


def _unable(shape: tuple[int, ...], dtype: np.dtype[Any], device: Device) -> str:
    """Return why OpenCL cannot transform, or nothing."""
    if device.kind == "numpy":
        return "the device is NumPy"
    for length in shape:
        if not radices(length, 8):
            return f"{length} has a prime factor above 5"
    width = vector_width(device, _real(dtype), long=True)
    need = max(2 * dtype.itemsize * shape[1], 2 * dtype.itemsize * shape[0] * width)
    most = _LOCAL_BYTES[device.kind]
    if device.kind == "cpu":
        most = min(most, opencl_handle(device).local_mem_size)  # PoCL does not notice, and crashes
    if need > most:
        return f"a panel of {need >> 10} KiB does not fit into local memory"
    return ""


def _opencl(values: NDArray[Any], inverse: bool, device: Device, out: Complex) -> None:
    images, results = (array.reshape(-1, *values.shape[-2:]) for array in (values, out))
    if not len(images):
        return
    real = _real(values.dtype)
    plan = _plan(device, images.shape, real, inverse, out.ctypes.data % _VECTOR_BYTES == 0)
    inputs = {"in": images.view(real), **plan.factors}
    run_steps(device, plan.steps, inputs, {"out": results.view(real)}, plan.scratch)
    if not is_trusted(device, plan.program):
        _compare(device, plan.program, images, results, inverse)


def _compare(
    device: Device, program: Any, images: NDArray[Any], results: NDArray[Any], inverse: bool
) -> None:
    """Compare rows of the first image that is finite, and not dark, with sums over the image.

    A row is measured by its own largest number or the root mean square of all, whichever is more: where an
    image is smooth a few numbers are far larger than the others, which are to count, too.
    """
    squares = ((number, np.vdot(image, image).real) for number, image in enumerate(images))
    with np.errstate(invalid="ignore", over="ignore"):  # the input may be anything
        number, square = next((pair for pair in squares if 0.0 < pair[1] < np.inf), (0, 0.0))
    if not square:
        return
    image, (count, columns) = images[number], images.shape[1:]
    rows = np.unique(np.linspace(0, count - 1, _COMPARED_ROWS).astype(np.intp))
    turns = np.outer(rows, np.arange(count)) % count / count
    waves = np.exp((2j if inverse else -2j) * np.pi * turns).astype(image.dtype)
    along = scipy.fft.ifft if inverse else scipy.fft.fft
    expected = along(waves @ image, axis=1).astype(np.complex128) / (count if inverse else 1)
    norm = np.sqrt(np.float64(square)) / (count * columns if inverse else 1)
    size = np.maximum(norm, np.abs(expected).max(axis=1, keepdims=True))
    one, other = (
        np.ascontiguousarray(part / size).view(np.float64) for part in (results[number, rows], expected)
    )

    def twin(pick: Pick) -> list[NDArray[np.float64]]:
        return list(other[pick].T)

    tolerance = _TOLERANCE[image.dtype.name]
    compare_first(device, program, list(one.T), twin, kind="rows of the image", tolerance=tolerance)


@dataclass(frozen=True)
class _Plan:
    """What `run_steps` needs to transform images of a shape."""

    steps: tuple[Step, ...]
    factors: dict[str, NDArray[Any]]
    scratch: dict[str, int]
    program: tuple[Any, ...]


@lru_cache(maxsize=64)
def _plan(
    device: Device, shape: tuple[int, int, int], real: np.dtype[Any], inverse: bool, aligned: bool
) -> _Plan:
    """Plan the transform of images (count, rows, columns) whose results begin at whole vectors, or not."""
    images, rows, columns = shape
    width = native = vector_width(device, real, long=True)
    while width > columns:
        width //= 2
    image_bytes = 2 * real.itemsize * rows * columns
    together = max(1, _TOGETHER_BYTES // image_bytes)
    # Where columns do not fill their last group it overlaps the one before it: then there are no panels.
    whole, large = columns % width == 0, image_bytes >= _LARGE_BYTES
    # A single image that caches hold is transformed in its place.
    panels = whole and (large or images > together)
    between = "between" if panels or not whole else "out"
    common = {"SINGLE": int(real == np.float32), "INVERSE": int(inverse), "PANEL": width if panels else 0}
    row_constants = common | {"W": row_lanes(columns, native), "N": columns, "OTHER": rows}
    row_constants["STREAM"] = int(panels and large)
    column_constants = common | {"W": width, "N": rows, "OTHER": columns}
    column_constants["STREAM"] = int(panels and aligned)
    along_rows = kernel_source(columns, True, native), "transform", tuple(row_constants.items())
    along_columns = kernel_source(rows, False, native), "transform", tuple(column_constants.items())
    one, scale = real.type(1.0), real.type(1.0 / (rows * columns) if inverse else 1.0)
    steps = []
    for first in range(0, images, together):
        count, groups = min(together, images - first), -(-columns // width)
        # In its place there is one group of images: where it begins is 0.
        places = np.array([[first * rows, 0, count * rows], [0, first, groups]], np.int32)
        to_rows = (*places[0], "in", "row_factors", one, between)
        to_columns = (*places[1], between, "column_factors", scale, "out")
        steps.append(Step(*along_rows, (1, count * rows, 1), (1, 1, 1), to_rows))
        steps.append(Step(*along_columns, (1, groups, count), (1, 1, 1), to_columns))
    table = {"row_factors": (columns, True), "column_factors": (rows, False)}
    factors_of = {
        name: np.append(factors(length, along, native), 0.0).astype(real)
        for name, (length, along) in table.items()
    }
    scratch = {} if between == "out" else {"between": min(images, together) * image_bytes}
    return _Plan(tuple(steps), factors_of, scratch, (along_rows, along_columns))


def _real(dtype: DTypeLike) -> np.dtype[Any]:
    return np.dtype(np.float32 if np.dtype(dtype) == np.complex64 else np.float64)
