"""Where rays meet the stop: the map that aiming inverts, its slopes, and Newton's iteration."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.trace.sequence import Moving, Rays, Sequence
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.derivatives.central import gradient

Array = NDArray[np.float64]

AIMED = 1e-9  # largest distance from the point of the stop that is aimed at, mm
_STEPS = 30
_HALVINGS = 10


@dataclass(frozen=True)
class Bundle:
    """The rays of a field point by two numbers each: where they cross a plane, or their slopes.

    ``origin`` (3,) is a point of that plane or the object point, ``direction`` (3,) that of all rays of an
    infinitely far object or None, ``reference`` (3,) where the wave of such an object has the phase 0. The
    plane is upright to the axis, or has the axes ``across`` (3, 2).
    """

    origin: Array
    direction: Array | None
    reference: Array
    index: float
    across: Array | None = None

    def rays(self, numbers: Array) -> Rays:
        """Return the rays of the numbers (2, N)."""
        flat = np.concatenate([numbers, np.zeros((1, numbers.shape[1]))])
        if self.direction is None:
            direction = flat + np.array([[0.0], [0.0], [1.0]])
            direction /= np.sqrt(np.sum(direction**2, axis=0))
            position = np.broadcast_to(self.origin[:, None], direction.shape).copy()
            return Rays(position, direction, np.zeros(numbers.shape[1]))
        position = (flat if self.across is None else self.across @ numbers) + self.origin[:, None]
        direction = np.broadcast_to(self.direction[:, None], position.shape).copy()
        path = self.index * (self.direction @ (position - self.reference[:, None]))
        return Rays(position, direction, path)


def axes_across(direction: Array) -> Array:
    """Return two axes (3, 2) at right angles to a direction: x and y, turned as z turns to it."""
    x, y, z = direction
    share = 1.0 / (1.0 + z) if z > -1.0 else 0.0
    return np.array([[1.0 - share * x * x, -share * x * y], [-share * x * y, 1.0 - share * y * y], [-x, -y]])


@dataclass(frozen=True)
class Aim:
    """The map from the numbers of rays to where they meet the stop."""

    sequence: Sequence
    poses: Moving
    bundle: Bundle
    difference: float

    def meet(self, numbers: Array) -> Array:
        """Return x and y on the stop (2, N), NaN for lost rays."""
        traced = trace_sequence_numpy(self.sequence, self.bundle.rays(numbers), self.poses, True)
        return np.concatenate([traced.x, traced.y])

    def meet_with_slopes(self, numbers: Array) -> tuple[Array, Array]:
        """Return x and y on the stop (2, N) and their derivatives (N, 2, 2).

        Central differences, or one-sided ones where the other neighbor is lost.
        """
        steps = np.array([[0.0, 1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0, -1.0]]) * self.difference
        probes = (numbers[:, None, :] + steps[:, :, None]).reshape(2, -1)
        met = self.meet(probes).reshape(2, 5, -1)
        slopes = gradient(np.moveaxis(met[:, 1:], 1, 0), self.difference)
        for axis in (0, 1):
            for probe, side in ((1, self.difference), (2, -self.difference)):
                at_edge = (met[:, 2 * axis + probe] - met[:, 0]) / side
                slopes[..., axis] = np.where(np.isnan(slopes[..., axis]), at_edge, slopes[..., axis])
        return met[:, 0], slopes.transpose(1, 0, 2)


def newton(aim: Aim, numbers: Array, target: Array, safe: Array | None = None) -> Array:
    """Return numbers whose rays meet the target (2, N); a step that loses a ray is halved."""
    if safe is None:
        numbers, (met, slopes) = numbers.copy(), aim.meet_with_slopes(numbers)
    else:
        numbers, met, slopes = _recovered(aim, np.broadcast_to(safe, numbers.shape), numbers)
    active = np.arange(numbers.shape[1])
    for _ in range(_STEPS):
        miss = target[:, active] - met
        going = (np.max(np.abs(miss), axis=0) > 0.1 * AIMED) & np.isfinite(slopes).all(axis=(1, 2))
        going &= determinant(slopes) != 0.0
        if not going.any():
            break
        active, now = active[going], numbers[:, active[going]]
        there = now + solved(slopes[going], miss[:, going])
        numbers[:, active], met, slopes = _recovered(aim, now, there)
    return numbers


def determinant(slopes: Array) -> Array:
    """Return the determinants (N,) of matrices (N, 2, 2)."""
    return np.asarray(slopes[:, 0, 0] * slopes[:, 1, 1] - slopes[:, 0, 1] * slopes[:, 1, 0])


def solved(slopes: Array, right: Array) -> Array:
    """Return the solutions (2, N) of N systems, each by itself: a ray's bits do not depend on the others."""
    x = slopes[:, 1, 1] * right[0] - slopes[:, 0, 1] * right[1]
    y = slopes[:, 0, 0] * right[1] - slopes[:, 1, 0] * right[0]
    return np.stack([x, y]) / determinant(slopes)


def _recovered(aim: Aim, good: Array, numbers: Array) -> tuple[Array, Array, Array]:
    """Return numbers, or points half way, a quarter of the way ... from good ones, that reach the stop.

    And where they meet it (2, N), with slopes (N, 2, 2).
    """
    numbers, (met, slopes) = numbers.copy(), aim.meet_with_slopes(numbers)
    lost = np.flatnonzero(~np.isfinite(met).all(axis=0))
    for _ in range(_HALVINGS if lost.size else 0):
        numbers[:, lost] = 0.5 * (good[:, lost] + numbers[:, lost])
        met[:, lost], slopes[lost] = aim.meet_with_slopes(numbers[:, lost])
        lost = lost[~np.isfinite(met[:, lost]).all(axis=0)]
        if not lost.size:
            break
    return numbers, met, slopes
