"""From files of matrices and of a mesh to a finite-element model in SI units."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.sparse import csc_array, diags_array

from wavequake.errors import UserError
from wavequake.mechanics.importers import (
    abaqus,
    ansys,
    arrays,
    calculix,
    matrix_market,
    nastran,
    op4,
    superelement,
)
from wavequake.mechanics.importers.areas import area_shares
from wavequake.mechanics.importers.checks import Triangle, assemble, free_dofs
from wavequake.mechanics.importers.copies import averaged, real_part, refuse_repeated
from wavequake.mechanics.importers.entries import DIRECTIONS, Contents, Entries, Integers
from wavequake.mechanics.importers.mass import check_mass
from wavequake.mechanics.importers.mesh import MeshFile, chosen_nodes, positions, read_mesh
from wavequake.mechanics.importers.pads import PadDofs, PadKind, with_pads
from wavequake.mechanics.importers.units import si_factors
from wavequake.mechanics.model import FiniteElementModel, RayleighDamping

READERS = {
    ".sti": calculix.read_matrix,
    ".mas": calculix.read_matrix,
    ".pch": nastran.read_matrices,
    ".op4": op4.read_matrices,
    ".full": ansys.read_matrices,
    ".npz": arrays.read_npz,
    ".h5": arrays.read_hdf5,
    ".hdf5": arrays.read_hdf5,
}
MESHES = (".inp", ".msh", ".vtu", ".bdf", ".nas", ".fem", ".cdb", ".vtk", ".med")
TRIANGLE = "'upper' or 'lower': half of the matrix is in the file, in a format that does not say so"
ZERO_ROWS = "'drop': displacements whose rows are empty are fixed, and left out"
PADS = "'average' or 'rigid': each node set of interfaces is one pad, moved by its mean or as a rigid body"
PAD_DOFS = "3 or 6: whether each pad is three displacements, or these and three rotations about its center"
NodeChoice = str | Sequence[int | str]
Nodes = Annotated[tuple[int | str, ...], Field(strict=False)]  # a study file has lists


class ImportedModel(BaseModel):
    """Keys of a study's section [model] that name a model to be imported.

    ``file = "plate.sti"`` finds plate.mas, plate.dof and plate.inp beside it.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    file: str = Field(description="stiffness (.sti, .mtx) or all matrices (.full, .op4, .pch, .npz, .h5)")
    mass: str | None = Field(default=None, description="default: beside file")
    dofs: str | None = Field(default=None, description="node.direction of each row; default: beside file")
    mesh: str | None = Field(default=None, description="node coordinates and sets; default: beside file")
    units: str = Field(description="length, mass, time, force, e.g. 'm,kg,s,N' or 'mm,t,s,N'")
    interfaces: str | Nodes = Field(description="node set, or node numbers")
    surface: str | Nodes = Field(description="node set, or node numbers, of the optical surface")
    triangle: Triangle | None = Field(default=None, description=TRIANGLE)
    zero_rows: Literal["drop"] | None = Field(default=None, description=ZERO_ROWS)
    pads: PadKind | None = Field(default=None, description=PADS)
    pad_dofs: PadDofs = Field(default=3, description=PAD_DOFS)
    damping_alpha: float = Field(default=0.0, ge=0, description="1/s, times the mass")
    damping_beta: float = Field(default=5e-6, ge=0, description="s, times the stiffness")


@dataclass(frozen=True)
class Imported:
    """An imported model and what was done to it that its author may want to know."""

    model: FiniteElementModel
    notes: tuple[str, ...]


def load_model(section: ImportedModel, folder: Path) -> Imported:
    """Import the model that a study names; its files are relative to `folder`.

    Raises
    ------
    UserError
        As `import_model`.
    """
    paths = {
        key: None if name is None else folder / name
        for key, name in (("mass", section.mass), ("dofs", section.dofs), ("mesh", section.mesh))
    }
    return import_model(
        folder / section.file,
        **paths,
        units=section.units,
        interfaces=section.interfaces,
        surface=section.surface,
        triangle=section.triangle,
        zero_rows=section.zero_rows,
        pads=section.pads,
        pad_dofs=section.pad_dofs,
        damping=RayleighDamping(section.damping_alpha, section.damping_beta),
    )


def import_model(
    file: Path | str,
    *,
    units: str | None,
    interfaces: NodeChoice,
    surface: NodeChoice,
    mass: Path | str | None = None,
    dofs: Path | str | None = None,
    mesh: Path | str | None = None,
    triangle: Triangle | None = None,
    zero_rows: Literal["drop"] | None = None,
    pads: PadKind | None = None,
    pad_dofs: PadDofs = 3,
    damping: RayleighDamping | None = None,
) -> Imported:
    """Read matrices and mesh of a finite-element program into a model in SI units.

    Parameters
    ----------
    file : path
        CalculiX ``.sti``; Abaqus or Matrix Market ``.mtx``; Nastran ``.pch`` or ``.op4``; Ansys ``.full``;
        ``.npz``; HDF5 ``.h5``.
    units : str
        The files' units of length, mass, time and force, e.g. ``"mm,t,s,N"``. They are never guessed.
    interfaces, surface : str or sequence of int or str
        Node sets and node numbers that carry forces, and that form the optical surface.
    mass, dofs, mesh : path, optional
        Where not beside `file` under its name.
    triangle : {"upper", "lower"}, optional
        What the file holds of a symmetric matrix, in a format that does not say so (``.npz``, HDF5, general
        Matrix Market, square DMIG and OUTPUT4). A whole matrix is taken as it is.
    zero_rows : "drop", optional
        Displacements whose rows are empty in both matrices are fixed, and left out. CalculiX and Ansys need
        not say so.
    pads : {"average", "rigid"}, optional
        Each node set of `interfaces` is one interface node, at the center of its area: the mean of its nodes
        moves, or all move as one rigid body. Node numbers stay nodes.
    pad_dofs : {3, 6}, optional
        Inputs of each pad: its displacement, or also its rotation about its center.
    damping : RayleighDamping, optional
        In SI units.

    Raises
    ------
    UserError
        For whatever is missing, damaged or contradictory; see `wavequake.mechanics.importers.checks`.
    """
    file = Path(file)
    if not units:
        raise UserError(
            f"the units of {file.name} are not declared; say for example units = 'm,kg,s,N' or 'mm,t,s,N'"
        )
    length, mass_factor, stiffness_factor = si_factors(units)
    mass, dofs, mesh = (None if path is None else Path(path) for path in (mass, dofs, mesh))
    contents = read_contents(file)
    notes: list[str] = []
    drop = zero_rows == "drop" or contents.keeps_fixed
    grid = _mesh(contents, file, mesh)
    K, M, table = _matrices(contents, file, (mass, dofs), (triangle, drop), grid, notes)
    dof_node = np.full(len(table), -1, dtype=np.int64)
    labeled = table[:, 1] > 0
    dof_node[labeled] = positions(grid, table[labeled, 0], "degree of freedom")
    if len(own := np.intersect1d(table[labeled, 0], grid.turned)):
        raise UserError(
            f"node {own[0]} of {grid.source} moves in axes of its own (GRID, field CD), which are not read; "
            "write the matrices in the basic ones"
        )
    optical, mounts = chosen_nodes(grid, surface, "surface"), chosen_nodes(grid, interfaces, "interfaces")
    for what, nodes in (("surface", optical), ("interfaces", mounts)):
        _refuse_fixed(grid, nodes, (dof_node, table[:, 1] - 1), what)
    # Displacements are converted to m, rotations and inner coordinates stay what they are.
    scale = np.where((table[:, 1] >= 1) & (table[:, 1] <= 3), 1.0, length)
    spread = diags_array(scale, format="csc")
    if (scale != 1.0).any():
        K, M = spread @ K @ spread, spread @ M @ spread
    model = FiniteElementModel(
        name=file.stem,
        mass=csc_array(M * mass_factor),
        stiffness=csc_array(K * stiffness_factor),
        damping=damping or RayleighDamping(),
        nodes=grid.points * length,
        dof_node=dof_node,
        dof_direction=np.where(labeled, table[:, 1] - 1, -1),
        interfaces=mounts,
        surface_nodes=optical,
        surface_weights=area_shares(grid, optical),
        node_sets={name: positions(grid, nodes, name) for name, nodes in grid.sets.items()},
    )
    if pads is not None:
        chosen = [interfaces] if isinstance(interfaces, str) else list(interfaces)
        areas = [chosen_nodes(grid, [part], "interfaces") for part in chosen]
        model = with_pads(model, grid, areas, pads, pad_dofs)
        if len(areas) < len(mounts):
            inputs = f", {len(areas) * pad_dofs} inputs" if pad_dofs == 6 else ""
            notes.append(f"{len(areas)} pads ({pads}) of {len(mounts)} nodes are the interface{inputs}")
    elif pad_dofs == 6:
        raise UserError("pad_dofs = 6 is of pads; add pads = 'rigid' or 'average'")
    return Imported(model, tuple(notes))


def _matrices(
    contents: Contents,
    file: Path,
    others: tuple[Path | None, Path | None],
    declared: tuple[Triangle | None, bool],
    grid: MeshFile,
    notes: list[str],
) -> tuple[csc_array, csc_array, Integers]:
    """Return stiffness, mass and the free displacements.

    `others` are the files of mass and dofs; `declared` are the triangle and whether empty rows are dropped.
    """
    stiffness, mass = _pair(contents, file, others[0])
    table = _dofs(contents, (stiffness, mass), file, others[1])
    calculix = file.suffix.lower() == ".sti"
    if calculix and stiffness.size == mass.size == 2 * len(table):
        stiffness, mass = real_part(stiffness, len(table)), real_part(mass, len(table))
        notes.append("the sector of cyclic symmetry moves as its neighbors do (nodal diameter 0)")
    refuse_repeated(table, grid.expanded if calculix else None, (others[1] or file.with_suffix(".dof")).name)
    K, M = (assemble(entries, table, declared[0]) for entries in (stiffness, mass))
    free = free_dofs(K, M, table, notes, drop=declared[1])
    if len(free) < len(table):
        K, M, table = csc_array(K[free][:, free]), csc_array(M[free][:, free]), table[free]
    check_mass(M, K, table, (mass.source, stiffness.source), notes)
    if calculix and len(grid.expanded):
        return averaged(K, M, table, grid.labels, notes)
    return K, M, table


def read_contents(path: Path) -> Contents:
    """Return the matrices of a file, by its suffix.

    Raises
    ------
    UserError
        If there is no reader of such files, or it cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix == ".mtx":
        plain = matrix_market.is_matrix_market(path)
        return matrix_market.read_matrix(path) if plain else abaqus.read_matrix(path)
    if suffix not in READERS:
        raise UserError(
            f"{path.name}: no reader for {suffix or 'a file without suffix'}, known are .mtx, "
            f"{', '.join(READERS)}"
        )
    contents = READERS[suffix](path)
    return superelement.with_rows(contents, path) if suffix == ".op4" else contents


def _pair(contents: Contents, file: Path, mass: Path | None) -> tuple[Entries, Entries]:
    """Return the entries of stiffness and mass."""
    stiffness = _named(contents, "K", file)
    if mass is None and len(contents.matrices) > 1:
        return stiffness, _named(contents, "M", file)
    if mass is None:
        names = {file.with_suffix(".mas") if file.suffix == ".sti" else None}
        for old, new in (("STIF", "MASS"), ("stiffness", "mass"), ("K", "M")):
            names.add(file.with_name(new.join(file.name.rsplit(old, 1))) if old in file.stem else None)
        found = sorted(path for path in names - {None, file} if path is not None and path.is_file())
        if len(found) != 1:
            raise UserError(f"no mass matrix found beside {file.name}; name it with the key mass")
        mass = found[0]
    return stiffness, _named(read_contents(mass), "M", mass)


def _named(contents: Contents, letter: str, path: Path) -> Entries:
    """Return the one matrix of a file, or the one whose name tells that it is the stiffness or mass."""
    words = {"K": ("K", "STIF"), "M": ("M",)}[letter]
    if len(contents.matrices) == 1:
        return next(iter(contents.matrices.values()))
    fits = [name for name in contents.matrices if name.upper().startswith(words)]
    # Of Nastran's the one of the analysis set, beside which K4AA is a damping.
    fits = [name for name in fits if name.upper() in {letter + of for of in ("AA", "AAX", "XX")}] or fits
    if len(fits) != 1:
        what = {"K": "stiffness", "M": "mass"}[letter]
        raise UserError(
            f"{path.name} holds {', '.join(contents.matrices)}: exactly one must be the {what} (a name that "
            f"begins with {' or '.join(words)})"
        )
    return contents.matrices[fits[0]]


def _dofs(contents: Contents, entries: tuple[Entries, Entries], file: Path, dofs: Path | None) -> Integers:
    """Return node number and direction of each row."""
    if all(part.size is None for part in entries):
        keys = np.unique(np.concatenate([part.rows for part in entries] + [part.columns for part in entries]))
        return np.column_stack(np.divmod(keys, DIRECTIONS))
    path = dofs or file.with_suffix(".dof")
    if dofs is None and contents.dofs is not None:
        table = contents.dofs
    elif path.is_file():
        table = calculix.read_dofs(path)
    else:
        raise UserError(
            f"{file.name} does not say which degrees of freedom its rows are, and {path.name} was not found; "
            "name a file of lines node.direction with the key dofs"
        )
    return table


def _refuse_fixed(mesh: MeshFile, nodes: Integers, dofs: tuple[Integers, Integers], what: str) -> None:
    """Refuse nodes that lack a displacement; `dofs` are positions of nodes and directions from 0."""
    moves = (dofs[1] >= 0) & (dofs[1] < 3)
    free = np.zeros((len(mesh.labels), 3), dtype=bool)
    free[dofs[0][moves], dofs[1][moves]] = True
    bad = np.argwhere(~free[nodes])
    if len(bad):
        row, direction = bad[0]
        raise UserError(
            f"node {mesh.labels[nodes[row]]} of {what} is fixed in {'xyz'[direction]} or belongs to no "
            f"element; {what} must be free in x, y and z ({len(np.unique(bad[:, 0]))} nodes are not)"
        )


def _mesh(contents: Contents, file: Path, mesh: Path | None) -> MeshFile:
    if mesh is None and contents.coordinates is not None and contents.node_numbers is not None:
        return MeshFile(file.name, contents.node_numbers.astype(np.int64), contents.coordinates)
    if mesh is None:
        found = [path for path in map(file.with_suffix, MESHES) if path.is_file()]
        if not found:
            raise UserError(
                f"no coordinates for {file.name}: no mesh ({', '.join(MESHES)}) of that name beside it; name "
                "one with the key mesh"
            )
        mesh = found[0]
    return read_mesh(mesh)
