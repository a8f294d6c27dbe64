"""A flexible body in its own frame: integrals over its mass, and elasticity. SI units.

A material point is at x + Phi q in the frame of the body: x where it is without deformation, Phi q the small
linear deformation. Finite elements interpolate positions as they interpolate displacements, so sums over
nodes are the exact integrals over the mass, and all inertia terms follow from one matrix of them.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, FiniteElementModel

# Cross product of unit vectors: (a x b)_i = CROSS[i, j, k] a_j b_k.
CROSS = np.zeros((3, 3, 3))
CROSS[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
CROSS[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = -1.0


@dataclass(frozen=True)
class FlexibleBody:
    """Mass integrals and elasticity of one body in its own frame.

    Attributes
    ----------
    integrals : ndarray, shape (4 + 3 r, 4 + 3 r)
        Integrals over the mass of products of 1, x, y, z and the x, y, z parts of each shape.
    stiffness, damping : ndarray, shape (r, r)
        Of the shapes, N/m and N s/m per unit of the coordinates.
    """

    integrals: Array
    stiffness: Array
    damping: Array

    @property
    def order(self) -> int:
        """Number r of shapes."""
        return len(self.stiffness)


def flexible_body(
    points: Array, mass: Any, shapes: Array, stiffness: Array, damping: Array | None = None
) -> FlexibleBody:
    """Return the body that nodes, their mass and shapes of deformation make.

    Parameters
    ----------
    points : ndarray, shape (N, 3)
        m, in the frame of the body.
    mass : ndarray or sparse array, shape (N, N)
        Mass between nodes, kg, the same in every direction.
    shapes : ndarray, shape (N, 3, r)
        Displacements of the nodes; for `fly`, no combination of them may be a rigid motion. Modes (orthogonal
        in mass and stiffness) integrate fastest and most exactly.
    stiffness, damping : ndarray, shape (r, r)
        No damping if left out.

    Raises
    ------
    UserError
        If the shapes do not fit the points, or a number is not finite.
    """
    count, order = len(points), shapes.shape[-1]
    zero = np.zeros((order, order))
    body_stiffness = np.asarray(stiffness, dtype=np.float64)
    rates = zero if damping is None else np.asarray(damping, dtype=np.float64)
    given = (points.shape, np.shape(mass), shapes.shape, body_stiffness.shape, rates.shape)
    if given != ((count, 3), (count, count), (count, 3, order), zero.shape, zero.shape):
        raise UserError(
            f"points, mass, shapes, stiffness and damping of a flexible body have shapes {given} that do not "
            "fit; they are (N, 3), (N, N), (N, 3, r), (r, r) and (r, r)"
        )
    fields = np.concatenate(
        [np.ones((count, 1)), points, shapes.transpose(0, 2, 1).reshape(count, -1)], axis=1
    )
    integrals = fields.T @ np.asarray(mass @ fields)
    if not all(np.isfinite(part).all() for part in (integrals, body_stiffness, rates)):
        raise UserError("a flexible body has values that are not finite")
    return FlexibleBody(0.5 * (integrals + integrals.T), body_stiffness, rates)


def from_model(model: FiniteElementModel, shapes: Array) -> FlexibleBody:
    """Return the flexible body of a finite-element model and some displacement shapes.

    Parameters
    ----------
    model : FiniteElementModel
        Free in all directions at every node that has mass.
    shapes : ndarray, shape (n, r)
        Elastic modes, for example; columns over the degrees of freedom.
    """
    places = [np.flatnonzero(model.dof_direction == direction) for direction in range(3)]
    nodes = model.dof_node[places[0]]
    if any(not np.array_equal(model.dof_node[place], nodes) for place in places):
        raise UserError(f"the model {model.name} is held somewhere; a floating frame needs a free body")
    masses = [model.mass[place][:, place] for place in places]
    if any(abs(other - masses[0]).max() > 1e-9 * abs(masses[0]).max() for other in masses[1:]):
        raise UserError(f"the mass of the model {model.name} differs between x, y and z")
    moved = np.stack([shapes[place] for place in places], axis=1)
    return flexible_body(
        model.nodes[nodes],
        masses[0],
        moved,
        shapes.T @ (model.stiffness @ shapes),
        shapes.T @ (model.damping_matrix @ shapes),
    )


def position_fields(q: Array) -> Array:
    """Fields (4 + 3 r, 3) whose combination is the deformed position in body axes."""
    return np.vstack([np.zeros(3), np.eye(3), np.kron(q[:, None], np.eye(3))])


def velocity_fields(q: Array) -> Array:
    """Velocity fields (3, 4 + 3 r, 6 + r): x, y, z parts of unit translations, spins and shape rates."""
    order = len(q)
    fields = np.zeros((3, 4 + 3 * order, 6 + order))
    here, shape = np.arange(3), np.arange(order)
    fields[here, 0, here] = 1.0
    fields[:, :, 3:6] = np.einsum("ijk,fk->ifj", CROSS, position_fields(q))
    for axis in range(3):
        fields[axis, 4 + 3 * shape + axis, 6 + shape] = 1.0
    return fields


def mass_matrix(body: FlexibleBody, velocities: Array) -> Array:
    """Mass matrix (6 + r, 6 + r) of Störkle 2018, Eq. 2.11, from velocity fields."""
    result: Array = np.sum(velocities.transpose(0, 2, 1) @ (body.integrals @ velocities), axis=0)
    return result
