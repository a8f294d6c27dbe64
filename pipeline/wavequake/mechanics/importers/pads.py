"""Pads: areas of nodes that carry a body as one interface each.

A pad is ``average`` where its displacement is the mean over its nodes, weighted by their shares of the area
(RBE3 of Nastran, a remote point with deformable behavior): it stiffens nothing. It is ``rigid`` where all
its nodes move as one rigid body (RBE2). Either becomes a node of its own at the center of the area, with its
displacement, or with its rotation, too.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import scipy  # its parts load when first used
from scipy.sparse import coo_array, csc_array

from wavequake.errors import UserError
from wavequake.mechanics.importers.areas import area_shares
from wavequake.mechanics.importers.entries import Array, Integers
from wavequake.mechanics.importers.mesh import MeshFile
from wavequake.mechanics.model import FiniteElementModel, places, rigid_modes

_DEPENDENT = 1e-9

PadKind = Literal["average", "rigid"]
PadDofs = Literal[3, 6]


def with_pads(
    model: FiniteElementModel, grid: MeshFile, pads: Sequence[Integers], kind: PadKind, dofs: PadDofs = 3
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
    dofs : {3, 6}
        Of each pad, its displacement, and with 6 its rotation about its center, too: interfaces are the
        displacements of all pads, then their rotations. A rigid pad can turn in any case.

    Raises
    ------
    UserError
        If pads share nodes, a rigid pad has optical nodes, an average one too many, or the nodes of a pad
        that turns lie on a line.
    """
    together = np.concatenate([*pads])
    values, counts = np.unique(together, return_counts=True)
    if (counts > 1).any():
        node = grid.labels[values[np.argmax(counts > 1)]]
        raise UserError(f"node {node} is in two pads; each pad needs nodes of its own")
    interfaces = []
    for nodes in pads:
        if len(nodes) == 1:
            interfaces.append(int(nodes[0]))
            if dofs == 6 and (places(model)[nodes, 3:] < 0).any():
                raise UserError(
                    f"the pad of node {grid.labels[nodes[0]]} is this node alone, which has no rotations; "
                    "name a set of three nodes that are not on a line, or pad_dofs = 3"
                )
            continue
        shares = _shares(grid, nodes)
        interfaces.append(len(model.nodes))
        model = replace(model, nodes=np.vstack([model.nodes, shares @ model.nodes[nodes]]))
        model = _rigid(model, grid, nodes) if kind == "rigid" else _average(model, grid, nodes, shares, dofs)
    turns = range(len(pads), len(pads) * dofs // 3)
    return replace(
        model,
        interfaces=np.array(interfaces * (dofs // 3), dtype=np.int64),
        turns=np.array(turns, dtype=np.int64),
    )


def _shares(grid: MeshFile, nodes: Integers) -> Array:
    try:
        return area_shares(grid, nodes)
    except UserError:  # they span no area
        return np.full(len(nodes), 1.0 / len(nodes))


def _average(
    model: FiniteElementModel, grid: MeshFile, nodes: Integers, shares: Array, dofs: PadDofs
) -> FiniteElementModel:
    """Put the pad's motion in the place of as many displacements of its nodes, none of them optical.

    The motion is the rigid one that fits the displacements of all nodes best, weighted by their shares: about
    the center its displacement is their mean.
    """
    arms = model.nodes[nodes] - model.nodes[-1]
    if dofs == 6:
        _require_area(grid, nodes, arms)
    rigid = rigid_modes(arms, np.zeros(3))[:, :dofs]
    weighted = rigid * np.repeat(shares, 3)[:, None]
    fit = np.linalg.solve(weighted.T @ rigid, weighted.T)  # motion = fit @ displacements
    at = places(model)[nodes, :3].ravel()
    size = np.linalg.norm(fit, axis=1, keepdims=True)
    allowed = np.flatnonzero(~np.isin(np.repeat(nodes, 3), model.surface_nodes))
    _, triangle, order = scipy.linalg.qr((fit / size)[:, allowed], mode="economic", pivoting=True)
    pivots = np.abs(np.diag(triangle))
    if len(pivots) < dofs or pivots[-1] < _DEPENDENT:
        count = "all" if not len(allowed) else "too many"
        raise UserError(f"{count} nodes of the pad of node {grid.labels[nodes[0]]} are optical nodes")
    given = allowed[order[:dofs]]
    others = np.setdiff1d(np.arange(len(at)), given)
    # fit_given u_given + fit_others u_others = motion
    inverse = np.linalg.inv(fit[:, given])
    values = np.hstack([inverse, -inverse @ fit[:, others]])
    kept = np.setdiff1d(np.arange(model.order), at[given])
    columns = np.concatenate([at[given], at[others]])
    rows = np.concatenate([kept, np.repeat(at[given], len(at))])
    entries = (
        np.concatenate([np.ones(len(kept)), values.ravel()]),
        (rows, np.concatenate([kept, np.tile(columns, dofs)])),
    )
    turn = csc_array(coo_array(entries, shape=(model.order, model.order)))
    node, direction = model.dof_node.copy(), model.dof_direction.copy()
    node[at[given]], direction[at[given]] = len(model.nodes) - 1, np.arange(dofs)
    return _changed(model, turn, node, direction)


def _require_area(grid: MeshFile, nodes: Integers, arms: Array) -> None:
    spread = np.linalg.svd(arms, compute_uv=False)
    if len(nodes) < 3 or spread[1] < 1e-9 * spread[0]:
        raise UserError(
            f"the pad of node {grid.labels[nodes[0]]} spans no area, so it has no rotations; take three "
            "nodes that are not on a line, or pads = 'average' with pad_dofs = 3"
        )


def _rigid(model: FiniteElementModel, grid: MeshFile, nodes: Integers) -> FiniteElementModel:
    """Put displacement and rotation of the pad in the place of all degrees of freedom of its nodes."""
    optical = nodes[np.isin(nodes, model.surface_nodes)]
    if len(optical):
        raise UserError(f"node {grid.labels[optical[0]]} of a rigid pad is an optical node as well")
    arms = model.nodes[nodes] - model.nodes[-1]
    _require_area(grid, nodes, arms)
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
