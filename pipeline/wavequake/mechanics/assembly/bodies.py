"""Bodies of an assembly: rigid ones, and linear models that are placed in it. SI units, axes of the system.

The displacement of a node and its small rotation are groups of three columns of a model's inputs, so that the
joints, springs and prescribed motions of `wavequake.mechanics.multibody` take them as interface nodes.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy  # its parts load when first used

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, FiniteElementModel, Model, ReducedModel, places, rigid_modes
from wavequake.mechanics.vibration.modal import dense

GROUND = "ground"
Output = tuple[str, str]
_SMALL = 1e-9
_FREE = 1e-10  # squared frequency of a rigid motion in parts of the highest one


@dataclass(frozen=True)
class Node:
    """A named point of a body.

    Attributes
    ----------
    point : ndarray, shape (3,)
        m.
    moves : int
        Which interface of the model is its displacement.
    turns : int or None
        Which one its rotation; None where a body knows displacements alone.
    """

    point: Array
    moves: int
    turns: int | None = None


@dataclass(frozen=True)
class Body:
    """A body of an assembly.

    Attributes
    ----------
    name : str
    model : ReducedModel
        Its coordinates; interfaces are groups of nodes, and the surface the rows of all `outputs`.
    nodes : mapping of str to Node
    outputs : mapping of (str, str) to int
        How many rows of the model's surface, one after the other, are what of the optics: ("rigid", element),
        its six motions in its own frame, m and rad, or ("figure", surface), its Noll coefficients, m.
    anywhere : bool
        Whether any point is a node: the body is rigid.
    held : bool
        Whether its own stiffness holds it in space, so that it has no rigid motions of its own.
    """

    name: str
    model: ReducedModel
    nodes: Mapping[str, Node]
    outputs: Mapping[Output, int] = field(default_factory=dict)
    anywhere: bool = False
    held: bool = False


def rigid_body(
    name: str,
    mass: float,
    inertia: Array,
    center: Array,
    nodes: Mapping[str, Array],
    rows: Mapping[Output, Array] | None = None,
) -> Body:
    """Return a rigid body; coordinates are shifts of its center of mass and small rotations about it.

    Parameters
    ----------
    mass : float
        kg.
    inertia : ndarray, shape (3, 3)
        About the center of mass, kg m^2.
    center : ndarray, shape (3,)
        m.
    nodes : mapping of str to ndarray of shape (3,)
        m; the center is the node "". Interfaces are its shift, the turn of the body, and the others' shifts.
    rows : mapping of (str, str) to ndarray of shape (6, 6)
        `outputs` per coordinate.

    Raises
    ------
    UserError
        If the mass is not positive, or the inertia not that of a body.
    """
    if not (np.isfinite(mass) and mass > 0.0):
        raise UserError(f"the mass of the body {name!r} is {mass} kg; it must be positive")
    moments = np.linalg.eigvalsh(inertia) if np.isfinite(inertia).all() else np.zeros(3)
    if not (moments > 0.0).all() or np.abs(inertia - inertia.T).max() > _SMALL * moments[-1]:
        raise UserError(
            f"the inertia of the body {name!r} must be symmetric with positive principal moments, kg m^2"
        )
    if moments[-1] > (1.0 + _SMALL) * (moments[0] + moments[1]):
        raise UserError(
            f"the principal moments of the body {name!r}, {moments[0]:.4g}, {moments[1]:.4g} and "
            f"{moments[2]:.4g} kg m^2, belong to no mass: none can be larger than the sum of the others"
        )
    points = {"": center, **nodes}
    turn = np.hstack([np.zeros((3, 3)), np.eye(3)])
    moves = rigid_modes(np.array(list(points.values())), center)
    inputs = np.vstack([moves[:3], turn, moves[3:]])
    given = dict(rows or {})
    model = _model(
        name,
        scipy.linalg.block_diag(mass * np.eye(3), inertia),
        np.zeros((6, 6)),
        np.zeros((6, 6)),
        inputs.T,
        np.vstack([np.zeros((0, 6)), *given.values()]),
    )
    named = {one: Node(point, index + (index > 0), 1) for index, (one, point) in enumerate(points.items())}
    return Body(name, model, named, {one: len(row) for one, row in given.items()}, anywhere=True)


def with_point(body: Body, name: str, point: Array) -> Body:
    """Return a rigid body with a further node."""
    turns = body.nodes[""].turns
    shift = np.hstack([np.eye(3), -_cross(point - body.nodes[""].point)])
    inputs = np.hstack([body.model.inputs, shift.T])
    node = Node(point, inputs.shape[1] // 3 - 1, turns)
    model = replace(body.model, inputs=inputs, **_marks(inputs.shape[1] // 3))
    return replace(body, model=model, nodes={**body.nodes, name: node})


def placed(
    name: str,
    model: Model,
    nodes: Mapping[str, int],
    rotation: Array | None = None,
    position: Array | None = None,
    rows: Mapping[Output, Array] | None = None,
    turns: Mapping[str, int] | None = None,
) -> Body:
    """Return an elastic body: a model at its place in the system.

    Parameters
    ----------
    model : FiniteElementModel or ReducedModel
        Node coordinates in its own frame, m.
    nodes : mapping of str to int
        Which of the model's interfaces, from 0, is called how.
    rotation, position : ndarray, shapes (3, 3) and (3,)
        From the model's frame to the system's; none: they are the same.
    rows : mapping of (str, str) to ndarray of shape (6, n) or (J, n)
        `outputs` per coordinate.
    turns : mapping of str to int, optional
        Which interface is the rotation of a node, where it is not one of a finite-element model.
    """
    turn = np.eye(3) if rotation is None else rotation
    shift = np.zeros(3) if position is None else position
    inputs = dense(model.inputs)
    inputs = (inputs.reshape(len(inputs), -1, 3) @ turn.T).reshape(len(inputs), -1)
    points = model.nodes[model.interfaces] @ turn.T + shift
    named = {one: Node(points[index], index, (turns or {}).get(one)) for one, index in nodes.items()}
    if isinstance(model, FiniteElementModel):
        inputs, named = _with_turns(model, inputs, named, turn)
    given = dict(rows or {})
    kept = _model(
        name,
        dense(model.mass),
        dense(model.stiffness),
        dense(model.damping_matrix),
        inputs,
        np.vstack([np.zeros((0, len(inputs))), *given.values()]),
    )
    sizes = {one: len(row) for one, row in given.items()}
    return Body(name, kept, named, sizes, held=not _is_free(kept))


def _with_turns(
    model: FiniteElementModel, inputs: Array, nodes: Mapping[str, Node], turn: Array
) -> tuple[Array, dict[str, Node]]:
    """Add the rotations of nodes that have them (beams, shells) to the inputs."""
    columns, found = places(model)[model.interfaces, 3:], dict(nodes)
    parts = [inputs]
    for name, node in nodes.items():
        mine = columns[node.moves]
        if (mine >= 0).all():
            part = np.zeros((len(inputs), 3))
            part[mine] = turn.T
            found[name] = replace(node, turns=sum(part.shape[1] for part in parts) // 3)
            parts.append(part)
    return np.hstack(parts), found


def _is_free(model: ReducedModel) -> bool:
    """Return whether a body moves in all six rigid motions without strain."""
    if len(model.mass) < 6:
        return False
    squared = scipy.linalg.eigh(model.stiffness, model.mass, eigvals_only=True)
    return bool(squared[5] <= _FREE * max(squared[-1], 0.0))


def _model(
    name: str, mass: Array, stiffness: Array, damping: Array, inputs: Array, rows: Array
) -> ReducedModel:
    return ReducedModel(
        name=name,
        method="body",
        mass=mass,
        stiffness=stiffness,
        damping_matrix=damping,
        inputs=np.ascontiguousarray(inputs),
        surface=rows,
        seconds=0.0,
        surface_nodes=np.zeros(0, dtype=np.int64),
        surface_weights=np.zeros(0),
        **_marks(inputs.shape[1] // 3),
    )


def _marks(groups: int) -> dict[str, Any]:
    """Return the interfaces of a model whose groups have places in `Body.nodes`."""
    return {"nodes": np.zeros((groups, 3)), "interfaces": np.arange(groups)}


def _cross(vector: Array) -> Array:
    """Return the matrix whose product with a vector is the cross product with it."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
