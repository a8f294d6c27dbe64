"""Rays through a medium whose refractive index varies in space, in NumPy.

The ray equation d/ds (n dr/ds) = grad n (Störkle 2018, Eq. 3.9, A.13) becomes d²r/dt² = grad(n²) / 2 with
dt = ds / n, where dr/dt = T = n d is the optical ray vector. Steps are those of Runge, Kutta and Nyström of
fourth order in this form (Sharma, Kumar and Ghatak 1982, "Tracing rays through graded-index media: a new
method"); the optical path, the integral of n² dt, follows with the same order from values and slopes at both
ends of a step. The last step of each ray is shortened so that it ends on the surface.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.trace.sequence import Gradient

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Sag = Callable[[Array, Array], tuple[Array, Array, Array]]
"""Sag and slopes of a surface at x and y."""

_ON_SURFACE = 1e-13  # of a ray's last step, relative to the step and the distance from the origin
_MAX_CUTS = 60  # a bisection alone reaches the last bit
_DETOUR = 20.0  # a ray that takes so many times the way along the axis does not arrive
_LEAST_STEPS, _MOST_STEPS = 100, 100_000


@dataclass(frozen=True)
class Space:
    """A medium as it is seen from the frame at hand, at T instants.

    A point p of that frame is R p + s in the medium's, with ``rotation`` (T, 3, 3) and ``shift`` (T, 3).
    ``squared`` is n² at the medium's origin.
    """

    gradient: Gradient
    squared: float
    rotation: Array
    shift: Array

    def beyond(self, pose: Array) -> "Space":
        """Return the medium as seen from the next frame, to which `pose` (T, 12) leads."""
        back = np.swapaxes(pose[:, :9].reshape(-1, 3, 3), 1, 2)
        shift = self.shift - (self.rotation @ (back @ pose[:, 9:, None]))[..., 0]
        return replace(self, rotation=self.rotation @ back, shift=shift)

    def inside(self, position: Array) -> Array:
        """Return points (3, T, N) in the medium's frame."""
        return _turned(self.rotation, position) + self.shift.T[..., None]

    def outside(self, position: Array) -> Array:
        """Return points (3, T, N) of the medium's frame in the frame at hand."""
        return _turned(np.swapaxes(self.rotation, 1, 2), position - self.shift.T[..., None])


def space_of(gradient: Gradient, index: float, instants: int) -> Space:
    """Return a medium in its own frame, with the index at its origin."""
    return Space(gradient, index**2, np.broadcast_to(np.eye(3), (instants, 3, 3)), np.zeros((instants, 3)))


def local_index(space: Space, position: Array) -> Array:
    """Return the index (T, N) at points (3, T, N) of the frame at hand; NaN where it is not real."""
    return np.asarray(np.sqrt(_squared(space, space.inside(position))))


def follow(
    space: Space,
    sag: Sag,
    position: Array,
    direction: Array,
    going: Mask,
    former: Array,
    trail: list[Array] | None = None,
) -> tuple[Array, Array, Array]:
    """Follow rays inside a medium to a surface.

    Parameters
    ----------
    space : Space
        The medium, seen from the frame of the surface.
    sag : callable
        Of the surface.
    position, direction : ndarray, shape (3, T, N)
        Where the rays start, with their unit directions inside the medium.
    going : ndarray of bool, shape (T, N)
        Which rays to follow.
    former : ndarray, shape (T,)
        z of the former surface's vertex. Where it is not a step beyond this one, as where both touch or
        cross, a ray goes back to a surface that lies behind it.

    Returns
    -------
    tuple of ndarray
        Position, direction (3, T, N) and added optical path (T, N) on the surface, in its frame. A ray that
        does not meet it, or meets a place without a real index, is NaN.
    """
    ray = _Ray(space.inside(position), np.zeros_like(position), np.zeros(going.shape))
    squared = _squared(space, ray.place)
    ray = replace(ray, vector=np.sqrt(squared) * _turned(space.rotation, direction))
    step = space.gradient.step / np.sqrt(squared)
    allowed = np.ceil(_DETOUR * np.abs(position[2]) / space.gradient.step)
    allowed = np.clip(allowed, _LEAST_STEPS, _MOST_STEPS)
    going = going & np.isfinite(step) & np.isfinite(allowed)
    before, rise = _height(space, sag, ray)
    arrived = going & (before == 0.0)
    going &= ~arrived
    passed = np.where(direction[2] < 0.0, -former[:, None], former[:, None])
    # Beyond a surface that it crosses in the sense in which it crosses the vertex plane.
    is_behind = (before * rise > 0.0) & (rise * direction[2] > 0.0) & (passed < space.gradient.step)
    step = np.where(arrived, 0.0, np.where(is_behind, -step, step))
    count = 0
    while going.any():
        count += 1
        ahead = _step(space, ray, step)
        after, _ = _height(space, sag, ahead)
        crossed = going & ((before * after < 0.0) | (after == 0.0))
        arrived |= crossed
        real = np.isfinite(ahead.path) & (_squared(space, ahead.place) > 0.0)
        going &= ~crossed & real & (count < allowed)
        ray = _chosen(going, ahead, ray)
        before = np.where(going & np.isfinite(after), after, before)
        if trail is not None:
            trail.append(space.outside(ray.place))
    last = _step(space, ray, _cut(space, sag, ray, np.where(arrived, step, 0.0), before, arrived))
    path = np.where(arrived, last.path, np.nan)
    vector = _turned(np.swapaxes(space.rotation, 1, 2), last.vector)
    position = np.where(arrived, space.outside(last.place), np.nan)
    return position, np.where(arrived, vector / np.sqrt(_dot(vector, vector)), np.nan), path


@dataclass(frozen=True)
class _Ray:
    """Position and optical ray vector (3, T, N) in the medium's frame, and the optical path so far (T, N)."""

    place: Array
    vector: Array
    path: Array


def _chosen(which: Mask, one: _Ray, other: _Ray) -> _Ray:
    return _Ray(
        *(np.where(which, a, b) for a, b in zip(vars(one).values(), vars(other).values(), strict=True))
    )


def _squared(space: Space, place: Array) -> Array:
    """Return n² at points of the medium's frame."""
    return np.asarray(
        space.squared
        + _polynomial(space.gradient.radial, place[0] ** 2 + place[1] ** 2)
        + _polynomial(space.gradient.axial, place[2])
    )


def _half_gradient(space: Space, place: Array) -> Array:
    """Return grad(n²) / 2 at points of the medium's frame."""
    across = _derivative(space.gradient.radial, place[0] ** 2 + place[1] ** 2)
    along = 0.5 * _derivative(space.gradient.axial, place[2])
    return np.stack([across * place[0], across * place[1], along])


def _polynomial(coefficients: tuple[float, ...], x: Array) -> Array:
    """Return the sum of coefficients[k] x^(k + 1)."""
    total = np.zeros_like(x)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * x
    return total


def _derivative(coefficients: tuple[float, ...], x: Array) -> Array:
    total = np.zeros_like(x)
    for k in range(len(coefficients), 0, -1):
        total = total * x + k * coefficients[k - 1]
    return total


def _step(space: Space, ray: _Ray, h: Array) -> _Ray:
    """Return where rays are after a step h (mm over index) of each."""
    r, t = ray.place, ray.vector
    at_start = _half_gradient(space, r)
    a = h * at_start
    b = h * _half_gradient(space, r + h / 2.0 * t + h / 8.0 * a)
    c = h * _half_gradient(space, r + h * t + h / 2.0 * b)
    place = r + h * (t + (a + 2.0 * b) / 6.0)
    vector = t + (a + 4.0 * b + c) / 6.0
    # The trapezoidal rule with its end correction; the slope of n² along the ray is 2 T · grad(n²) / 2.
    bend = _dot(at_start, t) - _dot(_half_gradient(space, place), vector)
    mean = (_squared(space, r) + _squared(space, place)) / 2.0
    return _Ray(place, vector, ray.path + h * (mean + h * bend / 6.0))


def _height(space: Space, sag: Sag, ray: _Ray) -> tuple[Array, Array]:
    """Return how far rays are beyond the surface along its z, and how fast that grows along the ray.

    NaN where the surface does not reach out so far.
    """
    x, y, z = space.outside(ray.place)
    vector = _turned(np.swapaxes(space.rotation, 1, 2), ray.vector)
    value, slope_x, slope_y = sag(x, y)
    return z - value, vector[2] - slope_x * vector[0] - slope_y * vector[1]


def _cut(space: Space, sag: Sag, ray: _Ray, h: Array, before: Array, arrived: Mask) -> Array:
    """Return the part of a step h that ends on the surface: Newton's method, kept inside a bracket."""
    low, high, guess = np.zeros_like(h), h.copy(), h / 2.0
    side = np.sign(before)
    scale = np.abs(ray.place).max(axis=0) + np.abs(h * ray.vector).max(axis=0)
    for _ in range(_MAX_CUTS):
        height, rise = _height(space, sag, _step(space, ray, guess))
        apart = arrived & (np.abs(height) > _ON_SURFACE * scale)
        if not apart.any():
            break
        same = np.sign(height) == side
        low, high = np.where(same, guess, low), np.where(same, high, guess)
        newton = guess - height / rise
        better = np.where((newton - low) * (newton - high) < 0.0, newton, (low + high) / 2.0)
        guess = np.where(apart, better, guess)  # a ray that is there does not wait for its neighbors
    return guess


def _turned(rotation: Array, vector: Array) -> Array:
    """Return rotations (T, 3, 3) times vectors (3, T, N)."""
    return np.stack([_dot(rotation[:, i].T[..., None], vector) for i in range(3)])


def _dot(row: Array, vector: Array) -> Array:
    """Return the sum of products in a fixed order."""
    return np.asarray(row[0] * vector[0] + row[1] * vector[1] + row[2] * vector[2])
