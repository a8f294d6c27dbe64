"""Checks that every imported model passes: its matrices are complete and symmetric, its rows free."""

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import DIRECTIONS, Entries, Integers

Triangle = Literal["upper", "lower"]

ASYMMETRY = 1e-8
"""Largest difference of symmetric entries, over the largest entry, that still counts as round-off."""

FIXED = 1e30
"""A diagonal stiffness from here on (Abaqus writes 1e36) stands for a fixed degree of freedom."""


def assemble(entries: Entries, dofs: Integers, declared: Triangle | None = None) -> csc_array:
    """Return the full symmetric matrix of a file's entries, in the order of `dofs`.

    Parameters
    ----------
    entries : Entries
    dofs : ndarray of int, shape (n, 2)
        Node number and direction of each row.
    declared : {"upper", "lower"}, optional
        The triangle that stands for the matrix where its format does not say so.

    Raises
    ------
    UserError
        For a value that is not finite, an entry outside the matrix or given twice, a wrong size, a triangle
        that nobody declared, or a matrix that is not symmetric; all say where.
    """
    _finite(entries)
    rows, columns = _positions(entries, dofs)
    size = len(dofs)
    values, kept = entries.values, entries.values != 0.0
    rows, columns, values = rows[kept], columns[kept], values[kept]
    matrix = csc_array(coo_array((values, (rows, columns)), shape=(size, size)))
    if matrix.nnz < len(values):
        _refuse_duplicates(entries.source, rows, columns, dofs)
    upper, lower = bool((rows < columns).any()), bool((rows > columns).any())
    if not (upper or lower):
        return matrix
    if upper != lower:
        _require_declared(entries, "upper" if upper else "lower", declared)
        return _mirrored(matrix)
    if entries.one_triangle and not _paired(rows, columns, size):
        return _mirrored(matrix)
    return _symmetric(matrix, entries.source, dofs)


def _require_declared(entries: Entries, side: Triangle, declared: Triangle | None) -> None:
    """Refuse a triangle that neither the format nor the user says to be one."""
    if declared is None and not entries.one_triangle:
        raise UserError(
            f"{entries.source} holds the {side} triangle only, and its format does not say that it is "
            f"symmetric; write the whole matrix, or say triangle = '{side}'"
        )
    if declared not in (None, side):
        raise UserError(f"{entries.source} holds the {side} triangle, but triangle = '{declared}'")


def _finite(entries: Entries) -> None:
    bad = np.flatnonzero(~np.isfinite(entries.values))
    if len(bad):
        raise UserError(
            f"{entries.source}: entry {bad[0] + 1} is {entries.values[bad[0]]}; {len(bad)} of "
            f"{len(entries.values)} entries are not finite"
        )


def _positions(entries: Entries, dofs: Integers) -> tuple[Integers, Integers]:
    """Return rows and columns as positions in `dofs`."""
    if entries.size is not None:
        if entries.size != len(dofs):
            raise UserError(
                f"{entries.source} has {entries.size} rows, but there are {len(dofs)} degrees of freedom; "
                "both must come from one analysis"
            )
        for places in (entries.rows, entries.columns):
            if len(places) and not 0 <= places.min() <= places.max() < entries.size:
                raise UserError(f"{entries.source} has entries outside 1..{entries.size}")
        return entries.rows, entries.columns
    keys = DIRECTIONS * dofs[:, 0] + dofs[:, 1]
    order = np.argsort(keys)
    found = []
    for labels in (entries.rows, entries.columns):
        place = np.minimum(np.searchsorted(keys[order], labels), len(keys) - 1)
        missing = np.flatnonzero(keys[order][place] != labels)
        if len(missing):
            node, direction = divmod(int(labels[missing[0]]), DIRECTIONS)
            raise UserError(
                f"{entries.source}: node {node}, direction {direction} is no degree of freedom here"
            )
        found.append(order[place])
    return found[0], found[1]


def describe(dofs: Integers, index: int) -> str:
    """Return ``node 7, direction 2`` for a row of `dofs`."""
    return f"node {dofs[index, 0]}, direction {dofs[index, 1]}"


def _refuse_duplicates(source: str, rows: Integers, columns: Integers, dofs: Integers) -> None:
    pairs = rows * np.int64(len(dofs)) + columns
    order = np.argsort(pairs, kind="stable")
    again = order[1:][np.diff(pairs[order]) == 0]
    row, column = int(rows[again[0]]), int(columns[again[0]])
    raise UserError(
        f"{source} gives {len(again)} entries more than once, the first at row {row + 1}, "
        f"column {column + 1} ({describe(dofs, row)}; {describe(dofs, column)}); each may stand there once"
    )


def _paired(rows: Integers, columns: Integers, size: int) -> bool:
    """Tell whether some entry off the diagonal is given on both sides of it."""
    low, high = np.minimum(rows, columns), np.maximum(rows, columns)
    return bool(csc_array(coo_array((np.ones(len(rows)), (low, high)), shape=(size, size))).nnz < len(rows))


def _mirrored(triangle: csc_array) -> csc_array:
    return csc_array(triangle + triangle.T - diags_array(triangle.diagonal(), format="csc"))


def _symmetric(matrix: csc_array, source: str, dofs: Integers) -> csc_array:
    """Return the mean of a matrix and its transpose if they agree up to round-off."""
    difference = coo_array(abs(matrix - matrix.T))
    if not difference.nnz:
        return matrix
    worst, scale = int(np.argmax(difference.data)), float(abs(matrix).max())
    if difference.data[worst] > ASYMMETRY * scale:
        row, column = (int(place[worst]) for place in difference.coords)
        raise UserError(
            f"{source} is not symmetric: the entries at ({describe(dofs, row)}) x ({describe(dofs, column)}) "
            f"are {matrix[row, column]:.6g} and {matrix[column, row]:.6g}; gyroscopic, follower-load and "
            "friction terms are not supported"
        )
    return csc_array((matrix + matrix.T) / 2)


def free_dofs(
    stiffness: csc_array, mass: csc_array, dofs: Integers, notes: list[str], drop: bool
) -> Integers:
    """Return the rows that are free displacements; fixed ones are left out with a note.

    A row is fixed if both matrices are empty there or its stiffness is beyond physics (`FIXED`). Empty
    displacements need `drop`; rotations of solid elements are always empty.

    Raises
    ------
    UserError
        For empty displacements, unknown directions, a negative diagonal, a displacement with mass and no
        stiffness, and where nothing is free.
    """
    with_stiffness, with_mass = (abs(matrix).sum(axis=0) > 0.0 for matrix in (stiffness, mass))
    empty, moves = ~(with_stiffness | with_mass), (dofs[:, 1] >= 1) & (dofs[:, 1] <= 3)
    fixed = empty | (stiffness.diagonal() >= FIXED)
    if fixed.all():
        raise UserError("every degree of freedom is fixed or empty, so nothing can move")
    if not drop:
        _refuse_empty(empty & moves, dofs)
    refuse(
        (dofs[:, 1] < 0) | (dofs[:, 1] > 6),
        dofs,
        lambda index: (
            f"{describe(dofs, index)} is none: directions are 1 to 3 (displacements), 4 to 6 (rotations) "
            "and 0 (a coordinate of its own)"
        ),
    )
    for name, matrix in (("stiffness", stiffness), ("mass", mass)):
        refuse(
            ~fixed & (matrix.diagonal() < 0.0),
            dofs,
            lambda index, name=name: f"the {name} at {describe(dofs, index)} is negative",  # type: ignore[misc]
        )
    refuse(
        ~fixed & ~with_stiffness,
        dofs,
        lambda index: f"{describe(dofs, index)} has mass but no stiffness: it is attached to nothing",
    )
    for left_out, what in ((fixed & moves, "fixed degrees of freedom"), (fixed & ~moves, "empty rotations")):
        if left_out.any():
            notes.append(f"{int(left_out.sum())} {what} were left out ({_nodes(left_out, dofs)})")
    return np.flatnonzero(~fixed)


def _refuse_empty(empty: NDArray[np.bool_], dofs: Integers) -> None:
    refuse(
        empty,
        dofs,
        lambda index: (
            f"{int(empty.sum())} degrees of freedom have empty rows in stiffness and mass, the first at "
            f"{describe(dofs, index)} ({_nodes(empty, dofs)}); if they are fixed say zero_rows = 'drop', "
            "otherwise their elements are missing"
        ),
    )


def _nodes(chosen: NDArray[np.bool_], dofs: Integers) -> str:
    """Return ``nodes 3, 8 ...``: the first few nodes of some rows of `dofs`."""
    nodes = np.unique(dofs[chosen, 0])
    return f"nodes {', '.join(map(str, nodes[:5]))}{' ...' if len(nodes) > 5 else ''}"


def refuse(bad: NDArray[np.bool_], dofs: Integers, sentence: Callable[[int], str]) -> None:
    """Raise the sentence about the first bad row, if there is one."""
    if np.any(bad):
        raise UserError(sentence(int(np.argmax(bad))))
