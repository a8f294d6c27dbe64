"""Images of segments with pistons and slopes by a device, a tile of 16 instants at a time.

The NumPy twin is `wavequake.imaging.engines.segment_psf.psf`, whose products BLAS makes. A GPU is sent the
phases alone, and the images come back. On a processor the lanes of vectors are instants, and the matrix lies
as its product reads it: BLAS would lay it out anew for each tile.
"""

import weakref
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.first_batch import Pick, compare_first, is_trusted
from wavequake.kernels.device.opencl import Device
from wavequake.kernels.device.program import aligned_empty, device_copy, source
from wavequake.kernels.device.steps import Step, run_steps, vector_width
from wavequake.kernels.device.tiles import TILE

Real = NDArray[np.float64]
Floating = NDArray[np.float32] | NDArray[np.float64]

# Sums over terms are parted among so many work-groups; the bits of an image depend on their number.
_SPLITS = 8
_TALL, _EACH = 32, 4
# Nodes of a processor's work-item, by its lanes: as many sums as registers hold.
_PROCESSOR_TALL = {16: 12, 8: 3, 4: 1}
# By how much images may differ from NumPy's, relative to the perfect peak.
_TOLERANCE = {"float32": 1e-5, "float64": 1e-11}
_KEPT: dict[tuple[int, int, Device | int], tuple[weakref.ref[Any], Any]] = {}


def segment_images(
    device: Device,
    phase: Real,
    matrix: Floating,
    interpolation: Floating,
    twins: NDArray[np.intp],
    shares: Real,
    powers: NDArray[np.intp],
    scale: float,
    peak: float,
    twin: Callable[[], Floating],
) -> Floating:
    """Return the images of a tile, relative to the perfect peak.

    Parameters
    ----------
    device : Device
        An OpenCL device.
    phase : ndarray, shape (16, S, 3)
        Piston in waves, slopes in waves per mm.
    matrix : ndarray, shape (4, Q, K), float32 or float64
        Of `wavequake.imaging.engines.segment_basis.SegmentBasis`, with the moments that are taken or more.
    interpolation : ndarray, shape (pixels, M)
    twins, shares : ndarray, shape (4, R)
    powers : ndarray of int, shape (J, 2)
        Powers of x and y of the moments that are taken.
    scale, peak : float
        As the basis has them.
    twin : callable
        Returns the same images by NumPy, with which the first ones are compared.

    Returns
    -------
    ndarray, shape (16, pixels²), of the matrix's precision

    Raises
    ------
    UserError
        If the device has not enough memory or computes something else.
    """
    pixels, nodes = interpolation.shape
    sets, moments, dtype = twins.shape[1], len(powers), matrix.dtype
    quarter, folded = matrix.shape[1], 4 if shares[1:].any() else 1
    if device.kind == "cpu":
        return _by_processor(device, phase, matrix, interpolation, twins, shares, powers, scale, peak, twin)
    constants = {"W": 1, "SINGLE": int(dtype == np.float32), "SEGMENTS": phase.shape[1], "TWINS": sets}
    constants |= {"FOLDED": folded, "MOMENTS": moments, "HALF": nodes // 2, "PIXELS": pixels}
    names = tuple((constants | {"SPLITS": _SPLITS}).items())

    def step(kernel: str, size: tuple[int, int, int], group: tuple[int, int, int], *arguments: Any) -> Step:
        return Step(_text(), kernel, names, size, group, arguments)

    columns = 2 * TILE
    blocks = -(-quarter // _TALL) * (_TALL // _EACH)
    steps = [
        step(
            "fold_segments", (TILE, sets, 1), (TILE, 8, 1),
            *(np.float64(peak), np.float64(scale), "phase", "twins", "shares", "powers", "folded"),
        ),
        step(
            "add_segments", (columns, blocks, 4 * _SPLITS), (columns, _TALL // _EACH, 1),
            *("matrix", "folded", "sums"),
        ),
        step("unfold_field", (TILE, quarter, 1), (TILE, 8, 1), "sums", "field"),
        step("spread_rows", (columns, nodes, pixels), (columns, 4, 1), "across", "field", "rows"),
        step("square_pixels", (TILE, pixels, pixels), (TILE, 8, 1), "across", "rows", "images"),
    ]  # fmt: skip
    inputs = {
        "phase": phase,
        "twins": twins.astype(np.int32),
        "shares": shares,
        "powers": np.asarray(powers, np.int32),
        "matrix": _there(device, matrix, moments * sets),
        "across": _there(device, interpolation, nodes),
    }
    numbers = {"folded": folded * moments * sets, "sums": _SPLITS * 4 * quarter, "field": nodes * nodes}
    numbers["rows"] = pixels * nodes
    scratch = {name: count * columns * dtype.itemsize for name, count in numbers.items()}
    images = np.empty((TILE, pixels * pixels), dtype)
    run_steps(device, steps, inputs, {"images": images}, scratch)
    _compare(device, ("segment images", names), images, twin)
    return images


def _by_processor(
    device: Device,
    phase: Real,
    matrix: Floating,
    interpolation: Floating,
    twins: NDArray[np.intp],
    shares: Real,
    powers: NDArray[np.intp],
    scale: float,
    peak: float,
    twin: Callable[[], Floating],
) -> Floating:
    """Return the images of a tile in single precision; arguments as `segment_images`."""
    pixels, nodes = interpolation.shape
    sets, quarter, folded = twins.shape[1], matrix.shape[1], 4 if shares[1:].any() else 1
    lanes = max(4, min(TILE, vector_width(device, np.dtype(np.float32), long=True)))
    tall = _PROCESSOR_TALL[lanes]
    constants = {"W": lanes, "SINGLE": 1, "SEGMENTS": phase.shape[1], "TWINS": sets, "FOLDED": folded}
    constants |= {"MOMENTS": len(powers), "DEGREE": int(powers.sum(axis=1).max()), "HALF": nodes // 2}
    names = tuple((constants | {"PIXELS": pixels, "TALL": tall}).items())

    def step(kernel: str, along: int, across: int, *arguments: Any) -> Step:
        return Step(_text(), kernel, names, (along, across, 1), (1, 1, 1), arguments)

    blocks = -(-pixels // tall)
    steps = [
        step("fold_segments", TILE // lanes, sets, "phase", "twins", "shares", "folded"),
        step("add_segments", -(-quarter // tall), 4, "matrix", "folded", "sums"),
        step("unfold_field", nodes // 2, nodes // 2, "sums", "field"),
        step("spread_rows", nodes, blocks, "across", "field", "rows"),
        step("square_pixels", blocks, pixels, "across", "rows", "images"),
    ]
    moved = phase.transpose(2, 1, 0) * (2.0 * np.pi * np.array([1.0, scale, scale]))[:, None, None]
    moved[0] = 2.0 * np.pi * (phase[..., 0] - np.rint(phase[..., 0])).T
    inputs = {
        "phase": moved.astype(np.float32),
        "twins": twins.astype(np.int32),
        "shares": (shares / peak).astype(np.float32),
        "matrix": _in_blocks(matrix, len(powers) * sets, tall),
        "across": _in_blocks(interpolation, nodes, tall),
    }
    numbers = {"folded": folded * len(powers) * sets, "sums": 4 * quarter, "field": nodes * nodes}
    numbers["rows"] = pixels * nodes
    scratch = {name: count * 2 * TILE * 4 for name, count in numbers.items()}
    found = aligned_empty((pixels * pixels, TILE), np.float32)
    run_steps(device, steps, inputs, {"images": found}, scratch)
    images = np.ascontiguousarray(found.T)
    _compare(device, ("segment images", names), images, twin)
    return images


def _in_blocks(array: Floating, last: int, tall: int) -> Any:
    """Return the first `last` numbers K of rows (..., Q, K) as (..., Q / tall, K, tall), kept as `_there`.

    Rows beyond the last are zeros.
    """

    def make() -> Floating:
        rows = -(-array.shape[-2] // tall) * tall
        padded = np.zeros((*array.shape[:-2], rows, last), array.dtype)
        padded[..., : array.shape[-2], :] = array[..., :last]
        blocks = padded.reshape(*array.shape[:-2], -1, tall, last).swapaxes(-1, -2)
        laid_out = aligned_empty(blocks.shape, array.dtype)
        laid_out[...] = blocks
        return laid_out

    return _kept((id(array), last, tall), array, make)


def _compare(device: Device, program: Any, images: Floating, twin: Callable[[], Floating]) -> None:
    """Compare a program's first images with those by NumPy."""
    if not is_trusted(device, program):
        expected = twin()

        def same(pick: Pick) -> list[Real]:
            return list(expected[:, pick].astype(np.float64))

        found = list(images.astype(np.float64))
        tolerance = _TOLERANCE[images.dtype.name]
        compare_first(device, program, found, same, kind="pixels", tolerance=tolerance)


def _there(device: Device, array: Floating, last: int) -> Any:
    """Return the first `last` numbers of each row on the device, which keeps them while the array lives."""
    return _kept(
        (id(array), last, device),
        array,
        lambda: device_copy(device, np.ascontiguousarray(array[..., :last])),
    )


def _kept(key: tuple[int, int, Device | int], array: Floating, make: Callable[[], Any]) -> Any:
    """Return what was made of an array, as long as that lives."""
    kept = _KEPT.get(key)
    if kept is None or kept[0]() is not array:
        kept = weakref.ref(array, lambda _: _KEPT.pop(key, None)), make()
        _KEPT[key] = kept
    return kept[1]


@lru_cache(maxsize=1)
def _text() -> str:
    return source("segment_images.cl")
