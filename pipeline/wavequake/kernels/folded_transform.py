"""Transform pupils to images by matrix products on the pixels that are wanted, many pupils in a launch."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from wavequake.kernels.devices import Device
from wavequake.kernels.program import source
from wavequake.kernels.steps import Step, run_steps, vector_width

Floating = NDArray[np.float32] | NDArray[np.float64]
Real = NDArray[np.float64]

# Images in a launch: their transformed columns (1 MB each at 512 cells and 128 pixels) stay in the cache.
_BATCH = 8
# Rows of an image that share what is read, and vectors of pixels in a row: as many sums as registers hold.
_TALL = {"cpu": 3, "gpu": 4}
_WIDE = {("cpu", "float64"): 2, ("cpu", "float32"): 3, ("gpu", "float64"): 1, ("gpu", "float32"): 1}
# Singular values of the transform that are left out, relative to the largest.
_NEGLIGIBLE = {"float64": 1e-15, "float32": 1e-7}
# Work-items in a group on a GPU.
_GROUP = 64


@dataclass(frozen=True)
class FoldedTransform:
    """The transform of one amplitude to one image, with its tables for a device.

    Attributes
    ----------
    device : Device
    pixels : int
    sampling : float
        Distance of the pixels in wavelengths / diameter.
    scale : float
        What irradiances are multiplied by.
    amplitude : ndarray, shape (n, n), float32 or float64
    width, rows, columns : int
        Lanes, and the padded numbers of frequencies along y and of the numbers that stand for those along x.
    ramp : ndarray, shape (n,)
        Phase that puts an even number of pixels symmetric about 0.
    range : ndarray of int32, shape (rows of the upper half, 2)
        First column with light right of the middle, and one past the last.
    along_y : ndarray
        Cosines, then sines.
    along_x, across : ndarray
        Two thin matrices whose product these are; the second ends at the frequencies.
    """

    device: Device
    pixels: int
    sampling: float
    scale: float
    amplitude: Floating
    width: int
    rows: int
    columns: int
    ramp: Floating
    range: NDArray[np.int32]
    along_y: Floating
    along_x: Floating
    across: Floating


def folded_transform(
    amplitude: Real, pixels: int, sampling: float, scale: float, device: Device, dtype: DTypeLike = np.float64
) -> FoldedTransform:
    """Prepare the transform of pupils with an amplitude (n, n) to images of `pixels` x `pixels`.

    The pupil's cells lie in the middles of n intervals of its diameter, rows are y. Pixel ``pixels // 2`` is
    the origin, and ``sampling`` the distance of pixels in wavelengths / diameter.

    Parameters
    ----------
    amplitude : ndarray, shape (n, n)
        Where it is 0 the phase does not matter; n >= 2.
    pixels, sampling
        As above.
    scale : float
        What irradiances are multiplied by, usually 1 / peak.
    device : Device
        An OpenCL device.
    dtype : float32 or float64
        Precision of phases and images.
    """
    dtype = np.dtype(dtype)
    samples = len(amplitude)
    half, quarter = (samples + 1) // 2, (pixels + 1) // 2
    width = _width(device, dtype, half)
    tall, wide = _TALL[device.kind], _WIDE[device.kind, dtype.name]
    place = (2.0 * np.arange(half) + 1.0 - samples % 2) / samples  # of cells right of the middle
    frequency = (np.arange(quarter) + 0.5 * (1 - pixels % 2)) * sampling
    turn = 0.5 * np.outer(frequency, place)
    phase = 2.0 * np.pi * (turn - np.rint(turn))
    tables = np.stack([np.cos(phase), np.sin(phase)])
    if samples % 2:
        tables[0, :, 0] *= 0.5  # the middle cell is its own mirror image
    rows = -(-quarter // tall) * tall
    tall_tables = np.zeros((2, rows, half))
    tall_tables[:, :quarter] = tables
    cells, across = _thin(tables, wide * width, _NEGLIGIBLE[dtype.name])
    columns = cells.shape[1]
    across = np.pad(across, ((0, 0), (0, 0), (0, -quarter % width)))
    pack = columns if device.kind == "gpu" else wide * width
    axis = (2.0 * np.arange(samples) + 1.0) / samples - 1.0
    ramp = np.pi * 0.5 * sampling * axis * (1 - pixels % 2)
    return FoldedTransform(
        device,
        pixels,
        sampling,
        scale,
        np.ascontiguousarray(amplitude, dtype),
        width,
        rows,
        columns,
        ramp.astype(dtype),
        _lit_columns(amplitude),
        # (parity, group of frequencies, cell, frequency)
        np.ascontiguousarray(tall_tables.reshape(2, -1, tall, half).transpose(0, 1, 3, 2), dtype),
        np.ascontiguousarray(cells.reshape(2, -1, pack, half).transpose(0, 1, 3, 2), dtype),
        np.ascontiguousarray(across, dtype),
    )


def folded_images(transform: FoldedTransform, pupils: NDArray[Any]) -> Floating:
    """Return the images (batch, pixels, pixels) of pupils.

    Parameters
    ----------
    transform : FoldedTransform
    pupils : ndarray, shape (batch, n, n)
        Phases in rad, or complex amplitudes (which replace the transform's own).
    """
    pixels = transform.pixels
    images = np.empty((len(pupils), pixels, pixels), transform.amplitude.dtype)
    for first in range(0, len(pupils), _BATCH):
        out = images[first : first + _BATCH]
        steps, inputs, scratch = _image_steps(transform, pupils[first : first + _BATCH])
        run_steps(transform.device, steps, inputs, {"images": out}, scratch)
    return images


def folded_sum(transform: FoldedTransform, pupils: NDArray[Any], weights: Real, total: Real) -> Real:
    """Add the weighted images of pupils, which stay on the device, to a sum (pixels, pixels).

    Images of weight 0 may be anything, NaN too. The bits of the sum are those of adding one by one.
    """
    pixels = transform.pixels
    for first in range(0, len(pupils), _BATCH):
        part = pupils[first : first + _BATCH]
        steps, inputs, scratch = _image_steps(transform, part)
        scratch["images"] = len(part) * pixels * pixels * transform.amplitude.itemsize
        inputs |= {"weights": np.asarray(weights[first : first + _BATCH], np.float64), "before": total}
        group = {"cpu": 1024, "gpu": 64}[transform.device.kind]
        arguments = (np.int32(len(part)), "weights", "images", "before", "after")
        steps.append(
            Step(_text(), "accumulate", steps[0].constants, (1, pixels * pixels, 1), (1, group, 1), arguments)
        )
        total = np.empty((pixels, pixels))
        run_steps(transform.device, steps, inputs, {"after": total}, scratch)
    return total


def _image_steps(
    transform: FoldedTransform, pupils: NDArray[Any]
) -> tuple[list[Step], dict[str, NDArray[Any]], dict[str, int]]:
    """Return the launches that make images, what they read, and the memory they need."""
    t, dtype = transform, transform.amplitude.dtype
    batch, samples = len(pupils), len(t.amplitude)
    half, quarter = (samples + 1) // 2, (t.pixels + 1) // 2
    field = np.iscomplexobj(pupils)
    if field:
        pupils = pupils * np.exp(1j * (t.ramp.astype(np.float64) + t.ramp.astype(np.float64)[:, None]))
        pupils = np.stack([pupils.real, pupils.imag], axis=1)
    gpu = t.device.kind == "gpu"
    tall, wide = _TALL[t.device.kind], _WIDE[t.device.kind, dtype.name]
    pack, line = (t.columns, t.columns) if gpu else (wide * t.width, t.width)
    constants = {"W": t.width, "SINGLE": int(dtype == np.float32), "N": samples, "HALF": half}
    constants |= {"PIXELS": t.pixels, "QUARTER": quarter, "ROWS": t.rows, "COLUMNS": t.columns}
    constants |= {"ACROSS": t.across.shape[2]}
    constants |= {"TALL": tall, "WIDE": wide, "PACK": pack, "LINE": line}
    names = tuple((constants | {"FIELD": int(field), "SHARED": int(gpu)}).items())
    blocks = t.columns // (wide * t.width)
    tiles, lines = t.rows // tall, t.columns // t.width
    pupil = ("pupil", "amplitude", "ramp")
    folded = ("folded",) if gpu else ()
    along = (_GROUP, 1, 1) if gpu else (1, 1, 1)
    sizes = [(blocks if gpu else 1, half, batch), (lines, tiles, batch) if gpu else (tiles, lines, batch)]
    steps = [Step(_text(), "fold", names, (half, half, batch), along, (*pupil, "folded"))] if gpu else []
    rows = (*pupil, "range", "along_x", *folded, "rows")
    pixels = (dtype.type(t.scale), "across", "lines", "images")
    size = (t.across.shape[2] // t.width if gpu else 1, quarter, batch)
    steps += [Step(_text(), "transform_rows", names, sizes[0], along, rows)]
    steps += [Step(_text(), "transform_columns", names, sizes[1], along, ("along_y", "rows", "lines"))]
    steps += [Step(_text(), "assemble", names, size, along, pixels)]
    inputs: dict[str, NDArray[Any]] = {"pupil": np.asarray(pupils, dtype), "amplitude": t.amplitude}
    inputs |= {"ramp": t.ramp, "range": t.range, "along_y": t.along_y, "along_x": t.along_x}
    inputs["across"] = t.across
    scratch = {"rows": batch * half * 8 * t.columns * dtype.itemsize}
    scratch["lines"] = batch * t.rows * 8 * t.columns * dtype.itemsize
    if gpu:
        scratch["folded"] = batch * half * 8 * half * dtype.itemsize
    return steps, inputs, scratch


@lru_cache(maxsize=1)
def _text() -> str:
    return source("folded_transform.cl")


def _width(device: Device, dtype: np.dtype[Any], half: int) -> int:
    """Return the lanes of a vector: the processor's own, but no more than half a row of the pupil."""
    width = vector_width(device, dtype)
    while width > half:
        width //= 2
    return width


def _thin(tables: Real, group: int, negligible: float) -> tuple[Real, Real]:
    """Factor cosines and sines (2, frequencies, cells) into (2, K, cells) and (2, K, frequencies).

    An image is smooth: where its pixels are closer than the pupil's extent demands, K is smaller than their
    number. K is filled up to a whole number of groups.
    """
    left, size, right = np.linalg.svd(tables, full_matrices=False)
    rank = int((size > negligible * size[:, :1]).sum(axis=1).max())
    padded = -(-rank // group) * group
    kept = min(padded, size.shape[1])
    extra = ((0, 0), (0, padded - kept), (0, 0))
    to_pixels = (left[..., :kept] * size[:, None, :kept]).transpose(0, 2, 1)
    return np.pad(right[:, :kept], extra), np.pad(to_pixels, extra)


def _lit_columns(amplitude: Real) -> NDArray[np.int32]:
    samples = len(amplitude)
    lit = amplitude != 0.0
    lit = lit | lit[::-1]
    lit = (lit | lit[:, ::-1])[samples // 2 :, samples // 2 :]
    first, last = lit.argmax(axis=1), lit.shape[1] - lit[:, ::-1].argmax(axis=1)
    return np.stack([first, np.where(lit.any(axis=1), last, first)], axis=1).astype(np.int32)
