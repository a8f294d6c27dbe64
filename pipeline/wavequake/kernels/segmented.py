"""Trace rays through a segmented telescope, every instant of a batch in one launch."""

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.devices import Device
from wavequake.kernels.segmented_numpy import trace_chief, trace_segmented_numpy
from wavequake.kernels.train import SegmentedTrain, Traced, check_rays

__all__ = ["SegmentedTrain", "Traced", "trace_chief", "trace_segmented"]

Array = NDArray[np.float64]


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
        terms u^n, u^(n-1) v, ..., v^n; added to the conic's sag along z.
    surface_poses : ndarray, shape (T, L, 12, 16)
        The same from the previous surface's frame (first: the optics frame) to each surface's.
    directions : ndarray, shape (T, 3, 16)
        Unit directions of the incoming light; optical path lengths count from the plane wavefront through the
        origin.
    chief : ndarray, shape (T, 3, 16)
        Image x, y of the reference sphere's center and the chief ray's path length to the sphere (see
        `trace_chief`).
    device : Device
        Where to run (see `wavequake.kernels.devices`).

    Returns
    -------
    Traced
        OPD, image position and status of every ray and instant.

    Raises
    ------
    ValueError
        If shapes do not fit together or a candidate is not a segment.
    """
    check_rays(train, ray_x, ray_y, candidates, segment_poses, figure, surface_poses, directions, chief)
    arguments = (
        train,
        ray_x,
        ray_y,
        start_z,
        candidates,
        segment_poses,
        figure,
        surface_poses,
        directions,
        chief,
    )
    if device.kind == "numpy":
        return trace_segmented_numpy(*arguments)
    raise NotImplementedError
