"""Trace rays through any sequence of surfaces, every instant of a batch in one launch."""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.first_batch import COPIES, Pick, compare_rays, is_trusted, shaken
from wavequake.kernels.device.opencl import Device, require_device
from wavequake.kernels.device.program import aligned_empties, device_empties, launch
from wavequake.kernels.device.steps import vector_width
from wavequake.kernels.trace.packing import Layout, packed_elements
from wavequake.kernels.trace.sequence import Moving, Rays, Sequence, TracedRays, check_sequence
from wavequake.kernels.trace.sequential_numpy import moving_part, trace_sequence_numpy
from wavequake.kernels.trace.sequential_source import OUTPUTS, kernel_source

Array = NDArray[np.float64]

# What one launch may write: it bounds the memory that is taken on a GPU, where a trace of no more stays.
_LAUNCH_BYTES = 256 << 20
# Rays of a group of work-items. One size for all launches: PoCL compiles a kernel again for each new one.
_GROUP_RAYS = {"cpu": 2000, "gpu": 64}
# Vectors of rays that a work-item traces in turns, surface by surface, so that one hides the other's waiting.
_TURNS = {"cpu": 2, "gpu": 1}

_NOTHING: dict[str, NDArray[Any]] = dict.fromkeys(OUTPUTS, np.zeros((0, 0)))


def trace_sequence(
    sequence: Sequence,
    rays: Rays,
    moving: Moving,
    device: Device,
    ignore_apertures: bool = False,
    outputs: tuple[str, ...] = OUTPUTS,
    out: TracedRays | None = None,
) -> TracedRays:
    """Trace N rays at T instants through L elements, and to the reference sphere if there is one.

    Parameters
    ----------
    sequence : Sequence
        What does not move.
    rays : Rays
        Where the rays start, the same at all instants. A direction or path that is a view of one value
        (`numpy.broadcast_to`) is read once instead of for every ray.
    moving : Moving
        Poses, deformations and reference spheres of every instant.
    device : Device
        Where to run (see `wavequake.kernels.device.devices`).
    ignore_apertures : bool
        Whether rays pass outside the openings too, as a virtual chief ray does.
    outputs : tuple of str
        Which of path, x, y, u, v, w_sign are wanted; the others are empty. Status and surface always come.
    out : TracedRays, optional
        An earlier result of the same shape and outputs, whose arrays are overwritten: new memory takes a
        third of the time of a large trace.

    Returns
    -------
    TracedRays
        Path length, place and direction of every ray and instant, shape (T, N), in the frame of the last
        element; a lost ray is NaN, and its status and surface say why and where.

    Raises
    ------
    UserError
        If a surface has coefficients that are not finite, or the device is none.
    ValueError
        If shapes do not fit together, or an output is unknown.
    """
    require_device(device)
    check_sequence(sequence, rays, moving)
    if not set(outputs) <= set(OUTPUTS):
        raise ValueError(f"outputs are {outputs}; they must be among {OUTPUTS}")
    outputs = tuple(name for name in OUTPUTS if name in outputs)
    if device.kind == "numpy":
        traced = trace_sequence_numpy(sequence, rays, moving, ignore_apertures)
        chosen = {name: getattr(traced, name) for name in outputs}
        return _traced(chosen | {"status": traced.status, "surface": traced.surface}, traced.elements)
    return _trace_opencl(sequence, rays, moving, device, ignore_apertures, outputs, out)


def launches_of(rays: Rays, moving: Moving, outputs: tuple[str, ...]) -> list[tuple[slice, Moving]]:
    """Return which instants are traced at once; what more than one launch writes does not stay on a GPU."""
    each = max(1, _LAUNCH_BYTES // (max(1, rays.path.size) * (8 * len(outputs) + 2)))
    instants = len(moving.poses)
    if instants <= each:
        return [(slice(0, instants), moving)]
    parts = [slice(first, first + each) for first in range(0, instants, each)]
    return [(part, moving_part(moving, part)) for part in parts]


def _trace_opencl(
    sequence: Sequence,
    rays: Rays,
    moving: Moving,
    device: Device,
    ignore_apertures: bool,
    outputs: tuple[str, ...],
    out: TracedRays | None,
) -> TracedRays:
    count, width = rays.path.size, _lanes(device) * _TURNS[device.kind]
    if 0 < count < width:
        whole = _trace_opencl(
            sequence, _repeated(rays, width), moving, device, ignore_apertures, outputs, None
        )
        names = (*outputs, "status", "surface")
        return _traced({name: getattr(whole, name)[:, :count].copy() for name in names}, whole.elements)
    shape = (len(moving.poses), count)
    if out is not None and any(getattr(out, name).shape != shape for name in (*outputs, "status", "surface")):
        raise ValueError(f"out must hold {', '.join(outputs)}, status and surface of the shape {shape}")
    parts = launches_of(rays, moving, outputs)
    stays, names = len(parts) == 1, (*outputs, "status", "surface")
    if out is None:
        dtypes = [np.float64 if name in OUTPUTS[:5] else np.int8 for name in names]
        arrays = device_empties(device, shape, dtypes) if stays else aligned_empties(shape, dtypes)
    else:
        arrays = [getattr(out, name) for name in names]
        arrays = arrays if device.kind == "gpu" else [np.asarray(array) for array in arrays]
    results = dict(zip(names, arrays, strict=True))
    for part, now in parts:
        there = results if stays else {name: np.asarray(array)[part] for name, array in results.items()}
        _launch(sequence, rays, now, device, ignore_apertures, there)
    return _traced(results, len(sequence.elements))


def _launch(
    sequence: Sequence,
    rays: Rays,
    moving: Moving,
    device: Device,
    ignore_apertures: bool,
    results: dict[str, NDArray[Any]],
) -> None:
    """Run the kernel once, over all instants of `moving`."""
    layout, limits, parts = packed_elements(sequence, moving, ignore_apertures)
    direction, one_direction = _once(rays.direction)
    path, one_path = _once(rays.path)
    outputs = tuple(name for name in results if name in OUTPUTS)
    lanes, turns = _lanes(device), _TURNS[device.kind]
    text = _text(layout, one_direction, one_path, moving.spheres is not None, outputs, turns)
    count, width = rays.path.size, lanes * turns
    launch(
        device,
        "sequential",
        (("W", lanes),),
        (1, -(-count // width), len(moving.poses)),
        [
            np.int32(count),
            layout.numbers,
            rays.position,
            direction,
            path,
            moving.poses,
            limits,
            moving.spheres,
            *parts,
        ],
        list(results.values()),
        text,
        -(-_GROUP_RAYS[device.kind] // width),
    )

    if count and len(moving.poses) and not is_trusted(device, text):
        found = {name: results[name][0] for name in outputs if name != "w_sign"}
        length = float(np.abs(moving.poses[0, :, 9:]).max(initial=0.0))

        def twin(pick: Pick) -> list[Array]:
            chosen = Rays(rays.position[:, pick], rays.direction[:, pick], rays.path[pick])
            now = moving_part(moving, np.zeros(COPIES, dtype=np.intp))
            now = replace(now, poses=shaken(moving.poses[0], length))
            traced = trace_sequence_numpy(sequence, chosen, now, ignore_apertures)
            return [getattr(traced, name) for name in found]

        compare_rays(device, text, list(found.values()), twin, length)


@lru_cache(maxsize=256)
def _text(
    layout: Layout, one_direction: bool, one_path: bool, sphere: bool, outputs: tuple[str, ...], turns: int
) -> str:
    """Return the kernel's text; a layout is found faster than its shapes are compared."""
    return kernel_source(layout.shapes, one_direction, one_path, sphere, outputs, turns)


@lru_cache(maxsize=8)
def _lanes(device: Device) -> int:
    """Return the rays of one vector: on a CPU two registers of them, as its latencies ask for."""
    return (
        1
        if device.kind == "gpu"
        else max(4, min(16, 2 * vector_width(device, np.dtype(np.float64), long=True)))
    )


def _once(values: Array) -> tuple[Array, bool]:
    """Return one of the values if all rays share it by being a view of one, else all; and which it is."""
    single = values.shape[-1] > 1 and values.strides[-1] == 0
    return (values[..., 0], True) if single else (values, False)


def _repeated(rays: Rays, width: int) -> Rays:
    """Return `width` rays: those given, again and again."""
    pick = np.arange(width) % rays.path.size
    return Rays(rays.position[:, pick], rays.direction[:, pick], rays.path[pick])


def _traced(results: dict[str, NDArray[Any]], elements: int) -> TracedRays:
    return TracedRays(**_NOTHING | results, elements=elements)
