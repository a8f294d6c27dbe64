"""Where rays meet every element of a sequence, for drawings: the trace itself keeps the last one only."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.trace.sequence import DIVERGED, MISS, OK, Moving, Rays, Sequence
from wavequake.kernels.trace.sequential_numpy import LOST_RAYS_ARE_DATA, walk

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RayPaths:
    """Where rays go, shape (T, N).

    Attributes
    ----------
    points : tuple of ndarray, shape (K, 3, T, N), one per element
        The way to each element in the frame that the first pose starts from, mm; the last point lies on the
        element. K is 1 but where the index varies, whose steps are the points before. A ray that is stopped
        by an aperture or totally reflected ends there, one that misses the element before it; what would
        follow is NaN.
    status, surface : ndarray of int8, shape (T, N)
        As those of `TracedRays`.
    """

    points: tuple[Array, ...]
    status: NDArray[np.int8]
    surface: NDArray[np.int8]


@LOST_RAYS_ARE_DATA
def trace_paths(sequence: Sequence, rays: Rays, moving: Moving, ignore_apertures: bool = False) -> RayPaths:
    """Trace rays and keep where they meet every element; arguments as `trace_sequence_numpy`."""
    instants = len(moving.poses)
    # A point q of the frame at hand is turn q + shift in the first one.
    turn, shift = np.broadcast_to(np.eye(3), (instants, 3, 3)), np.zeros((instants, 3))
    points, trail = [], list[Array]()
    unharmed = replace(moving, spheres=None)
    before = np.zeros((instants, rays.path.size), dtype=np.bool_)
    for number, (state, _) in enumerate(walk(sequence, rays, unharmed, ignore_apertures, trail)):
        back = np.swapaxes(moving.poses[:, number, :9].reshape(-1, 3, 3), 1, 2)
        turn = turn @ back
        shift = shift - (turn @ moving.poses[:, number, 9:, None])[..., 0]
        there = np.stack([*trail, state.position])
        outside = np.einsum("tij,kjtn->kitn", turn, there) + shift.T[:, :, None]
        gone = before | ((state.surface == number) & np.isin(state.status, (MISS, DIVERGED)))
        outside[:, :, gone] = np.nan
        before = state.status != OK
        points.append(outside)
    return RayPaths(tuple(points), state.status, state.surface)
