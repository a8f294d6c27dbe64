"""Transform pupils to images by matrix products on the pixels that are wanted, many pupils in a launch."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from threading import get_ident
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from wavequake.kernels.device.first_batch import Pick, compare_first, is_trusted
from wavequake.kernels.device.opencl import Device
from wavequake.kernels.device.program import source
from wavequake.kernels.device.steps import Step, run_steps, vector_width
from wavequake.kernels.transforms.folded_numpy import field_numpy, first_finite, pixels_numpy
from wavequake.kernels.transforms.folded_pupils import (
    LitPhase,
    Pupils,
    Rim,
    SmoothPhase,
    count_of,
    lit_columns,
    part_of,
    rim_places,
)

Floating = NDArray[np.float32] | NDArray[np.float64]
Real = NDArray[np.float64]
# What kernels read of pupils, compile-time constants that say what that is, and how many numbers a pupil has.
_Given = tuple[dict[str, NDArray[Any]], dict[str, int], int]
# Images in a launch: as many as have their transformed columns in the cache (1 MB each at 512 cells and 128
# pixels), since each launch takes up to half a millisecond beside its work.
_FEWEST, _MOST, _CACHED_BYTES = 8, 64, 1 << 23
# Rows of an image that share what is read, and vectors of pixels in a row: as many sums as registers hold.
_TALL = {"cpu": 3, "gpu": 4}
_WIDE = {("cpu", "float64"): 2, ("cpu", "float32"): 3, ("gpu", "float64"): 1, ("gpu", "float32"): 1}
# Singular values of the transform that are left out, relative to the largest.
_NEGLIGIBLE = {"float64": 1e-15, "float32": 1e-7}
# By how much amplitudes of images may differ from NumPy's, relative to the light and to phases above 1 rad.
_TOLERANCE = {"float64": 1e-11, "float32": 1e-4}
_COMPARED_COLUMNS = 64
# Phases of lit cells of a launch whose memory is kept for the next one.
_KEPT_BYTES = 1 << 26
_GROUP = 64  # work-items of a GPU


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
    rim : Rim
        Light beside that of the amplitude, for phases that are smooth.
    rim_order : ndarray of int, shape (R,)
        By the rows it lies in.
    rim_places : ndarray of int32, shape (rows of the upper half + 1 + R,)
        Where each row's light begins in it, then the column of each.
    rim_light : ndarray, shape (R, 4)
        What it adds to the even-even, even-odd, odd-even and odd-odd part of the row.
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
    rim: Rim
    rim_order: NDArray[np.intp]
    rim_places: NDArray[np.int32]
    rim_light: Floating


def folded_transform(
    amplitude: Real,
    pixels: int,
    sampling: float,
    scale: float,
    device: Device,
    dtype: DTypeLike = np.float64,
    rim: Rim | None = None,
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
    rim : Rim, optional
        Light that `SmoothPhase` pupils have beside the amplitude's.
    """
    rim = rim or Rim(np.zeros(0, dtype=np.intp), np.zeros(0))
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
    ramp = _ramp_slope(pixels, sampling) * axis
    order, places, shares = rim_places(rim, samples)
    return FoldedTransform(
        device=device,
        pixels=pixels,
        sampling=sampling,
        scale=scale,
        amplitude=np.ascontiguousarray(amplitude, dtype),
        width=width,
        rows=rows,
        columns=columns,
        ramp=ramp.astype(dtype),
        range=lit_columns(amplitude, rim),
        # (parity, group of frequencies, cell, frequency)
        along_y=np.ascontiguousarray(tall_tables.reshape(2, -1, tall, half).transpose(0, 1, 3, 2), dtype),
        along_x=np.ascontiguousarray(cells.reshape(2, -1, pack, half).transpose(0, 1, 3, 2), dtype),
        across=np.ascontiguousarray(across, dtype),
        rim=rim,
        rim_order=order,
        rim_places=places,
        rim_light=shares.astype(dtype),
    )


def launches(transform: FoldedTransform, count: int) -> Iterator[slice]:
    """Yield which of `count` images are made in one launch each; their bits do not depend on that."""
    size = 4 * len(transform.amplitude) * transform.columns * transform.amplitude.itemsize
    batch = min(_MOST, max(_FEWEST, _CACHED_BYTES // size))
    return (slice(first, first + batch) for first in range(0, count, batch))


def folded_images(transform: FoldedTransform, pupils: Pupils) -> Floating:
    """Return the images (batch, pixels, pixels) of pupils.

    Parameters
    ----------
    transform : FoldedTransform
    pupils : ndarray, shape (batch, n, n), LitPhase or SmoothPhase
        Phases in rad, or complex amplitudes (which replace the transform's own). Smooth phases are made on
        the device; only with them does the rim count.
    """
    pixels = transform.pixels
    count = count_of(pupils)
    images = np.empty((count, pixels, pixels), transform.amplitude.dtype)
    for some in launches(transform, count):
        out, part = images[some], part_of(pupils, some)
        steps, inputs, scratch = _image_steps(transform, part)
        run_steps(transform.device, steps, inputs, {"images": out}, scratch)
        program = "images", steps[0].constants
        if not is_trusted(transform.device, program):
            _compare_image(transform, program, part, out)
    return images


def _compare_image(t: FoldedTransform, program: Any, pupils: Pupils, images: Floating) -> None:
    """Compare rows of an image with NumPy: their amplitudes, whose errors do not depend on the irradiance."""
    number = first_finite(pupils)
    with np.errstate(all="ignore"):  # phases may be anything
        field, phase = field_numpy(pupils, number, t.amplitude, t.rim)
        light = float(np.abs(field).sum())
        if not (0.0 < light < np.inf):
            return  # nothing to compare yet
        columns = np.arange(0, t.pixels, -(-t.pixels // _COMPARED_COLUMNS) | 1)  # odd: of all lanes alike
        some = images[number][:, columns].astype(np.float64)
        found = np.sqrt(np.maximum(some / t.scale, 0.0)) / light

    def twin(pick: Pick) -> list[Real]:
        return list(np.abs(pixels_numpy(field, t.pixels, t.sampling, pick, columns)).T / light)

    tolerance = _TOLERANCE[t.amplitude.dtype.name]
    compare_first(t.device, program, list(found.T), twin, phase, "rows of the image", tolerance)


def folded_sum(transform: FoldedTransform, pupils: Pupils, weights: Real, total: Real) -> Real:
    """Add the weighted images of pupils, which stay on the device, to a sum (pixels, pixels).

    Images of weight 0 may be anything, NaN too. The bits of the sum are those of adding one by one.
    """
    pixels = transform.pixels
    for together in launches(transform, len(weights)):
        some, part = part_of(pupils, together), np.asarray(weights[together], np.float64)
        steps, inputs, scratch = _image_steps(transform, some)
        scratch["images"] = len(part) * pixels * pixels * transform.amplitude.itemsize
        inputs |= {"weights": part, "before": total}
        group = {"cpu": 1024, "gpu": 64}[transform.device.kind]
        arguments = (np.int32(len(part)), "weights", "images", "before", "after")
        steps.append(
            Step(_text(), "accumulate", steps[0].constants, (1, pixels * pixels, 1), (1, group, 1), arguments)
        )
        before, total = total, np.empty((pixels, pixels))
        run_steps(transform.device, steps, inputs, {"after": total}, scratch)
        program = "accumulate", steps[0].constants
        if not is_trusted(transform.device, program) and part.any() and np.isfinite(before).all():
            _compare_sum(transform, program, some, part, before, total)
    return total


def _compare_sum(
    t: FoldedTransform, program: Any, pupils: Pupils, weights: Real, before: Real, found: Real
) -> None:
    """Compare a sum with that of the images, which are compared themselves."""
    counts = weights != 0.0
    images = folded_images(t, pupils)[counts]
    with np.errstate(all="ignore"):  # images may be NaN
        expected = before + np.tensordot(weights[counts], images, axes=1)
        size = float(np.abs(expected).max()) or 1.0
    if not np.isfinite(size):
        return  # nothing to compare yet

    def twin(pick: Pick) -> list[Real]:
        return list(expected[pick].T / size)

    compare_first(t.device, program, list(found.T / size), twin, kind="rows of the image")


def _image_steps(
    transform: FoldedTransform, pupils: Pupils
) -> tuple[list[Step], dict[str, NDArray[Any]], dict[str, int]]:
    """Return the launches that make images, what they read, and the memory they need."""
    t, dtype = transform, transform.amplitude.dtype
    half, quarter = (len(t.amplitude) + 1) // 2, (t.pixels + 1) // 2
    if isinstance(pupils, SmoothPhase):
        inputs, form, size = _smooth(t, pupils)
    else:
        inputs, form, size = _lit(t, pupils) if isinstance(pupils, LitPhase) else _cellular(t, pupils)
    batch, terms = count_of(pupils), form["TERMS"]
    gpu = t.device.kind == "gpu"
    tall, wide = _TALL[t.device.kind], _WIDE[t.device.kind, dtype.name]
    pack, line = (t.columns, t.columns) if gpu else (wide * t.width, t.width)
    constants = {"W": t.width, "SINGLE": int(dtype == np.float32), "N": len(t.amplitude), "HALF": half}
    constants |= {"PIXELS": t.pixels, "QUARTER": quarter, "ROWS": t.rows, "COLUMNS": t.columns}
    constants |= {"TALL": tall, "WIDE": wide, "PACK": pack, "LINE": line, "ACROSS": t.across.shape[2]}
    names = tuple((constants | form | {"SHARED": int(gpu)}).items())
    along = (_GROUP, 1, 1) if gpu else (1, 1, 1)

    def step(kernel: str, size: tuple[int, int, int], *arguments: Any) -> Step:
        return Step(_text(), kernel, names, size, along, arguments)

    tables = ("chebyshev", "rim_phase", "rim", "rim_light") if terms else ("ramp", "starts")
    pupil = (np.int32(size), "pupil", "amplitude", *tables)
    cells = (np.int32(inputs["rim_phase"].shape[1]),) if terms else ()
    steps = [step("fold", (half, half, batch), *pupil, "folded")] if gpu else []
    if gpu and terms:
        steps += [step("fold_rim", (1, half, batch), *cells, *tables[1:], "folded")]
    folded = ("folded",) if gpu else ()
    blocks, tiles, lines = t.columns // (wide * t.width), t.rows // tall, t.columns // t.width
    steps += [
        step(
            "transform_rows",
            (blocks if gpu else 1, half, batch),
            *(*pupil, *cells, "range", "along_x", *folded, "rows"),
        ),
        step(
            "transform_columns",
            (lines, tiles, batch) if gpu else (tiles, lines, batch),
            *("along_y", "rows", "lines"),
        ),
        step(
            "assemble",
            (t.across.shape[2] // t.width if gpu else 1, quarter, batch),
            *(dtype.type(t.scale), "across", "lines", "images"),
        ),
    ]
    inputs |= {"amplitude": t.amplitude, "range": t.range}
    inputs |= {"along_y": t.along_y, "along_x": t.along_x, "across": t.across}
    numbers = {"rows": half * 8 * t.columns, "lines": t.rows * 8 * t.columns}
    if gpu:
        numbers["folded"] = half * 8 * half
    return steps, inputs, {name: batch * count * dtype.itemsize for name, count in numbers.items()}


def _cellular(t: FoldedTransform, pupils: NDArray[Any]) -> _Given:
    """Return what kernels read of pupils that are given cell by cell, constants, and their size."""
    samples, field = len(t.amplitude), np.iscomplexobj(pupils)
    if field:
        ramp = t.ramp.astype(np.float64)
        pupils = pupils * np.exp(1j * (ramp + ramp[:, None]))
        pupils = np.stack([pupils.real, pupils.imag], axis=1)
    starts = np.repeat(samples * np.arange(samples, dtype=np.int32)[:, None], 2, axis=1)
    inputs = {"pupil": np.asarray(pupils, t.amplitude.dtype), "ramp": t.ramp, "starts": starts}
    return inputs, {"TERMS": 0, "FIELD": int(field)}, (1 + field) * samples * samples


def _lit(t: FoldedTransform, pupils: LitPhase) -> _Given:
    """Return what kernels read of pupils that are given where light falls, constants, and their size."""
    samples, (batch, size) = len(t.amplitude), pupils.values.shape
    # Vectors hold dark cells, too: up to half a row of them before the first lit one and after the last.
    room = batch * size + 2 * samples, t.amplitude.dtype
    padded = _room(*room, get_ident()) if room[0] * room[1].itemsize <= _KEPT_BYTES else np.empty(*room)
    padded[:samples] = padded[-samples:] = 0.0
    padded[samples:-samples].reshape(batch, size)[...] = pupils.values
    inputs = {"pupil": padded, "ramp": t.ramp, "starts": pupils.starts + np.int32(samples)}
    return inputs, {"TERMS": 0, "FIELD": 0}, size


@lru_cache(maxsize=4)
def _room(size: int, dtype: np.dtype[Any], thread: int) -> NDArray[Any]:
    """Return memory that a thread fills for every launch: new memory takes a fifth of the time of images."""
    return np.empty(size, dtype)


def _smooth(t: FoldedTransform, pupils: SmoothPhase) -> _Given:
    """Return what kernels read of pupils whose phases are polynomials, constants, and their size."""
    samples, dtype = len(t.amplitude), t.amplitude.dtype
    axis = (2.0 * np.arange(samples // 2, samples) + 1.0) / samples - 1.0
    ramp = _ramp_slope(t.pixels, t.sampling)
    coefficients = np.array(pupils.coefficients, dtype=np.float64)
    terms = coefficients.shape[1]
    rim = pupils.rim[:, t.rim_order]
    if ramp:
        coefficients[:, 0, 1] += ramp
        coefficients[:, 1, 0] += ramp
        row, column = np.divmod(t.rim.cells[t.rim_order], samples)
        rim = rim + ramp * ((2.0 * (row + column) + 2.0) / samples - 2.0)
    chebyshev = np.polynomial.chebyshev.chebvander(axis, terms - 1).T
    inputs = {"pupil": coefficients.astype(dtype), "chebyshev": chebyshev.astype(dtype)}
    inputs["rim_phase"] = np.pad(rim, ((0, 0), (0, t.width))).astype(dtype)
    inputs |= {"rim": t.rim_places, "rim_light": t.rim_light if t.rim_light.size else np.zeros(4, dtype)}
    return inputs, {"TERMS": terms, "FIELD": 0}, terms * terms


def _ramp_slope(pixels: int, sampling: float) -> float:
    """Return the phase per pupil radius that puts an even number of pixels symmetric about 0."""
    return 0.5 * np.pi * sampling * (1 - pixels % 2)


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
