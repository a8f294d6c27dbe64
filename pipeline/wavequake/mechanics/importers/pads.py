"""Pads: areas of nodes that carry a body as one interface each.

A pad is ``average`` where its displacement is the mean over its nodes, weighted by their shares of the area
(RBE3 of Nastran, a remote point with deformable behavior): it stiffens nothing. It is ``rigid`` where all
its nodes move as one rigid body (RBE2). Either becomes a node of its own at the center of the area.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.sparse import coo_array, csc_array

from wavequake.errors import UserError
from wavequake.mechanics.importers.areas import area_shares
from wavequake.mechanics.importers.entries import Array, Integers
from wavequake.mechanics.importers.mesh import MeshFile
from wavequake.mechanics.model import FiniteElementModel, places, rigid_modes

PadKind = Literal["average", "rigid"]


def with_pads(
    model: FiniteElementModel, grid: MeshFile, pads: Sequence[Integers], kind: PadKind
) -> FiniteElementModel:
    """Return the model with one interface node for each pad, after the nodes of the mesh.

    Parameters
    ----------
    model : FiniteElementModel
    grid : MeshFile
        Its mesh.
    pads : sequence of ndarray of int
        Nodes of each pad, by their places. A pad of one node is that node.
    kind : {"average", "rigid"}

    Raises
    ------
    UserError
        If pads share nodes, a rigid pad has optical nodes, all nodes of a pad are optical, or those of a
        rigid pad lie on a line.
    """
    areas = [nodes for nodes in pads if len(nodes) > 1]
    together = np.concatenate([*pads])
    values, counts = np.unique(together, return_counts=True)
    if (counts > 1).any():
        node = grid.labels[values[np.argmax(counts > 1)]]
        raise UserError(f"node {node} is in two pads; each pad needs nodes of its own")
    change = _rigid if kind == "rigid" else _average
    interfaces = []
    for nodes in pads:
        if len(nodes) == 1:
            interfaces.append(int(nodes[0]))
            continue
        shares = _shares(grid, nodes)
        interfaces.append(len(model.nodes))
        model = replace(model, nodes=np.vstack([model.nodes, shares @ model.nodes[nodes]]))
        model = change(model, grid, nodes, shares)
    return replace(model, interfaces=np.array(interfaces, dtype=np.int64)) if areas else model


def _shares(grid: MeshFile, nodes: Integers) -> Array:
    try:
        return area_shares(grid, nodes)
    except UserError:  # they span no area
        return np.full(len(nodes), 1.0 / len(nodes))


def _average(model: FiniteElementModel, grid: MeshFile, nodes: Integers, shares: Array) -> FiniteElementModel:
    """Put the mean in the place of the displacements of one node of the pad, which is not an optical one."""
    allowed = ~np.isin(nodes, model.surface_nodes)
    if not allowed.any():
        raise UserError(f"all nodes of the pad of node {grid.labels[nodes[0]]} are optical nodes")
    given = int(np.argmax(np.where(allowed, shares, 0.0)))
    size = model.order
    rows, columns, values = [np.arange(size)], [np.arange(size)], [np.ones(size)]
    node, direction = model.dof_node.copy(), model.dof_direction.copy()
    for at in places(model)[nodes, :3].T:
        pivot = at[given]
        others = np.delete(at, given)
        # u_pivot = (mean - sum of the others' shares) / its share
        values[0][pivot] = 1.0 / shares[given]
        rows.append(np.full(len(others), pivot))
        columns.append(others)
        values.append(-np.delete(shares, given) / shares[given])
        node[pivot] = len(model.nodes) - 1
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    turn = csc_array(coo_array(entries, shape=(size, size)))
    return _changed(model, turn, node, direction)


def _rigid(model: FiniteElementModel, grid: MeshFile, nodes: Integers, shares: Array) -> FiniteElementModel:
    """Put displacement and rotation of the pad in the place of all degrees of freedom of its nodes."""
    optical = nodes[np.isin(nodes, model.surface_nodes)]
    if len(optical):
        raise UserError(f"node {grid.labels[optical[0]]} of a rigid pad is an optical node as well")
    arms = model.nodes[nodes] - model.nodes[-1]
    spread = np.linalg.svd(arms, compute_uv=False)
    if len(nodes) < 3 or spread[1] < 1e-9 * spread[0]:
        raise UserError(
            f"the pad of node {grid.labels[nodes[0]]} spans no area, so it has no rotations; take three "
            "nodes that are not on a line, or pads = 'average'"
        )
    motions = np.concatenate(
        [rigid_modes(arms, np.zeros(3)).reshape(-1, 3, 6), np.tile(np.eye(6)[3:], (len(nodes), 1, 1))], axis=1
    )
    at = places(model)[nodes]
    moved = at >= 0
    kept = np.setdiff1d(np.arange(model.order), at[moved])
    rows = np.concatenate([kept, np.repeat(at[moved], 6)])
    columns = np.concatenate([np.arange(len(kept)), np.tile(len(kept) + np.arange(6), int(moved.sum()))])
    values = np.concatenate([np.ones(len(kept)), motions[moved].ravel()])
    turn = csc_array(coo_array((values, (rows, columns)), shape=(model.order, len(kept) + 6)))
    node = np.concatenate([model.dof_node[kept], np.full(6, len(model.nodes) - 1)])
    direction = np.concatenate([model.dof_direction[kept], np.arange(6)])
    return _changed(model, turn, node, direction)


def _changed(
    model: FiniteElementModel, turn: csc_array, node: Integers, direction: Integers
) -> FiniteElementModel:
    mass, stiffness = (csc_array(turn.T @ matrix @ turn) for matrix in (model.mass, model.stiffness))
    return replace(model, mass=mass, stiffness=stiffness, dof_node=node, dof_direction=direction)
