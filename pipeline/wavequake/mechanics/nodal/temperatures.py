"""Temperatures of the nodes of a body, from files, to the displacements of its surface."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import scipy  # its parts load when first used
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Array, Integers
from wavequake.mechanics.importers.mesh import MeshFile, chosen_elements, chosen_nodes, read_mesh
from wavequake.mechanics.importers.units import LENGTH
from wavequake.mechanics.nodal.expansion import Material, Solid, expanded, solid_of
from wavequake.mechanics.nodal.results import NodalResults, read_written
from wavequake.mechanics.nodal.step import Kind, Written

Nodes = str | Annotated[tuple[int | str, ...], Field(strict=False)]  # a study file has lists
_TOGETHER = 1e-4  # of the size of a body: nodes of two files that are one


_KEYS = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class _OfWhat(BaseModel):
    model_config = _KEYS

    expansion_per_k: float = Field(ge=-1e-2, le=1e-2, description="coefficient of linear expansion, 1/K")
    poisson_ratio: float = Field(default=0.33, gt=-1, lt=0.5)
    youngs_modulus_gpa: float | None = Field(
        default=None, gt=0, description="required where the body is of several materials"
    )
    density_kg_m3: float | None = Field(
        default=None,
        gt=0,
        description="of several materials, where the body floats; default: the same everywhere",
    )


class ThermalMaterial(_OfWhat):
    """Elements that are of another material than the rest of a body."""

    elements: str | int | Annotated[tuple[int | str, ...], Field(strict=False, min_length=1)] = Field(
        description="element set (CalculiX, gmsh), property number (Nastran), or several"
    )


class Thermal(_OfWhat):
    """What temperatures of nodes do to a body that is held without strain, of one material or several."""

    material: Annotated[tuple[ThermalMaterial, ...], Field(strict=False)] = Field(
        default=(), description="other materials, by elements; of elements of several the last one counts"
    )
    # No default: files count in degrees Celsius or kelvin and do not say which.
    reference: float = Field(
        description="temperature at which the body has its shape, as the file counts them"
    )
    nodes: Nodes | None = Field(
        default=None, description="node set or node numbers of the surface; default: all nodes"
    )
    held: Nodes | None = Field(
        default=None,
        description="node set or node numbers at kinematic supports, whose mean motion is none; default: the "
        "body floats",
    )


def thermal_of(given: object) -> Thermal:
    """Return the section of a disturbance.

    Raises
    ------
    UserError
        If a key is missing or wrong.
    """
    try:
        return Thermal.model_validate(given)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(("thermal", *map(str, first["loc"])))
        raise UserError(f"{where}: {first['msg'][0].lower()}{first['msg'][1:]}") from None


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
    body, materials = _materials(grid, body, thermal)
    kind, values, temperatures = _temperatures(
        read_written(path), grid, body.points, body.nodes, LENGTH[unit]
    )
    held = None if thermal.held is None else chosen_nodes(grid, thermal.held, "held")
    seen = body.nodes if thermal.nodes is None else chosen_nodes(grid, thermal.nodes, "nodes")
    if len(loose := np.setdiff1d(seen if held is None else np.append(seen, held), body.nodes)):
        raise UserError(f"node {grid.labels[loose[0]]} of {grid.source} belongs to no solid element")
    moved = expanded(body, temperatures - thermal.reference, materials, held)
    return NodalResults(kind, values, grid.labels[seen], body.points[seen], moved[:, seen])


def _materials(grid: MeshFile, body: Solid, thermal: Thermal) -> tuple[Solid, list[Material]]:
    """Return a body whose elements know their materials, and these."""
    given = [thermal, *thermal.material]
    for key in ("youngs_modulus_gpa", "density_kg_m3"):
        bare = [getattr(one, key) is None for one in given]
        if any(bare) and not (all(bare) and (len(given) == 1 or key == "density_kg_m3")):
            raise UserError(f"thermal: a body of several materials needs {key} of each of them")
    layers = {kind: np.zeros(len(elements), dtype=np.int64) for kind, elements in body.cells.items()}
    for number, one in enumerate(thermal.material, start=1):
        choice = one.elements if isinstance(one.elements, tuple) else (one.elements,)
        found = chosen_elements(grid, choice, "thermal.material")
        if not any(found[kind].any() for kind in layers):
            names = ", ".join(map(str, choice))
            raise UserError(f"{names} of {grid.source} (thermal.material) holds none of its solid elements")
        for kind, layer in layers.items():
            layer[found[kind]] = number
    materials = [
        Material(
            one.expansion_per_k, one.poisson_ratio, one.youngs_modulus_gpa or 1.0, one.density_kg_m3 or 1.0
        )
        for one in given
    ]
    return replace(body, layers=layers), materials


def _temperatures(
    written: Written, grid: MeshFile, points: Array, nodes: Integers, length: float
) -> tuple[Kind, Array, Array]:
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
        where, there = _places(written, step.labels, grid, points, length)
        temperatures[row, where[there]] = step.values[there, 0]
    bare = np.argwhere(~np.isfinite(temperatures[:, nodes]))
    if len(bare):
        step, node = bare[0]
        raise UserError(
            f"{written.source} has no temperature of node {grid.labels[nodes[node]]} of {grid.source} at "
            f"step {step + 1} ({len(bare)} such values); give all of its elements, also amid edges"
        )
    values = np.array([step.value if kind == "time" else float(step.number) for step in steps])
    if kind == "time" and (np.diff(values) <= 0.0).any():
        raise UserError(f"{written.source}: its instants do not increase")
    return kind, values, np.nan_to_num(temperatures)


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
