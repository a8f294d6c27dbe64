"""Temperatures of the nodes of a body, from files, to the displacements of its surface."""

from itertools import combinations
from pathlib import Path

import numpy as np
import scipy  # its parts load when first used

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Array, Integers
from wavequake.mechanics.importers.mesh import MeshFile, chosen_nodes, read_mesh
from wavequake.mechanics.importers.units import LENGTH
from wavequake.mechanics.nodal.deck_materials import deck_materials
from wavequake.mechanics.nodal.expansion import Solid, expanded, solid_of
from wavequake.mechanics.nodal.results import NodalResults, read_written
from wavequake.mechanics.nodal.rst import read_temperatures
from wavequake.mechanics.nodal.solids import KINDS
from wavequake.mechanics.nodal.step import Kind, Written
from wavequake.mechanics.nodal.thermal import Thermal, body_materials

_TOGETHER = 1e-4  # of the size of a body: nodes of two files that are one


def thermal_displacements(path: Path, unit: str | None, mesh: Path | None, thermal: Thermal) -> NodalResults:
    """Return the displacements of a surface's nodes by the temperatures of its body's, SI units.

    Parameters
    ----------
    path : Path
        Temperatures per load case or instant, at all nodes of the elements.
    unit : str
        Of length, in the mesh, and in a file that does not say it.
    mesh : Path
        Deck with the elements of the body.

    Raises
    ------
    UserError
        If a file cannot be read, has no temperatures, or no elements, or a node of them has no temperature.
    """
    if mesh is None or unit not in LENGTH:
        what = (
            "the key mesh, a deck with the elements of the body" if mesh is None else "unit, that of the mesh"
        )
        raise UserError(f"temperatures of {path.name} give displacements of a body: name {what}")
    grid = read_mesh(mesh)
    body = solid_of(grid.source, grid.labels, grid.points * LENGTH[unit], grid.cells)
    body, materials, note = body_materials(grid, body, thermal, deck_materials(mesh))
    written = read_temperatures(path) if path.suffix.lower() == ".rst" else read_written(path)
    kind, values, temperatures = _temperatures(written, grid, body, LENGTH[unit])
    held = None if thermal.held is None else chosen_nodes(grid, thermal.held, "held")
    seen = body.nodes if thermal.nodes is None else chosen_nodes(grid, thermal.nodes, "nodes")
    if len(loose := np.setdiff1d(seen if held is None else np.append(seen, held), body.nodes)):
        raise UserError(f"node {grid.labels[loose[0]]} of {grid.source} belongs to no solid element")
    moved = expanded(body, temperatures - thermal.reference, materials, held)
    return NodalResults(kind, values, grid.labels[seen], body.points[seen], moved[:, seen], note)


def _temperatures(written: Written, grid: MeshFile, body: Solid, length: float) -> tuple[Kind, Array, Array]:
    """Return the kind and values of the steps, and temperatures (n, N) at the nodes of a mesh."""
    steps = [step for step in written.steps if step.is_thermal]
    if not steps:
        raise UserError(f"{written.source} holds displacements, no temperatures; leave thermal out")
    kind: Kind = "time" if any(step.kind == "time" for step in steps) else "case"
    steps = [step for step in steps if step.kind == kind]
    temperatures = np.full((len(steps), len(grid.labels)), np.nan)
    for row, step in enumerate(steps):
        numbers, counts = np.unique(step.labels, return_counts=True)
        if (counts > 1).any():
            raise UserError(f"{written.source} gives node {numbers[np.argmax(counts > 1)]} twice at one step")
        where, there = _places(written, step.labels, grid, body.points, length)
        temperatures[row, where[there]] = step.values[there, 0]
    _fill_middles(temperatures, body)
    nodes = body.nodes
    bare = np.argwhere(~np.isfinite(temperatures[:, nodes]))
    if len(bare):
        step, node = bare[0]
        raise UserError(
            f"{written.source} has no temperature of node {grid.labels[nodes[node]]} of {grid.source} at "
            f"step {step + 1} ({len(bare)} such values); give at least all corners of its elements"
        )
    values = np.array([step.value if kind == "time" else float(step.number) for step in steps])
    if kind == "time" and (np.diff(values) <= 0.0).any():
        raise UserError(f"{written.source}: its instants do not increase")
    return kind, values, np.nan_to_num(temperatures)


def _fill_middles(temperatures: Array, body: Solid) -> None:
    """Give nodes amid edges that have no temperature (n, N) the mean of their ends, as a linear mesh has."""
    for kind, elements in body.cells.items():
        natural = KINDS[kind][0]
        for first, second in combinations(range(len(natural)), 2):
            middle = (natural[first] + natural[second]) / 2.0
            for place in np.flatnonzero((natural == middle).all(axis=1)):
                mean = temperatures[:, elements[:, [first, second]]].mean(axis=2)
                there = temperatures[:, elements[:, place]]
                temperatures[:, elements[:, place]] = np.where(np.isnan(there), mean, there)


def _places(
    written: Written, labels: Integers, grid: MeshFile, points: Array, length: float
) -> tuple[Integers, Array]:
    """Return which node of the mesh each of a step is, by place where it is known, and whether it is one."""
    if written.points is None or written.labels is None:
        return _among(grid.labels, labels)
    place, known = _among(written.labels, labels)
    away, found = scipy.spatial.cKDTree(points).query(
        written.points[place] * (length if written.length is None else written.length)
    )
    return found, known & (away <= _TOGETHER * np.ptp(points, axis=0).max())


def _among(labels: Integers, wanted: Integers) -> tuple[Integers, Array]:
    """Return at which places wanted node numbers stand among others, and whether they do."""
    order = np.argsort(labels)
    found = order[np.minimum(np.searchsorted(labels, wanted, sorter=order), len(order) - 1)]
    return found, labels[found] == wanted
