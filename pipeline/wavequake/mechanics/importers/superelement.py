"""External superelements of Nastran (EXTSEOUT): matrices in ``.op4``, what their rows are in ``.pch``.

The punch file lists the rows in cards EXTRN (points and their components; SPOINT with component 0 are the
coordinates of modes) and the boundary points in cards GRID, whose displacements may stand in axes of their
own, CORD2R (MSC Nastran Quick Reference Guide).
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.importers import bulk
from wavequake.mechanics.importers.bulk import Card, axes_at, basic, real
from wavequake.mechanics.importers.entries import Array, Contents, Entries, Integers, whole_lines


def with_rows(contents: Contents, path: Path) -> Contents:
    """Return the matrices of an ``.op4`` file with what the punch file beside it says of their rows.

    Without such a file, or cards EXTRN in it, they stay as they are.

    Raises
    ------
    UserError
        If the cards cannot be read, or points stand in axes that are not supported.
    """
    punch = path.with_suffix(".pch")
    if not punch.is_file():
        return contents
    whole_lines(punch)
    cards = [[card.name, *card.fields] for card in bulk.cards(punch)]
    table = _rows([card for card in cards if card[0] == "EXTRN"], punch.name)
    if not len(table):
        return contents
    axes = {
        card[1]: Card(card[0], [*card[1:], *[""] * 11], 0)
        for card in cards
        if card[0] in ("CORD2R", "CORD2C", "CORD2S")
    }
    grids = [card for card in cards if card[0] == "GRID"]
    if bad := [card[1] for card in grids if not card[1].isdecimal()]:
        raise UserError(f"{punch.name}: {bad[0]!r} is not the number of a point (card GRID)")
    numbers = np.array([int(card[1]) for card in grids], dtype=np.int64)
    places = np.array([[real(word, punch.name) for word in card[3:6]] for card in grids]).reshape(-1, 3)
    points = np.array(
        [basic(place[None], card[2], axes, punch.name)[0] for card, place in zip(grids, places, strict=True)]
    ).reshape(-1, 3)
    if missing := sorted(set(table[table[:, 1] > 0, 0]) - set(numbers.tolist())):
        raise UserError(f"{punch.name} has no GRID card of point {missing[0]}, which its card EXTRN lists")
    turn = np.eye(len(table))
    for card, point in zip(grids, points, strict=True):
        frame = card[6] if len(card) > 6 and card[6] else "0"
        if frame == "0":
            continue
        if frame not in axes:
            raise UserError(f"{punch.name}: point {card[1]} moves in the axes {frame}, which are no CORD2R")
        own = axes_at(point[None], frame, axes, punch.name)[0]
        for first in (1, 4):
            rows = _triple(table, int(card[1]), first, punch.name)
            if len(rows):
                turn[np.ix_(rows, rows)] = own
    matrices = {
        name: _turned(entries, turn) if entries.size == len(table) else entries
        for name, entries in contents.matrices.items()
    }
    return replace(contents, matrices=matrices, dofs=table, node_numbers=numbers, coordinates=points)


def _triple(table: Integers, node: int, first: int, source: str) -> Integers:
    """Return the rows of a point's displacements (first 1) or rotations (first 4), none if it has none."""
    rows = np.flatnonzero((table[:, 0] == node) & (table[:, 1] >= first) & (table[:, 1] < first + 3))
    if len(rows) not in (0, 3):
        raise UserError(f"{source}: point {node} has axes of its own and not all three directions")
    return rows[np.argsort(table[rows, 1])]


def _turned(entries: Entries, turn: Array) -> Entries:
    """Return a matrix in the axes of the coordinates; superelements are small, so it may be dense."""
    dense = np.zeros(turn.shape)
    dense[entries.rows, entries.columns] = entries.values
    if entries.one_triangle and not (
        dense[np.tril_indices(len(dense), -1)].any() and np.triu(dense, 1).any()
    ):
        dense = dense + dense.T - np.diag(dense.diagonal())
    dense = turn @ dense @ turn.T
    rows, columns = dense.nonzero()
    return Entries(entries.source, rows, columns, dense[rows, columns], len(dense), True)


def _rows(cards: list[list[str]], source: str) -> Integers:
    rows = []
    for card in cards:
        words = [word for word in card[1:] if word]
        if len(words) % 2:
            raise UserError(
                f"{source}: point {words[-1]} has no components (card EXTRN); is the file cut off?"
            )
        for node, components in zip(words[::2], words[1::2], strict=True):
            if not (node.isdigit() and components.isdigit()):
                raise UserError(f"{source}: {node!r} with {components!r} is no row (card EXTRN)")
            rows += [(int(node), int(component)) for component in components]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)
