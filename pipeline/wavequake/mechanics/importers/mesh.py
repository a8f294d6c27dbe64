"""Node coordinates, node sets and elements: decks (``.inp``, ``.bdf``) and whatever meshio reads."""

import difflib
import io
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.importers.bulk import read_bulk
from wavequake.mechanics.importers.entries import Array, Integers, read_bytes
from wavequake.mechanics.importers.inp import read_deck

BULK = (".bdf", ".nas", ".fem")
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
    turned : ndarray of int
        Numbers of nodes whose displacements stand in axes of their own.
    numbers : mapping of str to ndarray of int, shape (M,)
        Numbers of the elements of each kind.
    element_sets : mapping of str to ndarray of int
        Numbers of the elements of each named set, or of a property by its number (Nastran).
    """

    source: str
    labels: Integers
    points: Array
    sets: Mapping[str, Integers] = field(default_factory=dict)
    cells: Mapping[str, Integers] = field(default_factory=dict)
    turned: Integers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    numbers: Mapping[str, Integers] = field(default_factory=dict)
    element_sets: Mapping[str, Integers] = field(default_factory=dict)

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
        If the file cannot be read, coordinates are not finite, or an element stands on a node that it lacks.
    """
    suffix = path.suffix.lower()
    if suffix in BULK:
        deck = read_bulk(path)
        mesh = MeshFile(path.name, deck.labels, deck.points, {}, *deck[2:-1])
    else:
        mesh = _from_deck(path) if suffix == ".inp" else _through_meshio(path)
    bad = np.flatnonzero(~np.isfinite(mesh.points).all(axis=1))
    if len(bad):
        raise UserError(f"{path.name}: node {mesh.labels[bad[0]]} has no finite coordinates")
    if len(np.unique(mesh.labels)) < len(mesh.labels):
        raise UserError(f"{path.name} defines a node number twice")
    for name, cells in mesh.cells.items():
        for element, corner in np.argwhere(~np.isin(cells, mesh.labels))[:1]:
            number, node = mesh.numbers[name][element], cells[element, corner]
            raise UserError(f"{path.name}: element {number} stands on node {node}, which the file lacks")
    return mesh


def _from_deck(path: Path) -> MeshFile:
    try:
        deck = read_deck(path)
        return MeshFile(path.name, *deck[:4], numbers=deck.numbers, element_sets=deck.element_sets)
    except RecursionError:
        raise UserError(f"{path.name} includes itself") from None
    except (ValueError, OverflowError, IndexError, MemoryError) as error:
        raise UserError(f"{path.name} cannot be read ({error}); the file may be damaged") from None


def _require_end(data: bytes, path: Path) -> None:
    """Raise UserError for what meshio reads without end."""
    if path.suffix.lower() == ".msh" and re.search(rb"^\$[!-~]{200}", data, re.MULTILINE):
        raise UserError(f"{path.name} has a section whose name is longer than 200 characters")


def _through_meshio(path: Path) -> MeshFile:
    import meshio

    _require_end(read_bytes(path), path)
    said = io.StringIO()  # meshio prints what is wrong, and exits
    try:
        with redirect_stdout(said), redirect_stderr(said):
            # It would take .msh for a file of Fluent first, and read that without end where it is cut off.
            return _from_meshio(path, meshio.read(path, "gmsh" if path.suffix.lower() == ".msh" else None))
    except (Exception, SystemExit) as error:
        words = " ".join((said.getvalue() or str(error) or type(error).__name__).split())
        raise UserError(f"meshio cannot read {path.name}: {words}") from None


def _from_meshio(path: Path, mesh: Any) -> MeshFile:
    points = np.zeros((len(mesh.points), 3))
    points[:, : mesh.points.shape[1]] = mesh.points
    labels = np.arange(1, len(points) + 1)
    cells: dict[str, list[Integers]] = {}
    for block in mesh.cells:
        cells.setdefault(block.type, []).append(labels[block.data])
    sets = {name: labels[np.asarray(nodes, dtype=np.int64)] for name, nodes in mesh.point_sets.items()}
    for name, nodes in _nodes_of_cell_sets(mesh).items():
        sets.setdefault(name, labels[nodes])
    joined = {name: np.concatenate(parts) for name, parts in cells.items() if name != "vertex"}
    first = np.cumsum([1, *(len(block.data) for block in mesh.cells)])
    own: dict[str, list[Integers]] = {}
    for block, start in zip(mesh.cells, first[:-1], strict=True):
        own.setdefault(block.type, []).append(np.arange(start, start + len(block.data)))
    return MeshFile(
        path.name,
        labels,
        points,
        sets,
        joined,
        numbers={name: np.concatenate(parts) for name, parts in own.items()},
        element_sets=_cell_sets(mesh, first),
    )


def _cell_sets(mesh: Any, first: Integers) -> dict[str, Integers]:
    """Return the numbers of the elements of named sets; those of a block begin with one of `first`."""
    found: dict[str, list[Integers]] = {}
    for name, block, chosen in _chosen(mesh):
        found.setdefault(name, []).append(first[block] + chosen)
    return {name: np.concatenate(parts) for name, parts in found.items()}


def _nodes_of_cell_sets(mesh: Any) -> dict[str, Integers]:
    """Return the nodes (from 0) of the named sets of elements."""
    found: dict[str, list[Integers]] = {}
    for name, block, chosen in _chosen(mesh):
        found.setdefault(name, []).append(mesh.cells[block].data[chosen].ravel())
    return {name: np.unique(np.concatenate(parts)).astype(np.int64) for name, parts in found.items()}


def _chosen(mesh: Any) -> Iterator[tuple[str, int, Integers]]:
    """Yield sets of elements, e.g. the physical groups of gmsh: name, block, which of the block."""
    for name, by_block in mesh.cell_sets.items():
        for block, chosen in enumerate(by_block):
            if chosen is not None and len(chosen) and not name.startswith("gmsh:"):
                yield name, block, np.asarray(chosen, dtype=np.int64)
    tags = mesh.cell_data.get("gmsh:physical", [])
    for name, (tag, dimension) in ((n, (int(v[0]), int(v[1]))) for n, v in mesh.field_data.items()):
        for number, (block, physical) in enumerate(zip(mesh.cells, tags, strict=False)):
            chosen = np.flatnonzero(np.asarray(physical) == tag)
            if block.dim == dimension and len(chosen):
                yield name, number, chosen


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


def chosen_elements(mesh: MeshFile, choice: Sequence[str | int], what: str) -> dict[str, NDArray[np.bool_]]:
    """Return which elements of each kind are of sets, by name, or of properties, by number.

    Raises
    ------
    UserError
        For an unknown set (with the nearest name).
    """
    by_name = {name.upper(): numbers for name, numbers in mesh.element_sets.items() if name}
    names = [str(one).upper() for one in choice]
    for name in names:
        if name not in by_name:
            raise UserError(_unknown(mesh, name, what, "element set", by_name))
    wanted = np.concatenate([by_name[name] for name in names])
    return {kind: np.isin(numbers, wanted) for kind, numbers in mesh.numbers.items()}


def _unknown(
    mesh: MeshFile, name: str, what: str, kind: str = "node set", known: Collection[str] | None = None
) -> str:
    known = mesh.sets if known is None else known
    near = difflib.get_close_matches(name.upper(), [one.upper() for one in known], n=1, cutoff=0.4)
    names = ", ".join(sorted(known)) or "none"
    hint = f", did you mean {near[0]}?" if near else f"; it has: {names}"
    return f"{mesh.source} has no {kind} {name!r} ({what}){hint}"
