"""Pack a sequence for its kernel: what its text depends on, and the numbers that the text reads."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.trace.ring import ring_second_derivatives, ring_steps
from wavequake.kernels.trace.sequence import Basis, Element, Focus, Moving, Sequence, terms
from wavequake.kernels.trace.sequential_source import Bend, Medium, Part, Shape

Array = NDArray[np.float64]

# Where one evaluation of the height and its slopes may do: the lateral step may change the height's linear
# continuation by so many mm, the slopes by so many rad, and the conic's by so many mm.
_HEIGHT, _SLOPE, _LEAN = 1e-12, 1e-13, 1e-7
# Polynomials are sampled a little beyond their radius, since rays may fall there.
_BEYOND = 1.02
_UNTURNED = np.eye(3).ravel()
# A polynomial may bend more strongly between samples, but no random one came near that many times, nor bumps.
_MARGIN = 2.0
_LARGEST_POWER = 280.0  # of ten


@dataclass(frozen=True, eq=False)
class Layout:
    """What the kernel's text depends on, and the fixed numbers that it reads; equal only to itself."""

    shapes: tuple[Shape, ...]
    numbers: Array


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def packed_elements(
    sequence: Sequence, moving: Moving, ignore_apertures: bool
) -> tuple[Layout, Array, list[Array]]:
    """Return the layout, limits (T, deformed elements) and arrays of the parts (T or 1, ...).

    A limit is the square of the longest lateral step for which one evaluation is enough, see
    ``kernels/deformed.cl``.
    """
    instants = len(moving.poses)
    rotates = (True,) * len(sequence.elements) if sequence.turning else _turns(moving.poses)
    grids = tuple([None if grid is None else grid.shape[-2:] for grid in moving.grids])
    layout = _layout(sequence, ignore_apertures, rotates, grids)
    limits: list[Array] = []
    arrays: list[Array] = []
    for number, (element, shape) in enumerate(zip(sequence.elements, layout.shapes, strict=True)):
        if not shape.bare:
            limits.append(_limit(element, _bends(number, element, moving, arrays), instants))
    return layout, np.array(limits).reshape(len(limits), instants).T, arrays


@lru_cache(maxsize=16)
def _layout(
    sequence: Sequence,
    ignore_apertures: bool,
    rotates: tuple[bool, ...],
    grids: tuple[tuple[int, int] | None, ...],
) -> Layout:
    """Return what does not change from instant to instant; `grids` are rows and columns of those that do."""
    shapes: list[Shape] = []
    numbers: list[float] = []
    index, medium = sequence.index, None
    for number, element in enumerate(sequence.elements):
        start = len(numbers)
        behind = element.index if element.action == "refract" else index
        numbers += [element.curvature, 1.0 + element.conic, index, index / behind, behind, np.inf]
        even = (len(element.even), len(numbers))
        numbers += element.even
        parts, reach = _parts(element, grids[number] if grids else None, numbers)
        numbers[start + 5] = reach * reach
        regions = () if ignore_apertures else _regions(element, numbers)
        plane = element.curvature == 0.0
        vacuum = index == 1.0
        before = medium
        if element.action == "refract":
            medium = _medium(number, element, numbers)
        media, form = (before, medium), element.form
        place = None if form is None else (form.name, len(form.numbers), len(numbers))
        numbers += () if form is None else form.numbers
        whole = form is not None and form.near is not None
        bend = _bend_of(element, numbers)
        rest = (even, tuple(parts), regions, *media, place, whole, bend, element.sense)
        shapes.append(Shape(start, element.action, plane, rotates[number], vacuum, *rest))
        index = behind
    return Layout(tuple(shapes), np.array(numbers))


def _medium(number: int, element: Element, numbers: list[float]) -> Medium | None:
    """Add the numbers of the medium that an element begins, if its index varies."""
    gradient = element.gradient
    if gradient is None:
        return None
    place = len(numbers)
    numbers += [element.index**2, gradient.step, *gradient.radial, *gradient.axial]
    return Medium(number, len(gradient.radial), len(gradient.axial), place)


def _bend_of(element: Element, numbers: list[float]) -> Bend | None:
    """Add the numbers of an element's phase, if it has one."""
    phase, place = element.phase, len(numbers)
    if phase is None:
        return None
    if isinstance(phase, Focus):
        numbers += (phase.power, phase.vergence)
        return Bend(0, -1, True, place)
    numbers += phase.even
    form = phase.polynomial
    if form is not None:
        numbers += (form.coefficients * _powers(form.degree, form.radius)).tolist()
    return Bend(len(phase.even), -1 if form is None else form.degree, False, place)


def _turns(poses: Array) -> tuple[bool, ...]:
    """Tell which surfaces turn at any of the instants (T, L, 12); most that do, do so at the first."""
    turning = (poses[:1, :, :9] != _UNTURNED).any(axis=(0, 2))
    if len(poses) > 1:
        still = np.flatnonzero(~turning)
        turning[still] = (poses[1:, still, :9] != _UNTURNED).any(axis=(0, 2))
    return tuple(turning.tolist())


def _parts(
    element: Element, moving_grid: tuple[int, int] | None, numbers: list[float]
) -> tuple[list[Part], float]:
    """Add the numbers of an element's polynomials and grids; return them and where their bounds hold."""
    parts, reach = [], np.inf
    for degree, radius, basis, moves in _forms(element):
        if basis == "monomial":
            call = f"monomials({{array}}, {degree}, x, y, sx, sy)"
            place, steps = 0, []
        else:
            call = f"ring({{array}}, {degree}, {{place}}, x, y, sx, sy)"
            place, steps = len(numbers), [1.0 / radius, *ring_steps(degree, basis.inner)]
        parts.append(Part(call, terms(degree), moves, place))
        numbers += steps
        reach = min(reach, radius * _BEYOND)
    shapes = [] if element.grid is None else [(element.grid, element.grid.coefficients.shape, False)]
    if element.deformation_grid is not None and moving_grid is not None:
        shapes.append((element.deformation_grid, moving_grid, True))
    for grid, (rows, columns), moves in shapes:
        call = f"spline_grid({{array}}, {rows}, {columns}, {{place}}, x, y, sx, sy)"
        parts.append(Part(call, rows * columns, moves, len(numbers)))
        numbers += [grid.x0, grid.y0, 1.0 / grid.dx, 1.0 / grid.dy]
    return parts, reach


def _bends(number: int, element: Element, moving: Moving, arrays: list[Array]) -> list[Array]:
    """Add the coefficients of an element's parts to `arrays`; return bounds of their second derivatives."""
    bends = []
    for (degree, radius, basis, _), coefficients in zip(
        _forms(element), _coefficients(number, element, moving), strict=True
    ):
        arrays.append(coefficients * _powers(degree, radius) if basis == "monomial" else coefficients)
        bends.append(_bend(coefficients, degree, basis) / radius**2)
    moves = moving.grids[number] if moving.grids else None
    grids = [] if element.grid is None else [(element.grid, element.grid.coefficients)]
    if element.deformation_grid is not None and moves is not None:
        grids.append((element.deformation_grid, moves))
    for grid, heights in grids:
        arrays.append(heights)
        # Second differences of a B-spline's coefficients bound its second derivatives.
        spread = heights.max(axis=(-2, -1)) - heights.min(axis=(-2, -1))
        bends.append(8.0 * spread / min(grid.dx, grid.dy) ** 2)
    return bends


def _forms(element: Element) -> list[tuple[int, float, Basis, bool]]:
    """Return degree, radius and basis of polynomials, and whether they move; those of a kind are added up."""
    fixed, degree = element.polynomial, element.deformation_degree
    form = (element.deformation_radius, element.deformation_basis)
    if fixed is not None and degree >= 0 and (fixed.radius, fixed.basis) == form:
        return [(max(fixed.degree, degree), *form, True)]
    found = [] if fixed is None else [(fixed.degree, fixed.radius, fixed.basis, False)]
    return found if degree < 0 else [*found, (degree, *form, True)]


def _coefficients(number: int, element: Element, moving: Moving) -> list[Array]:
    """Return the coefficients of the polynomials of `_forms`."""
    fixed = [] if element.polynomial is None else [element.polynomial.coefficients]
    moves = moving.deformations[number] if moving.deformations else None
    if moves is None:
        return fixed
    (degree, *_), *others = _forms(element)
    if others or not fixed:
        return [*fixed, moves]
    total = np.zeros((len(moves), terms(degree)))
    total[:, : moves.shape[1]] = moves
    total[:, : fixed[0].size] += fixed[0]
    return [total]


@lru_cache(maxsize=64)
def _powers(degree: int, radius: float) -> Array:
    """Return what makes of the coefficients of u^i v^j those of x^i y^j: the kernel need not divide.

    Raises
    ------
    UserError
        If these are out of the range of numbers.
    """
    if not degree * abs(np.log10(radius)) <= _LARGEST_POWER:
        raise UserError(
            f"a polynomial of degree {degree} over a radius of {radius:g} mm cannot be traced by OpenCL: its "
            "powers are out of the range of numbers; choose a radius nearer to that of the surface, or "
            "campaign.device=numpy"
        )
    powers = [radius ** -float(order) for order in range(degree + 1) for _ in range(order + 1)]
    return np.array(powers)


def _bend(coefficients: Array, degree: int, basis: Basis) -> Array:
    """Return the largest second derivative of polynomials (T or nothing, terms) on their disk or ring.

    A bound needs no double precision: what underflows bends nothing, what overflows is steep indeed.
    """
    chosen, derivatives = _second_derivatives(degree, basis)
    single = np.ascontiguousarray(np.atleast_2d(coefficients).T, dtype=np.float32)
    second = derivatives @ single[chosen]
    second = np.abs(second, out=second).sum(axis=0)
    np.square(second, out=second)
    square, mixed, last = second.reshape(3, -1, second.shape[-1])
    square += mixed
    square += last
    bend = _MARGIN * np.sqrt(square.max(axis=0)).astype(np.float64)
    return np.asarray(bend.reshape(coefficients.shape[:-1]))


@lru_cache(maxsize=64)
def _second_derivatives(degree: int, basis: Basis) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Return parts (C, K) of the terms, and their second derivatives uu, sqrt(2) uv, vv (C, points, K).

    Monomials come in four parts, even or odd in u and in v: the absolute values of the sums over each, at
    points of one quadrant, bound what the polynomial has in the other three, too.
    """
    radii = np.array([0.6, 1.0]) * _BEYOND
    if basis != "monomial" and basis.inner > 0.0:
        radii = np.append(radii[radii > basis.inner], basis.inner)
    if basis != "monomial":
        angles = np.linspace(0.0, 2.0 * np.pi, max(4, 2 * degree - 2), endpoint=False)
        u, v = (radii[:, None] * np.stack([np.cos(angles), np.sin(angles)])[:, None]).reshape(2, -1)
        if basis.inner == 0.0:
            u, v = np.append(u, 0.0), np.append(v, 0.0)
        second = ring_second_derivatives(degree, basis.inner, u, v) * [[[1.0]], [[np.sqrt(2.0)]], [[1.0]]]
        flat = second.reshape(1, -1, second.shape[-1])
        return np.arange(flat.shape[-1])[None], np.asarray(flat, dtype=np.float32)
    angles = np.linspace(0.0, 0.5 * np.pi, max(1, -(-(degree - 1) // 2)) + 1)
    u, v = (radii[:, None] * np.stack([np.cos(angles), np.sin(angles)])[:, None]).reshape(2, -1)
    u, v = np.append(u, 0.0), np.append(v, 0.0)
    kind = np.polynomial.Polynomial
    orders = [
        [kind.basis(k).deriv(order) if order else kind.basis(k) for order in range(3)]
        for k in range(degree + 1)
    ]
    at_u, at_v = ([[term(t) for term in row] for row in orders] for t in (u, v))
    pairs = np.array([(total - j, j) for total in range(degree + 1) for j in range(total + 1)])
    second = np.stack(
        [
            np.concatenate(
                [at_u[i][2] * at_v[j][0], np.sqrt(2.0) * at_u[i][1] * at_v[j][1], at_u[i][0] * at_v[j][2]]
            )
            for i, j in pairs
        ],
        axis=1,
        dtype=np.float32,
    )
    odd = pairs % 2
    parts = [np.flatnonzero((odd == parity).all(axis=1)) for parity in ((0, 0), (0, 1), (1, 0), (1, 1))]
    # All are as long as the longest; what is added counts nothing.
    chosen = np.zeros((4, max(map(len, parts))), dtype=np.intp)
    derivatives = np.zeros((4, len(second), chosen.shape[1]), dtype=np.float32)
    for k, part in enumerate(parts):
        chosen[k, : len(part)] = part
        derivatives[k, :, : len(part)] = second[:, part]
    return chosen, derivatives


def _limit(element: Element, bends: list[Array], instants: int) -> Array:
    """Return the limit of each instant; for strong even powers and forms no step is short enough."""
    if element.even or element.form is not None:
        return np.full(instants, -1.0)
    bend = np.zeros(instants)
    for part in bends:
        bend = bend + part
    lean = abs(element.curvature) * (1.0 + abs(1.0 + element.conic))
    return np.asarray(np.minimum(np.minimum(_HEIGHT / bend, (_SLOPE / bend) ** 2), _LEAN / np.float64(lean)))


def _regions(element: Element, numbers: list[float]) -> tuple[tuple[str, int, bool, int], ...]:
    found = []
    for region in element.regions:
        edges = len(region.numbers) // (5 if region.kind == "outline" else 3)
        found.append((region.kind, edges, region.blocks, len(numbers)))
        x, y, radius = region.numbers[:3]
        numbers += (x, y, radius * radius) if region.kind == "circle" else region.numbers
    return tuple(found)
