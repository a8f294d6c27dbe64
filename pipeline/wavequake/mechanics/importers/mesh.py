"""Node coordinates, node sets and elements of a mesh file: ``.inp`` decks and whatever meshio reads."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Array, Integers, read_bytes
from wavequake.mechanics.importers.inp import read_deck

EXPANDED = ("line", "line3", "triangle", "triangle6", "quad", "quad8")
"""Elements (by meshio's names) that CalculiX expands to solids."""


@dataclass(frozen=True)
class MeshFile:
    """Nodes of a mesh file, in the file's unit of length.

    Attributes
    ----------
    source : str
    labels : ndarray of int, shape (N,)
        Node numbers.
    points : ndarray, shape (N, 3)
    sets : mapping of str to ndarray of int
        Node numbers of each named set.
    cells : mapping of str to ndarray of int, shape (M, nodes of the element)
        Node numbers of the elements, by meshio's names of their kinds.
    """

    source: str
    labels: Integers
    points: Array
    sets: Mapping[str, Integers] = field(default_factory=dict)
    cells: Mapping[str, Integers] = field(default_factory=dict)

    @property
    def expanded(self) -> Integers:
        """Numbers of the nodes of beams, shells and plane elements."""
        nodes = [self.cells[kind].ravel() for kind in EXPANDED if kind in self.cells]
        return np.unique(np.concatenate(nodes)) if nodes else np.zeros(0, dtype=np.int64)


def read_mesh(path: Path) -> MeshFile:
    """Return nodes, sets and elements of a mesh file.

    A format without node numbers counts its nodes from 1. Sets of elements become sets of their nodes.

    Raises
    ------
    UserError
        If the file cannot be read, or coordinates are not finite.
    """
    deck = path.suffix.lower() == ".inp"
    mesh = MeshFile(path.name, *read_deck(path)) if deck else _through_meshio(path)
    bad = np.flatnonzero(~np.isfinite(mesh.points).all(axis=1))
    if len(bad):
        raise UserError(f"{path.name}: node {mesh.labels[bad[0]]} has no finite coordinates")
    if len(np.unique(mesh.labels)) < len(mesh.labels):
        raise UserError(f"{path.name} defines a node number twice")
    return mesh


def _through_meshio(path: Path) -> MeshFile:
    import meshio

    read_bytes(path)
    try:
        mesh = meshio.read(path)
    except (Exception, SystemExit) as error:  # meshio raises all sorts, and exits on some formats
        raise UserError(f"meshio cannot read {path.name}: {error}") from error
    points = np.zeros((len(mesh.points), 3))
    points[:, : mesh.points.shape[1]] = mesh.points
    given = getattr(mesh, "points_id", None)  # of Nastran decks
    labels = np.arange(1, len(points) + 1) if given is None else np.asarray(given, dtype=np.int64)
    cells: dict[str, list[Integers]] = {}
    for block in mesh.cells:
        cells.setdefault(block.type, []).append(labels[block.data])
    sets = {name: labels[np.asarray(nodes, dtype=np.int64)] for name, nodes in mesh.point_sets.items()}
    for name, nodes in _nodes_of_cell_sets(mesh).items():
        sets.setdefault(name, labels[nodes])
    joined = {name: np.concatenate(parts) for name, parts in cells.items() if name != "vertex"}
    return MeshFile(path.name, labels, points, sets, joined)


def _nodes_of_cell_sets(mesh: Any) -> dict[str, Integers]:
    """Return the nodes (from 0) of the named sets of elements, e.g. the physical groups of gmsh."""
    found: dict[str, list[Integers]] = {}
    for name, by_block in mesh.cell_sets.items():
        for block, chosen in zip(mesh.cells, by_block, strict=True):
            if chosen is not None and len(chosen) and not name.startswith("gmsh:"):
                found.setdefault(name, []).append(block.data[np.asarray(chosen, dtype=np.int64)].ravel())
    tags = mesh.cell_data.get("gmsh:physical", [])
    for name, (tag, dimension) in ((n, (int(v[0]), int(v[1]))) for n, v in mesh.field_data.items()):
        for block, physical in zip(mesh.cells, tags, strict=False):
            chosen = np.flatnonzero(np.asarray(physical) == tag)
            if block.dim == dimension and len(chosen):
                found.setdefault(name, []).append(block.data[chosen].ravel())
    return {name: np.unique(np.concatenate(parts)).astype(np.int64) for name, parts in found.items()}


def positions(mesh: MeshFile, labels: Integers, what: str) -> Integers:
    """Return where nodes of given numbers stand in the mesh.

    Raises
    ------
    UserError
        If the mesh has not all of them.
    """
    order = np.argsort(mesh.labels)
    place = np.minimum(np.searchsorted(mesh.labels[order], labels), len(order) - 1)
    missing = np.flatnonzero(mesh.labels[order][place] != labels)
    if len(missing):
        raise UserError(
            f"{mesh.source} has no coordinates of node {labels[missing[0]]} ({what}; {len(missing)} such "
            "nodes); it must be the mesh of the matrices"
        )
    return np.asarray(order[place], dtype=np.int64)


def chosen_nodes(mesh: MeshFile, choice: str | Sequence[int | str], what: str) -> Integers:
    """Return positions of the nodes of a set, or of several sets and node numbers, in the given order.

    Raises
    ------
    UserError
        For an unknown set (with the nearest name) or node, and if nothing is left.
    """
    parts = [choice] if isinstance(choice, str) else list(choice)
    by_name = {name.upper(): nodes for name, nodes in mesh.sets.items()}
    found = []
    for part in parts:
        if isinstance(part, str):
            if part.upper() not in by_name:
                raise UserError(_unknown(mesh, part, what))
            found.append(by_name[part.upper()])
        else:
            found.append(np.array([part], dtype=np.int64))
    labels = np.concatenate(found) if found else np.zeros(0, dtype=np.int64)
    if not len(labels):
        raise UserError(f"{what} is empty, at least one node is needed")
    _, first = np.unique(labels, return_index=True)
    return positions(mesh, labels[np.sort(first)], what)


def _unknown(mesh: MeshFile, name: str, what: str) -> str:
    near = difflib.get_close_matches(name.upper(), [known.upper() for known in mesh.sets], n=1, cutoff=0.4)
    names = ", ".join(sorted(mesh.sets)) or "none"
    hint = f", did you mean {near[0]}?" if near else f"; it has: {names}"
    return f"{mesh.source} has no node set {name!r} ({what}){hint}"
