"""Nodal results of any file: which steps it has, where its nodes are, in SI units."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.importers.bulk import read_bulk
from wavequake.mechanics.importers.entries import Array, Integers
from wavequake.mechanics.importers.mesh import read_mesh
from wavequake.mechanics.importers.units import LENGTH
from wavequake.mechanics.nodal import frd, op2, rst, tables
from wavequake.mechanics.nodal.step import Kind, Step, Written, in_common_axes

READERS: dict[str, Callable[[Path], Written]] = {
    ".csv": tables.read_csv,
    ".npz": tables.read_arrays,
    ".txt": tables.read_text,
    ".dat": tables.read_text,
    ".op2": op2.read_op2,
    ".frd": frd.read_frd,
    ".rst": rst.read_rst,
    ".rth": rst.read_temperatures,
}
FORMATS = ".csv, .npz, .txt (Zemax STAR), .op2 (Nastran), .frd (CalculiX) or .rst, .rth (Ansys)"
_CARDS = (".bdf", ".nas", ".fem", ".dat")


@dataclass(frozen=True)
class NodalResults:
    """Steps of one kind at the same nodes, SI units.

    Attributes
    ----------
    kind : "case", "time" or "mode"
    values : ndarray, shape (n,)
        Instants in s, frequencies in Hz, or numbers of load cases.
    labels : ndarray of int, shape (p,)
    points : ndarray, shape (p, 3)
        m.
    motions : ndarray, shape (n, p, 3) or (n, p, 6)
        m, and rotations in rad; of modes in the file's own scale, displacements times its unit of length.
    note : str
        What a user may want to know of where they are from.
    """

    kind: Kind
    values: Array
    labels: Integers
    points: Array
    motions: Array
    note: str = ""


def read_written(path: Path) -> Written:
    """Return what a file of nodal results holds, as it is written there.

    Raises
    ------
    UserError
        If there is no reader of such files, or it cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix not in READERS:
        raise UserError(
            f"{path.name}: no reader of nodal results for {suffix or 'no suffix'}; give {FORMATS}"
        )
    return READERS[suffix](path)


def read_results(
    path: Path, unit: str | None, mesh: Path | None, wanted: Sequence[Kind] = ("time", "case")
) -> NodalResults:
    """Return the steps of the first kind in `wanted` that a file has.

    Parameters
    ----------
    path : Path
    unit : str or None
        Of length, in a file that does not say it: "m", "mm", ...
    mesh : Path or None
        Where the nodes are, if not in the file.
    wanted : sequence of "case", "time", "mode"

    Raises
    ------
    UserError
        If the file cannot be read, has no such steps, its unit or nodes are not known, steps have different
        nodes, or instants do not increase.
    """
    written = in_axes_of(read_written(path), mesh)
    moving = [step for step in written.steps if not step.is_thermal]
    if not moving:
        raise UserError(
            f"{path.name} holds temperatures; what they do is said by thermal = "
            "{ expansion_per_k = ..., reference = ... } of the disturbance, with a mesh of elements"
        )
    scale = _scale(written, unit)
    kind = next((one for one in wanted if any(step.kind == one for step in moving)), None)
    if kind is None:
        held = ", ".join(sorted({_WORDS[step.kind] for step in moving}))
        raise UserError(f"{path.name} holds {held}, but {_WORDS[wanted[0]]} are needed")
    steps = [step for step in moving if step.kind == kind]
    labels = steps[0].labels
    width = min(step.values.shape[1] for step in steps)
    motions = np.stack([_aligned(step, labels, path.name)[:, :width] for step in steps])
    if width > 3 and not motions[..., 3:].any():
        motions = motions[..., :3]
    motions[..., :3] *= scale
    values = np.array([float(step.number) if kind == "case" else step.value for step in steps])
    if kind == "time" and (np.diff(values) <= 0.0).any():
        at = int(np.flatnonzero(np.diff(values) <= 0.0)[0])
        raise UserError(f"{path.name}: its instants {values[at]:g} and {values[at + 1]:g} s do not increase")
    if not np.isfinite(motions).all():
        raise UserError(f"{path.name}: a displacement is not finite")
    points = _points(written, labels, mesh)
    return NodalResults(kind, values, labels, points * scale, motions)


_WORDS = {"case": "load cases", "time": "results over time", "mode": "modes"}


def _scale(written: Written, unit: str | None) -> float:
    if written.length is not None:
        if unit is not None:
            raise UserError(f"{written.source} says its units itself; leave unit = {unit!r} out")
        return written.length
    if unit not in LENGTH:
        raise UserError(
            f"{written.source} does not say its unit of length; add unit = 'mm' or another of "
            f"{', '.join(LENGTH)}"
        )
    return LENGTH[unit]


def _aligned(step: Step, labels: Integers, source: str) -> Array:
    """Return the values of a step in the order of `labels`."""
    if np.array_equal(step.labels, labels):
        return step.values
    order = np.argsort(step.labels, kind="stable")
    if len(step.labels) != len(labels) or not np.array_equal(step.labels[order], np.sort(labels)):
        raise UserError(
            f"{source}: the steps {step.number} and the first have different nodes ({len(step.labels)} and "
            f"{len(labels)}); write all for the same nodes"
        )
    return step.values[order][np.argsort(np.argsort(labels, kind="stable"), kind="stable")]


def _points(written: Written, labels: Integers, mesh: Path | None) -> Array:
    if len(np.unique(labels)) < len(labels):
        raise UserError(f"{written.source} lists a node twice")
    known, points, source = written.labels, written.points, written.source
    if mesh is not None or points is None or known is None:
        if mesh is None:
            raise UserError(
                f"{written.source} does not say where its nodes are; name the deck that does with the key "
                "mesh"
            )
        found = read_mesh(mesh)
        known, points, source = found.labels, found.points, found.source
    order = np.argsort(known)
    place = np.minimum(np.searchsorted(known[order], labels), len(order) - 1)
    missing = labels[known[order][place] != labels]
    if len(missing):
        raise UserError(f"{source} has no coordinates of node {missing[0]} ({len(missing)} such nodes)")
    return np.asarray(points[order][place])


def in_axes_of(written: Written, mesh: Path | None) -> Written:
    """Return results in the axes of the coordinates, where a Nastran deck has them in those of each node.

    Raises
    ------
    UserError
        If the deck lacks the axes of a node.
    """
    if not written.own_axes or mesh is None or mesh.suffix.lower() not in _CARDS:
        return written
    deck = read_bulk(mesh)
    lost = deck.turned[np.isnan(deck.turns).any(axis=(1, 2))]
    if len(lost):
        raise UserError(
            f"{mesh.name}: point {lost[0]} moves in axes (GRID, field CD) that no CORD2R, CORD2C or CORD2S "
            "gives; write displacements in the basic ones"
        )
    steps = tuple(in_common_axes(step, deck.turned, deck.turns) for step in written.steps)
    return replace(written, steps=steps, own_axes=False)
