"""Beams and shells of CalculiX, which it expands to solids: a node of the deck is several in its matrices.

Its ``.dof`` lists the displacements of all nodes of the expansion by the number of the node that they come
from (CalculiX CrunchiX user's manual, sections on beam and shell elements). The mean of these is the
displacement of the beam's axis or of the shell's middle; it takes the place of the first, and the others
become inner coordinates, their distances from the mean. Where beams or shells meet at an angle the program
adds nodes of its own, for rotations; they are inner coordinates too.
"""

import numpy as np
from scipy.sparse import coo_array, csc_array

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Entries, Integers

INNER = (-1, 0)
"""Node and direction of a coordinate that belongs to no node."""


def real_part(entries: Entries, count: int) -> Entries:
    """Return the matrix of a sector that moves as all others do, from the one of cyclic symmetry.

    Such matrices have the real part of `count` displacements and then their imaginary part.

    Raises
    ------
    UserError
        If both parts are coupled: the sectors move with a phase, and one sector is no body.
    """
    mixed = (entries.rows < count) != (entries.columns < count)
    if entries.values[mixed].any():
        raise UserError(
            f"{entries.source} is of a sector of cyclic symmetry whose neighbors move with a phase (nodal "
            "diameters above 0); write the matrices of the whole body, without *CYCLIC SYMMETRY MODEL"
        )
    kept = (entries.rows < count) & (entries.columns < count)
    rows, columns = entries.rows[kept], entries.columns[kept]
    return Entries(entries.source, rows, columns, entries.values[kept], count, entries.one_triangle)


def refuse_repeated(table: Integers, expanded: Integers | None, source: str) -> None:
    """Refuse degrees of freedom listed twice, unless at the nodes of beams and shells that are expanded."""
    _, first, count = np.unique(table, axis=0, return_index=True, return_counts=True)
    again = np.sort(first[(count > 1) & (table[first, 1] != 0)])
    if expanded is not None:
        again = again[~np.isin(table[again, 0], expanded)]
    if len(again):
        node, direction = table[again[0]]
        raise UserError(f"{source} lists node {node}, direction {direction} twice")


def averaged(
    stiffness: csc_array, mass: csc_array, table: Integers, known: Integers, notes: list[str]
) -> tuple[csc_array, csc_array, Integers]:
    """Return matrices and degrees of freedom with one displacement per node; see the module.

    `known` are the nodes of the deck. A node has its three displacements in a row for each node of its
    expansion. Where constraints have taken some of them (supports, loads), the mean is not known, and all are
    inner coordinates.
    """
    size = len(table)
    added = ~np.isin(table[:, 0], known)
    table = np.where(added[:, None], INNER, table)
    if added.any():
        notes.append(
            f"{int(added.sum())} degrees of freedom of nodes that CalculiX adds are inner coordinates"
        )
    _, owner, count = np.unique(table, axis=0, return_inverse=True, return_counts=True)
    repeated = np.unique(table[(count[owner] > 1) & ~added, 0])
    if not len(repeated):
        return stiffness, mass, table
    rows, columns, values = [np.arange(size)], [np.arange(size)], [np.ones(size)]
    unknown = []
    for node in repeated:
        places = np.flatnonzero(table[:, 0] == node)
        triples = places[: len(places) // 3 * 3].reshape(-1, 3)
        complete = 3 * len(triples) == len(places) and bool(
            (np.diff(triples, axis=1) == 1).all() and (table[triples, 1] == (1, 2, 3)).all()
        )
        if not complete:
            unknown.append(int(node))
            table[places] = INNER
            continue
        first, others = triples[0], triples[1:]
        rows += [others.ravel(), np.tile(first, len(others))]  # u = mean + d, of the first: mean - sum of d
        columns += [np.tile(first, len(others)), others.ravel()]
        values += [np.ones(others.size), -np.ones(others.size)]
        table[others.ravel()] = INNER
    joined = (np.concatenate(parts) for parts in (values, rows, columns))
    entries, at, of = joined
    turn = csc_array(coo_array((entries, (at, of)), shape=(size, size)))
    notes.append(
        f"{len(repeated)} nodes of beams or shells are several in the matrices and move by the mean of these"
        + (f" (unknown at {describe_nodes(unknown)})" if unknown else "")
    )
    return csc_array(turn.T @ stiffness @ turn), csc_array(turn.T @ mass @ turn), table


def describe_nodes(nodes: list[int]) -> str:
    """Return ``node 7`` or ``nodes 7, 9 ...``: the first few."""
    listed = ", ".join(map(str, nodes[:5])) + (" ..." if len(nodes) > 5 else "")
    return f"node{'s' if len(nodes) > 1 else ''} {listed}"
