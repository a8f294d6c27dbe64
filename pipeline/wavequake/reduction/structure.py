"""The matrices that every reduction starts from, with factorizations and modes that variants share.

A `Structure` is a finite-element model (sparse) or an intermediate model (dense) whose interface
displacements are coordinates. Rigid motions are known exactly and split off: static solutions of a free body
are those of inertia relief, and elastic modes hold no trace of rigid ones.
"""

import weakref
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray
from scipy.sparse import csc_array

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, FiniteElementModel, Integers, RayleighDamping, interface_dofs
from wavequake.mechanics.vibration.eigen import dense_modes, mass_normalized_rigid_modes
from wavequake.mechanics.vibration.factors import LARGE, factorize
from wavequake.prepared import preparing
from wavequake.reduction.directions import turn_equal
from wavequake.reduction.lanczos import ACCURACY, lowest_modes

Solver = Callable[[NDArray[Any]], NDArray[Any]]

# Below this order dense algebra is faster than sparse.
DENSE = 600
# Factorizations at expansion points that are kept.
_KEPT = 8
# Modes that are computed beyond those asked for, at least.
_SPARE = 4
# An expansion point nearer than this to an eigenfrequency is moved to this distance, Hz.
NEAREST = 1e-3


class Size(NamedTuple):
    """What of a model limits its variants.

    ``freedoms`` degrees of freedom, ``interface`` interface directions (3 k), ``rigid`` motions (0 to 6);
    ``dense`` where all modes are at hand.
    """

    name: str
    freedoms: int
    interface: int
    rigid: int
    damping: RayleighDamping
    dense: bool


@dataclass(frozen=True, eq=False)
class Structure:
    """Mass and stiffness with what is derived from them once.

    Attributes
    ----------
    name : str
    mass, stiffness : csc_array or ndarray, shape (n, n)
    damping : RayleighDamping
    interface : ndarray of int, shape (3 k,)
        Coordinates that are the interface displacements (and rotations, where it has them).
    rigid : ndarray, shape (n, r)
        Rigid motions that the supports allow, mass-orthonormal.
    """

    name: str
    mass: Any
    stiffness: Any
    damping: RayleighDamping
    interface: Integers
    rigid: Array
    cache: dict[Hashable, Any] = field(default_factory=dict, repr=False)

    @property
    def order(self) -> int:
        """Number of coordinates."""
        return int(self.mass.shape[0])

    @property
    def is_dense(self) -> bool:
        """Whether all modes are at hand."""
        return isinstance(self.stiffness, np.ndarray)

    @property
    def inputs(self) -> Array:
        """Unit forces at the interface, shape (n, 3 k)."""
        columns = np.zeros((self.order, len(self.interface)))
        columns[self.interface, np.arange(len(self.interface))] = 1.0
        return columns

    @property
    def size(self) -> Size:
        """What limits the variants of the structure."""
        rigid = self.rigid.shape[1]
        return Size(self.name, self.order, len(self.interface), rigid, self.damping, self.is_dense)

    def remove_rigid(self, vectors: NDArray[Any]) -> NDArray[Any]:
        """Return the part of displacements that is mass-orthogonal to the rigid motions."""
        result: NDArray[Any] = vectors - self.rigid @ ((self.mass @ self.rigid).T @ vectors)
        return result


_structures: dict[int, tuple[weakref.ref[Any], Structure]] = {}


def kept_with(model: Any, make: Callable[[], Structure]) -> Structure:
    """Return the structure that is made of a model, the same object while the model lives."""
    known = _structures.get(id(model))
    if known is not None and known[0]() is model:
        return known[1]
    made, key = make(), id(model)
    _structures[key] = (weakref.ref(model, lambda _: _structures.pop(key, None)), made)
    return made


def structure(model: FiniteElementModel) -> Structure:
    """Return the structure of a model, the same object while the model lives.

    Raises
    ------
    UserError
        If an entry is not finite, or an interface node cannot move.
    """
    return kept_with(model, lambda: _structure(model))


def _structure(model: FiniteElementModel) -> Structure:
    for label, matrix in (("mass", model.mass), ("stiffness", model.stiffness)):
        if not np.isfinite(matrix.data).all():
            raise UserError(f"The {label} matrix of the model {model.name} has entries that are not finite.")
    interface = interface_dofs(model)
    if not len(interface) or (interface < 0).any():
        raise UserError(f"The model {model.name} needs interface nodes that can move in x, y and z.")
    mass, stiffness = model.mass, model.stiffness
    rigid = mass_normalized_rigid_modes(model)
    if model.order <= DENSE:
        mass, stiffness = mass.toarray(), stiffness.toarray()
    return Structure(model.name, mass, stiffness, model.damping, interface, rigid)


def determinate(rigid: Array) -> Integers:
    """Return rows whose clamping holds a body in a statically determinate way (3-2-1)."""
    count = rigid.shape[1]
    if not count:
        return np.zeros(0, dtype=np.int64)
    triangle, rows = scipy.linalg.qr(rigid.T, mode="r", pivoting=True)
    pivots = np.abs(np.diag(triangle[:, : min(triangle.shape)]))
    if len(pivots) < count or pivots[-1] < 1e-6 * pivots[0]:
        return np.zeros(0, dtype=np.int64)
    chosen: Integers = np.sort(rows[:count]).astype(np.int64)
    return chosen


def held(body: Structure) -> Integers:
    """Return six (or as many as move) of the interface coordinates that hold the body determinately.

    Raises
    ------
    UserError
        If the interface nodes are too few, or on one line, and leave the body free to move.
    """
    chosen = determinate(body.rigid[body.interface])
    if len(chosen) < body.rigid.shape[1]:
        raise UserError(
            f"Clamping the {len(body.interface) // 3} interface nodes of the model {body.name} leaves it "
            "free to move, and its stiffness singular; give at least three that are not on one line, or "
            "choose modal, rubin, inertia or krylov, which clamp nothing."
        )
    result: Integers = body.interface[chosen]
    return result


@preparing()
def clamped(body: Structure, fixed: Integers) -> Solver:
    """Return the solver of K u = f with the coordinates `fixed` at rest; u is zero there.

    Raises
    ------
    UserError
        If the stiffness is singular even so: the body has mechanisms.
    """
    key = ("clamped", *fixed.tolist())
    if key not in body.cache:
        free = np.setdiff1d(np.arange(body.order), fixed)
        inner = _positive_definite(body, body.stiffness[free][:, free])

        def solve(force: NDArray[Any]) -> NDArray[Any]:
            result = np.zeros(force.shape)
            result[free] = inner(np.ascontiguousarray(force[free]))
            return result

        body.cache[key] = solve
    solver: Solver = body.cache[key]
    return solver


def _positive_definite(body: Structure, matrix: Any) -> Solver:
    message = (
        f"The stiffness matrix of the model {body.name} is singular although rigid motions are held: "
        "it has a mechanism, for example a part that is not attached."
    )
    if not len(matrix.shape) or matrix.shape[0] == 0:
        return lambda force: force
    if isinstance(matrix, np.ndarray):
        try:
            factor = scipy.linalg.cho_factor(matrix)
        except scipy.linalg.LinAlgError:
            raise UserError(message) from None
        pivots = np.diag(factor[0]) ** 2
        solver: Solver = lambda force: scipy.linalg.cho_solve(factor, force)  # noqa: E731
    else:
        try:
            sparse = factorize(matrix, definite=True)
        except UserError:
            raise UserError(message) from None
        pivots = sparse.pivots
        solver = sparse.solve
    if not pivots.min() > 1e-14 * pivots.max():
        raise UserError(message)
    return solver


def elastic_flexibility(body: Structure) -> Solver:
    """Return the solver of static equilibrium; of a free body under inertia relief.

    The forces of a free body are balanced by those of its rigid acceleration, and its displacements have no
    rigid part; Craig and Kurdila 2006, section 17.5.
    """
    solve = clamped(body, determinate(body.rigid))
    weighted = body.mass @ body.rigid

    def relieved(force: NDArray[Any]) -> NDArray[Any]:
        return body.remove_rigid(solve(force - weighted @ (body.rigid.T @ force)))

    return relieved


def shifted(body: Structure, point: complex) -> Solver:
    """Return the solver of (K + s^2 M) u = f for elastic motions at an expansion point.

    `point` in Hz stands for s = 2 pi i conj(point). A real one nearer than 1 mHz to an eigenfrequency would
    amplify rounding errors to the size of the result, so it is moved to 1 mHz above that frequency. At 0 Hz
    this is `elastic_flexibility`.
    """
    key = ("shifted", point)
    if key not in body.cache:
        kept = [other for other in body.cache if isinstance(other, tuple) and other[0] == "shifted"]
        for other in kept[: max(0, len(kept) + 1 - (_KEPT if body.order < LARGE else 1))]:
            del body.cache[other]
        body.cache[key] = _shifted(body, point)
    solver: Solver = body.cache[key]
    return solver


def _shifted(body: Structure, point: complex) -> Solver:
    if point == 0:
        return elastic_flexibility(body)
    if body.is_dense:
        squared, shapes = elastic_modes(body, body.order - body.rigid.shape[1])
        if np.imag(point) == 0:
            point = _away(float(np.real(point)), np.sqrt(squared) / (2 * np.pi))
        denominators = (squared - _square(point))[:, None]
        return lambda force: shapes @ ((shapes.T @ force) / denominators)
    factor = factorize(csc_array(body.stiffness - _square(point) * body.mass))
    if np.imag(point) == 0:
        frequency = float(np.real(point))
        moved = _away(frequency, _nearest_frequency(body, factor))
        if moved != frequency:
            factor = factorize(csc_array(body.stiffness - _square(moved) * body.mass))

    def solve(force: NDArray[Any]) -> NDArray[Any]:
        return body.remove_rigid(factor.solve(force))

    return solve


def _square(point: complex) -> complex | float:
    """Return -s^2, which is real for real and for imaginary points."""
    value = (2 * np.pi * np.conj(complex(point))) ** 2
    return value if value.imag else float(value.real)


def _away(frequency: float, eigenfrequencies: Array) -> float:
    near = float(eigenfrequencies[np.argmin(np.abs(eigenfrequencies - frequency))])
    return near + NEAREST if abs(frequency - near) < NEAREST else frequency


def _nearest_frequency(body: Structure, factor: Any) -> Array:
    """Estimate the eigenfrequency nearest to a shift by inverse iteration; only close ones matter."""
    vector = np.random.default_rng(0).standard_normal(body.order)
    for _ in range(3):
        vector = body.remove_rigid(factor.solve(body.mass @ vector))
        vector = vector / np.sqrt(vector @ (body.mass @ vector))
    return np.array([np.sqrt(max(vector @ (body.stiffness @ vector), 0.0)) / (2 * np.pi)])


def elastic_modes(body: Structure, count: int) -> tuple[Array, Array]:
    """Return the lowest elastic free-interface modes: squared angular frequencies and mass-normalized shapes.

    Shapes are (n, count). Rigid motions are not among them.
    """
    return _modes(body, count, None)


def fixed_modes(body: Structure, count: int, fixed: Integers) -> tuple[Array, Array]:
    """Return the lowest modes with the coordinates `fixed` at rest; as `elastic_modes`, zero there."""
    return _modes(body, count, fixed)


@preparing()
def _modes(body: Structure, count: int, fixed: Integers | None) -> tuple[Array, Array]:
    available = body.order - (body.rigid.shape[1] if fixed is None else len(fixed))
    if count > available:
        raise UserError(
            f"{count} modes of the model {body.name} were asked for, but it has only {available}"
            + (" elastic ones." if fixed is None else f" with {len(fixed)} coordinates clamped.")
        )
    size = available if body.is_dense else _step(body, count, available)
    key = ("modes", None if fixed is None else tuple(fixed.tolist()), size)
    if key not in body.cache:
        squared, shapes = _dense_modes(body, fixed) if body.is_dense else _sparse_modes(body, size, fixed)
        body.cache[key] = squared, turn_equal(squared, shapes, _seen(body, squared, shapes, fixed))
    squared, shapes = body.cache[key]
    return squared[:count], shapes[:, :count]


def _seen(body: Structure, squared: Array, shapes: Array, fixed: Integers | None) -> Array:
    """Return what the interface has of modes: displacements, or forces where it is held."""
    if fixed is None:
        return shapes[body.interface]
    forces: Array = body.stiffness[fixed] @ shapes - (body.mass[fixed] @ shapes) * squared
    return forces


def _step(body: Structure, count: int, available: int) -> int:
    """Return how many modes to compute: the next quarter of a power of two, whatever was asked for before.

    With some to spare: both of a pair must be known where a variant keeps one of them.
    """
    if 2 * count >= available:
        raise UserError(
            f"{count} modes are too many for the {body.order} degrees of freedom of the model {body.name}; "
            "ask for fewer than half of them."
        )
    quarter = 1 << max(3, (count + _SPARE - 1).bit_length() - 3)
    size = max(32, -(-(count + _SPARE) // quarter) * quarter)
    return size if 2 * size < available else (available - 1) // 2


def _dense_modes(body: Structure, fixed: Integers | None) -> tuple[Array, Array]:
    if fixed is None:
        # An orthonormal basis of elastic motions: the problem left has no zero eigenvalues.
        count = body.rigid.shape[1]
        basis = (
            np.linalg.qr(body.mass @ body.rigid, mode="complete")[0][:, count:]
            if count
            else np.eye(body.order)
        )
        squared, inner = dense_modes(basis.T @ body.stiffness @ basis, basis.T @ body.mass @ basis)
        return squared, basis @ inner
    free = np.setdiff1d(np.arange(body.order), fixed)
    squared, inner = dense_modes(body.stiffness[np.ix_(free, free)], body.mass[np.ix_(free, free)])
    shapes = np.zeros((body.order, len(squared)))
    shapes[free] = inner
    return squared, shapes


def _sparse_modes(body: Structure, count: int, fixed: Integers | None) -> tuple[Array, Array]:
    """Lanczos on the flexibility: rigid motions have the eigenvalue 0 and are never found."""
    solve = elastic_flexibility(body) if fixed is None else clamped(body, fixed)
    found = lowest_modes(solve, body.mass, count)
    if found is None:  # the rest of the shapes has no mass
        inverse = scipy.sparse.linalg.LinearOperator((body.order, body.order), matvec=solve, dtype=float)
        start = solve(body.mass @ np.random.default_rng(0).standard_normal(body.order))
        found = scipy.sparse.linalg.eigsh(
            body.stiffness, count, M=body.mass, sigma=0.0, OPinv=inverse, v0=start, tol=ACCURACY
        )
    squared, shapes = found
    order = np.argsort(squared)
    if fixed is None:
        shapes = body.remove_rigid(shapes)
    return squared[order], shapes[:, order]
