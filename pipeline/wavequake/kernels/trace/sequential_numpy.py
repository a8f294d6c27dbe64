"""The NumPy twin of the sequential trace: the oracle of the OpenCL kernel, and what runs without OpenCL.

Unit directions, explicit sag and slopes, Newton's iteration to convergence: the kernel shares none of this
algebra. A ray that has converged is left alone, so its bits do not depend on its neighbors.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.trace.forms_numpy import form_heights
from wavequake.kernels.trace.gradient_numpy import Space, follow, local_index, space_of
from wavequake.kernels.trace.grid_numpy import spline_grid
from wavequake.kernels.trace.phases_numpy import diffracted, focused
from wavequake.kernels.trace.polynomial_numpy import polynomial
from wavequake.kernels.trace.sequence import Element, Focus, Moving, Rays, Region, Sequence, TracedRays
from wavequake.kernels.trace.status import DIVERGED, MISS, NO_ORDER, OK, TOTAL_REFLECTION, VIGNETTED
from wavequake.kernels.trace.surfaces import (
    conic_path,
    conic_sag_and_slopes,
    conic_slopes,
    even_sag_and_slopes,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A step of Newton's iteration that short leaves an error far below rounding, since it squares with each step.
CONVERGED = 1e-9
NEWTON_STEPS = 30
# Rays of all instants that are traced together; it bounds the memory.
_CHUNK = 1 << 17
LOST_RAYS_ARE_DATA = np.errstate(invalid="ignore", divide="ignore", over="ignore")


@dataclass
class State:
    """Rays (t, N) on their way, in the frame of the element at hand; position and direction (3, t, N)."""

    position: Array
    direction: Array
    path: Array
    status: NDArray[np.int8]
    surface: NDArray[np.int8]

    def lose(self, lost: Mask, why: int, where: int) -> None:
        """Mark rays that are lost here, unless they were lost before."""
        lost = lost & (self.status == OK)
        self.status[lost] = why
        self.surface[lost] = where


def trace_sequence_numpy(
    sequence: Sequence, rays: Rays, moving: Moving, ignore_apertures: bool = False
) -> TracedRays:
    """Trace every ray of every instant; arguments as `wavequake.kernels.trace.sequential.trace_sequence`."""
    instants, count = moving.poses.shape[0], rays.path.size
    out: list[NDArray[Any]] = [np.empty((instants, count)) for _ in range(5)]
    out += [np.empty((instants, count), dtype=np.int8) for _ in range(3)]
    each = max(1, _CHUNK // max(1, count))
    for first in range(0, instants, each):
        part = slice(first, first + each)
        traced = _trace_chunk(sequence, rays, moving_part(moving, part), ignore_apertures)
        for whole, values in zip(out, traced, strict=True):
            whole[part] = values
    path, x, y, u, v, w_sign, status, surface = out
    return TracedRays(path, x, y, u, v, w_sign, status, surface, len(sequence.elements))


@LOST_RAYS_ARE_DATA
def sag_and_slopes(
    element: Element, x: Array, y: Array, deformation: Array | None = None, grid: Array | None = None
) -> tuple[Array, Array, Array]:
    """Return the sag of an element and its slopes dz/dx, dz/dy.

    Parameters
    ----------
    element : Element
        The surface.
    x, y : ndarray
        Position in mm; with a deformation or grid their first axis is the instant.
    deformation : ndarray, shape (T, terms), or None
        Coefficients of the element's polynomial that changes from instant to instant.
    grid : ndarray, shape (T, rows, columns), or None
        Coefficients of its grid that changes from instant to instant.

    Returns
    -------
    tuple of ndarray
        z in mm and its slopes; NaN where the conic does not reach out so far.
    """
    parts = []
    if element.form is None or element.form.near is None:
        parts.append(conic_sag_and_slopes(x, y, element.curvature, element.conic))
    if element.form is not None:
        parts.append(form_heights(element.form, x, y))
    if element.even:
        parts.append(even_sag_and_slopes(x, y, element.even))
    if element.polynomial is not None:
        static = element.polynomial
        parts.append(polynomial(static.degree, static.radius, static.basis, static.coefficients, x, y))
    if deformation is not None and deformation.any():  # most are at rest, and cost most of the time
        bent = deformation.any(axis=1)
        form = (element.deformation_degree, element.deformation_radius, element.deformation_basis)
        added = np.zeros((3, *x.shape))
        added[:, bent] = polynomial(*form, deformation[bent], x[bent], y[bent])
        parts.append((added[0], added[1], added[2]))
    if element.grid is not None:
        parts.append(spline_grid(element.grid, element.grid.coefficients, x, y))
    if grid is not None and element.deformation_grid is not None:
        parts.append(spline_grid(element.deformation_grid, grid, x, y))
    value, slope_x, slope_y = parts[0]
    for part in parts[1:]:
        value, slope_x, slope_y = value + part[0], slope_x + part[1], slope_y + part[2]
    return value, slope_x, slope_y


def on_glass(regions: tuple[Region, ...], x: Array, y: Array) -> Mask:
    """Tell which points lie in every opening and outside of every region that blocks."""
    passes = np.ones(x.shape, dtype=np.bool_)
    for region in regions:
        if region.kind == "circle":
            center_x, center_y, radius = region.numbers
            inside = np.square(x - center_x) + np.square(y - center_y) <= radius * radius
        elif region.kind == "outline":
            inside = np.zeros(x.shape, dtype=np.bool_)
            for a, b, c, low, high in zip(*(region.numbers[i::5] for i in range(5)), strict=True):
                inside ^= (y >= low) & (y < high) & (a * (a * x + b * y - c) < 0.0)
        else:
            inside = np.ones(x.shape, dtype=np.bool_)
            for a, b, c in zip(*(region.numbers[i::3] for i in range(3)), strict=True):
                inside &= a * x + b * y <= c
        passes &= ~inside if region.blocks else inside
    return passes


def moving_part(moving: Moving, part: slice | NDArray[np.intp]) -> Moving:
    """Return some of the instants."""
    deformations, grids = (
        tuple(None if array is None else array[part] for array in arrays)
        for arrays in (moving.deformations, moving.grids)
    )
    spheres = None if moving.spheres is None else moving.spheres[part]
    return Moving(moving.poses[part], deformations, grids, spheres)


def joined_moving(parts: list[Moving]) -> tuple[Moving, list[slice]]:
    """Return the instants of parts that move the same elements, one after the other, and where each is."""

    def joined(arrays: tuple[Array | None, ...]) -> Array | None:
        known = [array for array in arrays if array is not None]
        return np.concatenate(known) if known else None

    whole = Moving(
        np.concatenate([part.poses for part in parts]),
        tuple(map(joined, zip(*(part.deformations for part in parts), strict=True))),
        tuple(map(joined, zip(*(part.grids for part in parts), strict=True))),
        joined(tuple(part.spheres for part in parts)),
    )
    ends = np.cumsum([len(part.poses) for part in parts]).tolist()
    return whole, [slice(start, end) for start, end in zip([0, *ends], ends, strict=False)]


@LOST_RAYS_ARE_DATA
def _trace_chunk(
    sequence: Sequence, rays: Rays, moving: Moving, ignore_apertures: bool
) -> tuple[NDArray[Any], ...]:
    """Return path, x, y, u, v, w_sign, status and surface (t, N) of a few instants."""
    state, index = deque(walk(sequence, rays, moving, ignore_apertures), maxlen=1).pop()
    if moving.spheres is not None:
        state.path = state.path + index * _to_sphere(moving.spheres, state)
        state.lose(~np.isfinite(state.path), MISS, len(sequence.elements))
    good = state.status == OK
    lost = [np.where(good, a, np.nan) for a in (state.path, *state.position[:2], *state.direction[:2])]
    w_sign = np.where(good, np.sign(state.direction[2]), 0.0).astype(np.int8)
    return *lost, w_sign, state.status, state.surface


def walk(
    sequence: Sequence,
    rays: Rays,
    moving: Moving,
    ignore_apertures: bool,
    trail: list[Array] | None = None,
) -> Iterator[tuple[State, float | Array]]:
    """Yield the rays behind each element, and the index of the medium in which they go on.

    The state is one record that changes on the way. Where the index varies before an element, points on the
    way to it, in its frame, are added to `trail`, which is emptied before.
    """
    shape = (moving.poses.shape[0], rays.path.size)
    state = State(
        np.broadcast_to(rays.position[:, None], (3, *shape)),
        np.broadcast_to(rays.direction[:, None], (3, *shape)),
        np.broadcast_to(rays.path, shape),
        np.zeros(shape, dtype=np.int8),
        np.full(shape, -1, dtype=np.int8),
    )
    index: float | Array = sequence.index
    space: Space | None = None
    none = (None,) * len(sequence.elements)
    deformations, grids = moving.deformations or none, moving.grids or none
    for number, element in enumerate(sequence.elements):
        if trail is not None:
            trail.clear()
        _into(moving.poses[:, number], state)
        if space is not None:
            space = space.beyond(moving.poses[:, number])
            former = moving.poses[:, number, 11]
            index = _bend(space, element, number, deformations[number], grids[number], state, former, trail)
        slopes = _meet(element, number, deformations[number], grids[number], index, state)
        if element.regions and not ignore_apertures:
            state.lose(~on_glass(element.regions, *state.position[:2]), VIGNETTED, number)
        if element.action == "refract":
            space = space_of(element.gradient, element.index, shape[0]) if element.gradient else None
        index = _act(element, number, slopes, index, space, state)
        yield state, index


def _into(pose: Array, state: State) -> None:
    """Change to the frame of the next element: q = A p + o; `pose` is (t, 12)."""
    entries = pose.T[..., None]
    position, direction = np.empty(state.position.shape), np.empty(state.direction.shape)
    for i in range(3):
        row = entries[3 * i : 3 * i + 3]
        np.add(_dot(row, state.position), entries[9 + i], out=position[i])
        direction[i] = _dot(row, state.direction)
    state.position, state.direction = position, direction


def _bend(
    space: Space,
    element: Element,
    number: int,
    deformation: Array | None,
    grid: Array | None,
    state: State,
    former: Array,
    trail: list[Array] | None,
) -> Array:
    """Follow the rays through a medium with a gradient to the element; return the index (t, N) there."""

    def sag(x: Array, y: Array) -> tuple[Array, Array, Array]:
        return sag_and_slopes(element, x, y, deformation, grid)

    going = state.status == OK
    arrived = follow(space, sag, state.position, state.direction, going, former, trail)
    state.position, state.direction, path = arrived
    state.path = state.path + path
    state.lose(~np.isfinite(path), MISS, number)
    return local_index(space, state.position)


def _meet(
    element: Element,
    number: int,
    deformation: Array | None,
    grid: Array | None,
    index: float | Array,
    state: State,
) -> tuple[Array, Array]:
    """Move the rays to the element and return its slopes there (Störkle 2018, Algorithm 1)."""
    d = state.direction
    path = conic_path(state.position, d, element.curvature, element.conic, element.sense)
    missed = np.isnan(path)
    if is_conic(element):
        # The closed form loses some digits to cancellation, which a step of Newton's iteration restores.
        hit = state.position + path * d
        sag, slope_x, slope_y = conic_sag_and_slopes(hit[0], hit[1], element.curvature, element.conic)
        step = (sag - hit[2]) / (d[2] - slope_x * d[0] - slope_y * d[1])
        state.position, state.path = hit + step * d, state.path + index * (path + step)
        state.lose(missed, MISS, number)
        return conic_slopes(state.position[0], state.position[1], element.curvature, element.conic)
    # Where the bare conic is missed, the iteration starts at the vertex plane.
    path = np.where(missed, -state.position[2] / d[2], path)
    hit = state.position + path * d
    iterating, converged = np.isfinite(path), np.zeros(path.shape, dtype=np.bool_)
    for _ in range(NEWTON_STEPS):
        sag, slope_x, slope_y = sag_and_slopes(element, hit[0], hit[1], deformation, grid)
        step = (sag - hit[2]) / (d[2] - slope_x * d[0] - slope_y * d[1])
        step = np.where(iterating, step, 0.0)
        hit, path = hit + step * d, path + step
        converged |= iterating & (np.abs(step) <= CONVERGED)
        iterating &= ~converged & np.isfinite(step)
        if not iterating.any():
            break
    _, slope_x, slope_y = sag_and_slopes(element, hit[0], hit[1], deformation, grid)
    # The ray has to cross the surface in the right sense.
    converged &= (d[2] - slope_x * d[0] - slope_y * d[1]) * (element.sense or d[2]) > 0.0
    state.position, state.path = hit, state.path + index * path
    state.lose(~converged & missed, MISS, number)
    state.lose(~converged, DIVERGED, number)
    return slope_x, slope_y


def is_conic(element: Element) -> bool:
    """Return whether the element is nothing but a conic."""
    parts = (element.form, element.polynomial, element.grid, element.deformation_grid)
    return not element.even and element.deformation_degree < 0 and all(part is None for part in parts)


def _act(
    element: Element,
    number: int,
    slopes: tuple[Array, Array],
    index: float | Array,
    space: Space | None,
    state: State,
) -> float | Array:
    """Reflect or refract the rays and return the index of the medium in which they go on."""
    if element.action == "pass" and element.phase is None:
        return index
    normal = np.stack([-slopes[0], -slopes[1], np.ones_like(slopes[0])])
    normal /= np.sqrt(_dot(normal, normal))
    if element.phase is not None:
        return _diffract(element, number, normal, index, state)
    cosine = _dot(normal, state.direction)
    if element.action == "reflect":
        state.direction = state.direction - 2.0 * cosine * normal
        return index
    # Störkle 2018, Eq. (3.32), with its signs corrected.
    after = element.index if space is None else local_index(space, state.position)
    incident = index * cosine
    radicand = after**2 - index**2 + incident * incident
    turn = np.copysign(np.sqrt(radicand), incident) - incident
    state.lose(radicand < 0.0, TOTAL_REFLECTION, number)
    state.direction = (index * state.direction + turn * normal) / after
    return after


def _diffract(
    element: Element, number: int, normal: Array, index: float | Array, state: State
) -> float | Array:
    """Send the rays on from an element with a phase, between media of constant indices."""
    assert element.phase is not None
    assert isinstance(index, float)
    after = element.index if element.action == "refract" else index
    if isinstance(element.phase, Focus):
        state.direction, path = focused(element.phase, state.position, state.direction, index, after)
    else:
        rays = state.position, state.direction, normal
        bent = diffracted(element.phase, element.action == "reflect", *rays, index, after)
        state.direction, path, lost = bent
        state.lose(lost, NO_ORDER, number)
    state.path = state.path + path
    return after


def _to_sphere(spheres: Array, state: State) -> Array:
    """Return the path from the image to the sphere, back along the ray or, for a radius < 0, onwards."""
    offset = np.stack([state.position[i] - spheres[:, i, None] for i in range(3)])
    radius = spheres[:, 3, None]
    along = _dot(offset, state.direction)
    root = np.sqrt(along * along - _dot(offset, offset) + radius * radius)
    path: Array = -along - np.copysign(root, radius)
    return path


def _dot(row: Array, vector: Array) -> Array:
    """Return the sum of products in a fixed order."""
    total: Array = row[0] * vector[0] + row[1] * vector[1] + row[2] * vector[2]
    return total
