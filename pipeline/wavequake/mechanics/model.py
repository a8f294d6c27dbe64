"""Linear second-order models: a finite-element model and what reduction makes of it. SI units.

Both have ``mass``, ``damping_matrix``, ``stiffness``, ``inputs`` (a force at interface k in direction d, or a
moment about it, acts through column 3 k + d) and ``surface`` (rows 3 k + d give the displacement of optical
node k), so a response, a transfer matrix or a surface fit takes either: a reduced model is a model.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from wavequake.errors import UserError

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

NONE = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class RayleighDamping:
    """D = mass * M + stiffness * K, in 1/s and s."""

    mass: float = 0.0
    stiffness: float = 5e-6

    def __post_init__(self) -> None:
        if not (0 <= self.mass < math.inf and 0 <= self.stiffness < math.inf):
            raise UserError(
                f"the Rayleigh damping ({self.mass} 1/s, {self.stiffness} s) must be two finite "
                "numbers that are not negative"
            )


@dataclass(frozen=True, repr=False)
class FiniteElementModel:
    """A free-floating or supported body with n degrees of freedom; SI units.

    Attributes
    ----------
    name : str
    mass, stiffness : csc_array, shape (n, n)
        Symmetric, both triangles stored.
    damping : RayleighDamping
    nodes : ndarray, shape (N, 3)
        Coordinates in m.
    dof_node, dof_direction : ndarray of int, shape (n,)
        Which node and which direction (0, 1, 2: displacements along x, y, z; 3, 4, 5: rotations about them)
        each degree of freedom moves; -1 where it is an inner coordinate of no node, e.g. of a mode.
    interfaces : ndarray of int, shape (k,)
        Nodes that carry forces, springs, constraints or prescribed motion, by their displacement.
    surface_nodes : ndarray of int, shape (p,)
        Nodes of the optical surface.
    node_sets : mapping of str to ndarray of int
        Further named sets.
    surface_weights : ndarray, shape (p,)
        Positive shares of the optical surface's area, projected along z, for the fit of Störkle 2018,
        Eq. 4.10; sum 1.
    turns : ndarray of int, shape (t,)
        Which of the interfaces, from 0, are the rotation of their node, rad and N m, not its displacement.
    """

    name: str
    mass: csc_array
    stiffness: csc_array
    damping: RayleighDamping
    nodes: Array
    dof_node: Integers
    dof_direction: Integers
    interfaces: Integers
    surface_nodes: Integers
    surface_weights: Array
    node_sets: Mapping[str, Integers] = field(default_factory=dict)
    turns: Integers = field(default_factory=lambda: NONE)

    def __repr__(self) -> str:
        return _described(self)

    @property
    def order(self) -> int:
        """Number of degrees of freedom."""
        return int(self.mass.shape[0])

    @property
    def damping_matrix(self) -> csc_array:
        """Damping matrix D."""
        return csc_array(self.damping.mass * self.mass + self.damping.stiffness * self.stiffness)

    @property
    def inputs(self) -> csc_array:
        """Input matrix B, shape (n, 3 k): unit forces and moments at the interfaces."""
        return csc_array(_picked(self, self.interfaces, interface_dofs(self)).T)

    @property
    def surface(self) -> csc_array:
        """Rows that give the displacements of the optical nodes, shape (3 p, n)."""
        return selection(self, self.surface_nodes)


@dataclass(frozen=True, repr=False)
class ReducedModel:
    """A model of order r in coordinates q with u = V q; the same interface as `FiniteElementModel`.

    Attributes
    ----------
    name : str
        Canonical name of the variant, e.g. ``craigb36`` or ``krylov108(200,450,700)``.
    method : str
    mass, stiffness, damping_matrix : ndarray, shape (r, r)
    inputs : ndarray, shape (r, 3 k)
        V^T B.
    surface : ndarray, shape (3 p, r)
        Rows of V at the optical nodes.
    nodes, interfaces, surface_nodes, surface_weights, turns
        As in the full model.
    seconds : float
        Time of the reduction.
    """

    name: str
    method: str
    mass: Array
    stiffness: Array
    damping_matrix: Array
    inputs: Array
    surface: Array
    nodes: Array
    interfaces: Integers
    surface_nodes: Integers
    surface_weights: Array
    seconds: float
    turns: Integers = field(default_factory=lambda: NONE)

    def __repr__(self) -> str:
        return _described(self)

    @property
    def order(self) -> int:
        """Number of coordinates."""
        return int(self.mass.shape[0])


Model = FiniteElementModel | ReducedModel


def places(model: FiniteElementModel) -> Integers:
    """Return which degree of freedom each displacement and rotation of a node is, shape (N, 6); -1: none."""
    found = np.full((len(model.nodes), 6), -1, dtype=np.int64)
    labeled = np.flatnonzero(model.dof_node >= 0)
    found[model.dof_node[labeled], model.dof_direction[labeled]] = labeled
    return found


def _described(model: Model) -> str:
    """Return what a model is, in a line."""
    kind, what = (
        type(model).__name__,
        ("coordinates" if isinstance(model, ReducedModel) else "degrees of freedom"),
    )
    nodes = f"{len(shifts(model))} interface and {len(model.surface_nodes)} optical nodes"
    return f"<{kind} {model.name}: {model.order} {what}, {nodes}>"


def shifts(model: Any) -> Integers:
    """Return which of a model's interfaces, from 0, are the displacement of their node."""
    return np.setdiff1d(np.arange(len(model.interfaces)), model.turns)


def rotations(model: Any) -> Integers:
    """Return which of a model's interfaces, from 0, is the rotation of each of `shifts`; -1: it has none."""
    turns = {int(model.interfaces[one]): int(one) for one in model.turns}
    return np.array([turns.get(int(node), -1) for node in model.interfaces[shifts(model)]], dtype=np.int64)


def force_columns(model: Any) -> Integers:
    """Return which of a model's inputs are forces, not moments."""
    return np.asarray((3 * shifts(model)[:, None] + np.arange(3)).ravel())


def interface_dofs(model: FiniteElementModel) -> Integers:
    """Return which degrees of freedom the inputs of a model drive, shape (3 k,); -1: none."""
    found = places(model)[model.interfaces]
    turned = np.isin(np.arange(len(found)), model.turns)[:, None]
    return np.asarray(np.where(turned, found[:, 3:], found[:, :3]).ravel())


def selection(model: FiniteElementModel, nodes: Integers) -> csc_array:
    """Return the Boolean matrix (3 k, n) that picks the displacements x, y, z of `nodes`.

    Raises
    ------
    UserError
        If a node has not all three displacements (it is constrained, or belongs to no element).
    """
    return _picked(model, nodes, places(model)[nodes, :3].ravel())


def _picked(model: FiniteElementModel, nodes: Integers, columns: Integers) -> csc_array:
    if (columns < 0).any():
        row = int(np.argmax(columns < 0))
        raise UserError(
            f"node {int(nodes[row // 3])} of the model {model.name} has no displacement in "
            f"{'xyz'[row % 3]}; interface and optical nodes must be free in all three directions"
        )
    rows = np.arange(len(columns))
    return csc_array((np.ones(len(columns)), (rows, columns)), shape=(len(columns), model.order))


def check_model(model: FiniteElementModel) -> None:
    """Refuse a model that no response, reduction or surface fit can take.

    Raises
    ------
    UserError
        If the optical surface is empty, its weights are not positive, a node is not finite, or the interfaces
        cannot hold the body: displacements of nodes that are fewer than three or lie on a line.
    """
    if not np.isfinite(model.nodes).all():
        row = int(np.argmin(np.isfinite(model.nodes).all(axis=1)))
        raise UserError(f"node {row} of the model {model.name} has coordinates that are not finite")
    if len(model.surface_nodes) == 0:
        raise UserError(f"the optical surface of the model {model.name} is empty; name at least one node")
    if model.surface_weights.shape != model.surface_nodes.shape or not (model.surface_weights > 0).all():
        raise UserError(
            f"the optical surface of the model {model.name} needs one positive weight for each of its "
            f"{len(model.surface_nodes)} nodes"
        )
    points = model.nodes[model.interfaces[shifts(model)]]
    if not _hold(points, len(model.turns)):
        raise UserError(
            f"the {len(points)} interface nodes of the model {model.name} lie on a line; "
            "name at least three that span a triangle"
        )


def _hold(points: Array, turns: int) -> bool:
    """Return whether points (p, 3) that stand still hold a body; some do not turn either."""
    if turns:
        return len(points) > 0
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) if len(points) > 2 else np.zeros(2)
    return bool(spread[1] > 1e-6 * spread[0])


def rigid_modes(coordinates: Array, origin: Array) -> Array:
    """Return the displacements x, y, z of points under unit rigid motions, shape (3 p, 6).

    Columns are translations along x, y, z and small rotations about axes through `origin`.

    Parameters
    ----------
    coordinates : ndarray, shape (p, 3)
        m.
    origin : ndarray, shape (3,)
        m.
    """
    arm = coordinates - origin
    modes = np.zeros((len(arm), 3, 6))
    modes[:, :, :3] = np.eye(3)
    modes[:, :, 3:] = np.cross(np.eye(3)[None], arm[:, None, :]).transpose(0, 2, 1)
    result: NDArray[Any] = modes.reshape(-1, 6)
    return result
