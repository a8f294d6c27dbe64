"""Sums over the rays of many wavefronts: coefficients of fits, rms, peak to valley, Strehl ratio, spot."""

import weakref
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.device.first_batch import Pick, compare_first, is_trusted
from wavequake.kernels.device.opencl import NUMPY, Device, require_device
from wavequake.kernels.device.program import aligned_empty, device_copy, source
from wavequake.kernels.device.resident import floats_for
from wavequake.kernels.device.steps import Step, run_steps, vector_width
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.sums.ray_sums_numpy import coefficients_numpy, moments_numpy

Array = NDArray[np.float64]

# Rays that a work-item copies at a time; their values stay in the innermost cache.
_CHUNK = 128
# Instants and vectors of functions that share what is read, by the lanes of a vector: as registers allow.
_SHAPES = {8: ((12, 1), (12, 2), (8, 3), (6, 4), (5, 5), (4, 6)), 4: ((4, 2),), 2: ((4, 2),), 1: ((4, 1),)}
_LOOK = 1.4  # What reading a ray takes, as so many vectors more.
_GROUP = {"cpu": 1, "gpu": 64}
_FUNCTIONS: dict[tuple[Any, ...], tuple[weakref.ref[Array], Array]] = {}


@dataclass(frozen=True)
class RayMoments:
    """Numbers of T wavefronts and spots; NaN where all rays are lost.

    Attributes
    ----------
    arrived : ndarray of int, shape (T,)
        Rays that are not lost.
    rms_raw, rms_flat, pv : ndarray, shape (T,)
        Rms without piston, and rms and peak to valley without the plane, in the unit of the wavefront.
    strehl : ndarray, shape (T,)
        Squared modulus of the mean of exp(2 pi i OPD) without the plane.
    centroid : ndarray, shape (T, 2)
    spot_rms : ndarray, shape (T,)
        Rms distance of the image points from their centroid.
    """

    arrived: NDArray[np.int64]
    rms_raw: Array
    rms_flat: Array
    pv: Array
    strehl: Array
    centroid: Array
    spot_rms: Array


def ray_coefficients(
    matrix: Array, values: Array, device: Device = NUMPY
) -> tuple[Array, NDArray[np.integer[Any]]]:
    """Return the products (T, J) of a matrix (J, N) and values (T, N) at rays, and how many are lost (T,).

    Parameters
    ----------
    matrix : ndarray, shape (J, N)
        One that owns its numbers and cannot be written is laid out for the device only once: then it must
        never be written again, also not through views made before.
    values : ndarray, shape (T, N)
        What is not finite counts as 0, and its ray as lost.
    device : Device
        Where to run. The bits of an instant do not depend on the others.

    Raises
    ------
    UserError
        If matrix and values are not of the same rays, or the device is none.
    """
    require_device(device)
    matrix, values = np.asarray(matrix, dtype=np.float64), floats_for(device, values)
    _require("values", values, (len(values), matrix.shape[1]))
    if device.kind == "numpy" or 0 in (*matrix.shape, len(values)):
        return coefficients_numpy(matrix, values)
    count, rays = matrix.shape
    lanes, tall, wide = _shape(device, count)
    block = lanes * wide
    functions = _functions(matrix, block, device)
    terms = functions.shape[1]
    sums, lost = np.empty((len(values), terms)), np.empty(len(values), np.int32)
    numbers = (np.int32(number) for number in (len(values), rays, terms))
    size, group = (terms // block, -(-len(values) // tall), 1), _GROUP[device.kind]
    arguments = (*numbers, "functions", "values", "sums", "lost")
    step = Step(
        _text(), "coefficients", _constants(device, lanes, tall, wide), size, (group, 1, 1), arguments
    )
    inputs = {"functions": functions, "values": values}
    run_steps(device, [step], inputs, {"sums": sums, "lost": lost}, {})
    found = sums[:, :count]
    program = step.kernel, step.constants
    if not is_trusted(device, program):

        def twin(pick: Pick) -> list[Array]:
            products, missing = coefficients_numpy(matrix, values[pick])
            return [*products.T, missing.astype(np.float64)]

        compare_first(device, program, [*found.T, lost.astype(np.float64)], twin, kind="wavefronts")
    return found, lost


def ray_moments(
    opd: Array, x: Array, y: Array, weight: Array, slopes: Array, planes: Array, device: Device = NUMPY
) -> RayMoments:
    """Return what wavefronts and spots are like.

    Parameters
    ----------
    opd : ndarray, shape (T, N)
        Waves. A ray is lost where this or its image point is not finite.
    x, y : ndarray, shape (T, N)
        Image points.
    weight : ndarray, shape (N,)
        Light of each ray; positive.
    slopes : ndarray, shape (2, N)
        Two functions at the rays, of which planes are made.
    planes : ndarray, shape (T, 2)
        The plane of each instant, in multiples of the functions.
    device : Device
        Where to run. The bits of an instant do not depend on the others.

    Raises
    ------
    UserError
        If the arrays are not of the same rays and instants, or the device is none.
    """
    require_device(device)
    opd, x, y = floats_for(device, opd), floats_for(device, x), floats_for(device, y)
    weight, slopes, planes = (np.asarray(one, dtype=np.float64) for one in (weight, slopes, planes))
    instants, rays = len(opd), len(weight)
    for name, values, shape in (
        ("wavefronts", opd, (instants, rays)),
        ("places x", x, (instants, rays)),
        ("places y", y, (instants, rays)),
        ("slopes", slopes, (2, rays)),
        ("planes", planes, (instants, 2)),
    ):
        _require(name, values, shape)
    if device.kind == "numpy" or not opd.size:
        found = moments_numpy(opd, x, y, weight, slopes, planes)
    else:
        lanes, tall, wide = _shape(device)
        while lanes > rays:
            lanes //= 2
        found = np.empty((instants, 8))
        inputs: dict[str, NDArray[Any]] = {"opd": opd, "x": x, "y": y, "slopes": slopes, "planes": planes}
        inputs["weight"] = _last_in_whole_vectors(weight, lanes)
        names = ("opd", "x", "y", "weight", "slopes", "planes", "found")
        arguments = (np.int32(instants), np.int32(rays), *names)
        group = (1, _GROUP[device.kind], 1)
        step = Step(
            _text(), "moments", _constants(device, lanes, tall, wide), (1, instants, 1), group, arguments
        )
        run_steps(device, [step], inputs, {"found": found}, {})
        program = step.kernel, step.constants
        if not is_trusted(device, program):

            def twin(pick: Pick) -> list[Array]:
                return list(moments_numpy(opd[pick], x[pick], y[pick], weight, slopes, planes[pick]).T)

            compare_first(device, program, list(found.T), twin, kind="wavefronts")
    return _moments(found)


def tile_moments(
    opd: Array, x: Array, y: Array, weight: Array, slopes: Array, planes: Array, device: Device = NUMPY
) -> RayMoments:
    """Return `ray_moments` of instants that come in T tiles of 16, ray by ray.

    Parameters
    ----------
    opd, x, y : ndarray, shape (T, N, 16)
    weight : ndarray, shape (N,)
    slopes : ndarray, shape (2, N)
    planes : ndarray, shape (T, 2, 16)
    device : Device
        Where to run. The bits of an instant do not depend on the others.

    Returns
    -------
    RayMoments
        Of 16 T instants.

    Raises
    ------
    UserError
        If the arrays are not of the same rays and tiles, or the device is none.
    """
    require_device(device)
    opd, x, y = floats_for(device, opd), floats_for(device, x), floats_for(device, y)
    weight, slopes, planes = (np.asarray(one, dtype=np.float64) for one in (weight, slopes, planes))
    tiles, rays = len(opd), len(weight)
    for name, values in (("wavefronts", opd), ("places x", x), ("places y", y)):
        _require(name, values, (tiles, rays, TILE))
    _require("slopes", slopes, (2, rays))
    _require("planes", planes, (tiles, 2, TILE))

    def twin(pick: Pick) -> Array:
        light, at_x, at_y, plane = (
            np.ascontiguousarray(values[pick // TILE, :, pick % TILE]) for values in (opd, x, y, planes)
        )
        return moments_numpy(light, at_x, at_y, weight, slopes, plane)

    if device.kind == "numpy" or not opd.size:
        parts = [twin(np.arange(first, first + TILE)) for first in range(0, tiles * TILE, TILE)]
        return _moments(np.concatenate([np.empty((0, 8)), *parts]))
    found = np.empty((tiles, 8, TILE))
    lanes, tall, wide = _shape(device)
    constants = (*_constants(device, lanes, tall, wide), ("TILED", 1))
    names = ("opd", "x", "y", "weight", "slopes", "planes")
    arguments = (np.int32(tiles), np.int32(rays), *names, "found")
    step = Step(_text(), "moments", constants, (TILE // lanes, tiles, 1), (1, 1, 1), arguments)
    run_steps(
        device,
        [step],
        dict(zip(names, (opd, x, y, weight, slopes, planes), strict=True)),
        {"found": found},
        {},
    )
    instants = found.transpose(0, 2, 1).reshape(-1, 8)
    program = step.kernel, step.constants
    if not is_trusted(device, program):
        compare_first(device, program, list(instants.T), lambda pick: list(twin(pick).T), kind="wavefronts")
    return _moments(instants)


def _moments(found: Array) -> RayMoments:
    return RayMoments(
        arrived=found[:, 0].astype(np.int64),
        rms_raw=found[:, 1],
        rms_flat=found[:, 2],
        pv=found[:, 3],
        strehl=found[:, 4],
        centroid=found[:, 5:7],
        spot_rms=found[:, 7],
    )


def _functions(matrix: Array, block: int, device: Device) -> Array:
    """Return a matrix by rays, with zeros up to whole blocks of functions.

    That of a matrix which cannot be written is kept, on a GPU in its memory: making it takes a tenth of the
    time of a batch's fit.
    """
    key = (id(matrix), matrix.ctypes.data, matrix.shape, matrix.strides, block, device)
    constant = matrix.base is None and not matrix.flags.writeable
    if constant and key in _FUNCTIONS and _FUNCTIONS[key][0]() is matrix:
        return _FUNCTIONS[key][1]
    count, rays = matrix.shape
    functions = aligned_empty((rays, -(-count // block) * block))  # no vector of it crosses a cache line
    functions[:, :count] = matrix.T
    functions[:, count:] = 0.0
    if constant:
        functions = device_copy(device, functions)
        _FUNCTIONS[key] = weakref.ref(matrix, lambda _: _FUNCTIONS.pop(key, None)), functions
    return functions


def _require(name: str, values: Array, shape: tuple[int, ...]) -> None:
    """Raise UserError unless values have the shape: a kernel would read beyond them."""
    if values.shape != shape:
        raise UserError(f"{name} of the rays have the shape {values.shape}; it must be {shape}")


def _last_in_whole_vectors(weight: Array, lanes: int) -> Array:
    """Return weights for groups of lanes; the last ends with the last ray: what is in two weighs once."""
    rest = len(weight) % lanes
    if not rest:
        return weight
    whole = len(weight) - rest
    return np.concatenate([weight[:whole], np.zeros(lanes - rest), weight[whole:]])


def _shape(device: Device, functions: int = 1) -> tuple[int, int, int]:
    """Return lanes, instants and vectors of functions of a work-item, as suits this many functions."""
    lanes = min(8, vector_width(device, np.dtype(np.float64), long=True))
    vectors = -(-functions // lanes)
    return lanes, *min(_SHAPES[lanes], key=lambda shape: -(-vectors // shape[1]) * (shape[1] + _LOOK))


def _constants(device: Device, lanes: int, tall: int, wide: int) -> tuple[tuple[str, int], ...]:
    numbers = {"W": lanes, "SINGLE": 0, "TALL": tall, "WIDE": wide, "CHUNK": _CHUNK}
    return tuple((numbers | {"SHARED": int(device.kind == "gpu")}).items())


@lru_cache(maxsize=1)
def _text() -> str:
    return source("ray_sums.cl")
