"""What a file of a finite-element program holds, in words: matrices, a mesh, or results at nodes."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from wavequake import user_files
from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Array, Integers
from wavequake.mechanics.importers.mesh import read_mesh
from wavequake.mechanics.importers.model import MESHES, READERS, read_contents
from wavequake.mechanics.nodal.deck_materials import deck_materials
from wavequake.mechanics.nodal.results import READERS as RESULTS
from wavequake.mechanics.nodal.results import read_written
from wavequake.mechanics.nodal.step import Step
from wavequake.mechanics.nodal.tables import read_modes
from wavequake.words import counted

MATRICES = (*READERS, ".mtx")
FILES = tuple(dict.fromkeys((*MATRICES, *MESHES, *RESULTS)))
_MOST_NAMES = 12
_KINDS = {"case": "load case", "time": "instant", "mode": "mode"}


def describe(path: Path) -> str:
    """Return what a file holds, in its own units.

    Raises
    ------
    UserError
        If it cannot be read: says why.
    """
    suffix = path.suffix.lower()
    if suffix in MESHES:
        lines = _mesh(path)
    elif suffix in RESULTS and not (suffix == ".npz" and _has_matrices(path)):
        lines = _results(path)
    else:
        lines = _matrices(path)
    first, *rest = lines
    return "\n".join([f"{path.name}: {first}", *(f"  {line}" for line in rest)])


def _has_matrices(path: Path) -> bool:
    try:
        return "stiffness" in user_files.read_npz(user_files.read_bytes(path))
    except UserError:  # which the reader of results says better
        return False


def _mesh(path: Path) -> Iterator[str]:
    mesh = read_mesh(path)
    yield f"a mesh of {len(mesh.labels)} nodes, {_size(mesh.points)}"
    yield f"elements: {_counts(mesh.cells)}"
    yield f"node sets: {_counts(mesh.sets)}"
    yield f"element sets: {_counts(mesh.element_sets)}"
    for name, material in deck_materials(path).items():
        values = [f"{what} {value:g}" for what, value in material.values.items()]
        values += [f"{what} {why}" for what, why in material.lacks.items()]
        yield f"material of {name}: {material.name}, {', '.join(values) or 'without constants'}"


def _matrices(path: Path) -> Iterator[str]:
    contents = read_contents(path)
    count = len(contents.matrices)
    yield f"{count} matrices" if count > 1 else "a matrix"
    for name, entries in contents.matrices.items():
        keys = len(np.unique([entries.rows, entries.columns])) if entries.size is None else entries.size
        half = ", half of a symmetric matrix" if entries.one_triangle else ""
        yield f"{name or 'matrix'}: {keys} x {keys}, {len(entries.values)} entries{half}"
    if contents.dofs is not None:
        yield f"its rows: {len(contents.dofs)} directions of {len(np.unique(contents.dofs[:, 0]))} nodes"
    if contents.coordinates is not None:
        yield f"{len(contents.coordinates)} nodes, {_size(contents.coordinates)}"
    beside = [path.with_suffix(one).name for one in (".mas", ".dof", *MESHES) if path.suffix.lower() != one]
    found = [name for name in beside if path.with_name(name).is_file()]
    yield f"beside it: {', '.join(found) or 'no mass, rows or mesh of that name'}"


def _results(path: Path) -> Iterator[str]:
    try:
        written = read_written(path)
    except UserError:
        if path.suffix.lower() != ".csv":
            raise
        try:
            _, points, frequencies, _, _ = read_modes(path)
        except UserError:
            frequencies = np.zeros(0)
        if not len(frequencies):
            raise
        span = f"{frequencies[0]:.6g} to {frequencies[-1]:.6g} Hz"
        yield f"table of {counted(len(frequencies), 'mode')}, {span}"
        yield f"{len(points)} nodes, {_size(points)} (m)"
        return
    nodes = 0 if written.labels is None else len(written.labels)
    yield f"results at nodes, in {'its own unit' if written.length is None else f'{written.length:g} m'}"
    for kind, name in _KINDS.items():
        for is_thermal in (False, True):
            steps = [one for one in written.steps if (one.kind, one.is_thermal) == (kind, is_thermal)]
            if steps:
                yield _steps(steps, name, is_thermal)
    yield (
        f"{nodes} nodes, {_size(written.points)}"
        if written.points is not None
        else ("it does not say where its nodes are: name a mesh")
    )


def _steps(steps: list[Step], name: str, is_thermal: bool) -> str:
    what = "temperatures" if is_thermal else "displacements"
    values = np.concatenate([one.values.ravel() for one in steps])
    unit = {"mode": " Hz", "instant": " s"}.get(name)
    span = f", {steps[0].value:.6g} to {steps[-1].value:.6g}{unit}" if unit else ""
    return (
        f"{counted(len(steps), name)}{span}: {what} of {len(steps[0].labels)} nodes, "
        f"{values.min():.6g} to {values.max():.6g}"
    )


def _size(points: Array) -> str:
    return " x ".join(f"{length:.6g}" for length in np.ptp(points, axis=0)) if len(points) else "nowhere"


def _counts(named: Mapping[str, Integers]) -> str:
    parts = [f"{name or '(without name)'} {len(found)}" for name, found in named.items()]
    rest = f" and {len(parts) - _MOST_NAMES} more" if len(parts) > _MOST_NAMES else ""
    return (", ".join(parts[:_MOST_NAMES]) or "none") + rest
