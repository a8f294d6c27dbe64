"""Trace rays through a segmented telescope, every instant of a batch in one launch."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.device.first_batch import COPIES, Pick, compare_rays, is_trusted, shaken
from wavequake.kernels.device.opencl import Device
from wavequake.kernels.device.program import aligned_empty, device_empty, launch
from wavequake.kernels.device.steps import vector_width
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.figure_limits import train_limits
from wavequake.kernels.trace.ring import ring_steps
from wavequake.kernels.trace.segmented_numpy import trace_chief, trace_segmented_numpy
from wavequake.kernels.trace.sequence import Basis
from wavequake.kernels.trace.train import SegmentedTrain, Traced, check_rays

__all__ = ["SegmentedTrain", "Traced", "trace_chief", "trace_segmented"]

Array = NDArray[np.float64]

# What one launch may write: it bounds the memory that is taken on a GPU, where a trace of no more stays.
_LAUNCH_BYTES = 128 << 20
# Rays of a work-item where a vector holds a tile: one hides the other's waiting, and rays that try the same
# segment share what belongs to it.
_RAYS = 2


def trace_segmented(
    train: SegmentedTrain,
    ray_x: Array,
    ray_y: Array,
    start_z: float,
    candidates: NDArray[np.int32],
    segment_poses: Array,
    figure: Array | None,
    surface_poses: Array,
    directions: Array,
    chief: Array,
    device: Device,
    mirror_figure: Array | None = None,
) -> Traced:
    """Trace N rays at T tiles of 16 instants: M1's segments, L surfaces, image plane, reference sphere.

    Parameters
    ----------
    train : SegmentedTrain
        What does not move.
    ray_x, ray_y : ndarray, shape (N,)
        Where the rays start, mm, in the plane z = `start_z` of the optics frame of M1.
    start_z : float
        Plane of the stop, mm.
    candidates : ndarray of int32, shape (N, C)
        Segments that a ray may hit, tried in order; -1 for none.
    segment_poses : ndarray, shape (T, S, 12, 16)
        q = A p + o from the optics frame to the displaced segment's parent frame: A (a rotation) row by row,
        then o in mm.
    figure : ndarray, shape (T, S, M, 16), or None
        Coefficients of the figure polynomial in u and v, mm, in total-degree order: for n = 0..degree the
        terms u^n, u^(n-1) v, ..., v^n (on a ring: in that of `wavequake.kernels.trace.ring.ring_order`);
        added to the conic's sag along z.
    surface_poses : ndarray, shape (T, L, 12, 16)
        The same from the previous surface's frame (first: the optics frame) to each surface's.
    directions : ndarray, shape (T, 3, 16)
        Unit directions of the incoming light; optical path lengths count from the plane wavefront through the
        origin.
    chief : ndarray, shape (T, 3, 16)
        Image x, y of the reference sphere's center and the chief ray's path length to the sphere (see
        `trace_chief`).
    device : Device
        Where to run (see `wavequake.kernels.device.devices`).
    mirror_figure : ndarray, shape (T, L - 1, M, 16), optional
        Figures of the mirrors after M1, as `figure`: heights along the z axis of each surface's frame.

    Returns
    -------
    Traced
        OPD, image position and status of every ray and instant.

    Raises
    ------
    ValueError
        If shapes do not fit together or a candidate is not a segment.
    """
    moving = (segment_poses, figure, surface_poses, mirror_figure, directions, chief)
    check_rays(
        train,
        ray_x,
        ray_y,
        candidates,
        segment_poses,
        figure,
        surface_poses,
        directions,
        chief,
        mirror_figure,
    )
    rays = (ray_x, ray_y, start_z, candidates)
    if device.kind == "numpy":
        return trace_segmented_numpy(
            train, *rays, segment_poses, figure, surface_poses, mirror_figure, directions, chief
        )
    shape = (segment_poses.shape[0], ray_x.size, TILE)
    tiles = max(1, _LAUNCH_BYTES // (25 * TILE * max(1, ray_x.size)))
    stays = shape[0] <= tiles
    outputs: list[NDArray[Any]] = [
        device_empty(device, shape, dtype) if stays else aligned_empty(shape, dtype)
        for dtype in (np.float64, np.float64, np.float64, np.int8)
    ]
    for first in range(0, shape[0], tiles):
        part = slice(first, first + tiles)
        inputs = [None if array is None else array[part] for array in moving]
        there = outputs if stays else [array[part] for array in outputs]
        _launch(device, train, rays, inputs, there)
    return Traced(*outputs)


def _launch(
    device: Device,
    train: SegmentedTrain,
    rays: tuple[Array, Array, float, NDArray[np.int32]],
    moving: list[Array | None],
    outputs: list[NDArray[Any]],
) -> None:
    """Run the kernel once, over the tiles of `moving` and `outputs`."""
    ray_x, ray_y, start_z, candidates = rays
    tiles, count, _ = outputs[0].shape
    segments, edges, numbers = train.edges.shape
    lanes = _lanes(device)
    group = max(1, min(count, _RAYS)) if lanes == TILE else 1
    limits = train_limits(train, *(moving[k] for k in (0, 1, 3, 4)))  # type: ignore[arg-type]
    constants = {
        "W": lanes,
        "RAYS": group,
        "EDGES": edges,
        "CONVEX": int(numbers == 3),
        "DEGREE": train.figure_degree,
        "SEGMENT_RING": int(train.figure_basis != "monomial"),
        "SURFACES": train.surface_curvatures.size,
        "MIRROR_DEGREE": train.mirror_degree,
        "MIRROR_RING": int(train.mirror_basis != "monomial"),
        "SEGMENT_CHECKED": int(limits[0] is not None),
        "MIRROR_CHECKED": int(limits[1] is not None),
        "EDGED": sum(1 << i for i, square in enumerate(train.clear_squares) if np.isfinite(square)),
        "PLANES": sum(1 << i for i, curvature in enumerate(train.surface_curvatures) if curvature == 0.0),
        "REFRACTS": sum(1 << i for i, refracts in enumerate(train.refracts) if refracts),
    }
    inputs = [
        *(np.int32(number) for number in (count, segments, candidates.shape[1])),
        *(np.float64(number) for number in (start_z, train.primary_curvature, 1.0 + train.primary_conic)),
        np.float64(train.sphere_radius),
        *(ray_x, ray_y, candidates, train.edges, train.figure_frames),
        *(train.surface_curvatures, 1.0 + train.surface_conics, train.clear_squares),
        *(train.indices_before, train.mirror_frames),
        _steps(train.figure_degree, train.figure_basis),
        _steps(train.mirror_degree, train.mirror_basis),
        *limits,
        *moving,
    ]
    size = (TILE // lanes, -(-count // group), tiles)
    launch(device, "segmented", tuple(constants.items()), size, inputs, outputs)

    program = ("segmented", *constants.values())
    if count and not is_trusted(device, program):

        def twin(pick: Pick) -> list[Array]:
            now = [None if a is None else np.broadcast_to(a[0], (COPIES, *a.shape[1:])) for a in moving]
            for poses in (0, 2):
                now[poses] = shaken(now[poses][0], abs(train.sphere_radius))  # type: ignore[index]
            chosen = (ray_x[pick], ray_y[pick], start_z, candidates[pick])
            traced = trace_segmented_numpy(train, *chosen, *now)  # type: ignore[arg-type]
            return [traced.opd, traced.x, traced.y]

        compare_rays(device, program, [values[0] for values in outputs[:3]], twin, abs(train.sphere_radius))


def _steps(degree: int, basis: Basis) -> Array | None:
    """Return what the recurrences of figures take."""
    return None if basis == "monomial" or degree < 0 else np.array(ring_steps(degree, basis.inner))


def _lanes(device: Device) -> int:
    """Return the instants of one vector: on a CPU two registers of them, as its latencies ask for."""
    if device.kind == "gpu":
        return 1
    return max(4, min(TILE, 2 * vector_width(device, np.dtype(np.float64), long=True)))
