"""Tables of modes from other programs, as bodies take them: SI units, modal masses of 1 kg."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Array
from wavequake.mechanics.importers.units import MASS, si_factors
from wavequake.mechanics.nodal.results import read_results
from wavequake.mechanics.nodal.tables import read_modes

FORMATS = ".csv, .op2 (Nastran), .frd (CalculiX), .rst (Ansys) or .npz"


def modes_of(
    path: Path,
    units: str | None,
    mesh: Path | None = None,
    nodes: Sequence[int] = (),
    damping: float | Sequence[float] | None = None,
    masses: float | Sequence[float] = 1.0,
) -> bytes:
    """Return the ``.npz`` of a body of modes (`wavequake.mechanics.assembly.arrays.from_modes`).

    Parameters
    ----------
    path : Path
        Of results, or a CSV (`tables.read_modes`), whose shapes are in SI units.
    units : str or None
        Of results: length, mass, time and force, e.g. "mm,t,s,N".
    mesh : Path or None
        Where the nodes are, if not in the file.
    nodes : sequence of int
        Numbers of those to keep; none: all.
    damping : float or sequence of float, optional
        Ratio of every mode, or of each. Default: that of a CSV, or 0.
    masses : float or sequence of float
        Modal masses of the shapes as they are, in the unit of mass.

    Raises
    ------
    UserError
        If the file cannot be read or has no modes, units or nodes are not known, or numbers are not as many
        as modes.
    """
    if path.suffix.lower() == ".csv":
        if units is not None:
            raise UserError(f"{path.name} holds shapes in SI units; leave units = {units!r} out")
        labels, points, frequencies, ratios, shapes = read_modes(path)
        scale = 1.0
    else:
        if not units:
            raise UserError(f"the units of {path.name} are not declared; say for example units = 'mm,t,s,N'")
        length, _, _ = si_factors(units)
        words = [word.strip() for word in units.split(",")]
        found = read_results(path, words[0], mesh, ("mode",))
        labels, points, frequencies, shapes = found.labels, found.points, found.values, found.motions
        ratios = np.zeros(len(frequencies))
        # A coordinate in SI units is one of the file times length and root of mass; shapes are divided by
        # that. `read_results` has displacements in m already.
        scale = 1.0 / (length * np.sqrt(MASS[words[1]]))
    if damping is not None:
        ratios = _each(damping, len(frequencies), "damping_ratios", path.name)
    root_masses = np.sqrt(_each(masses, len(frequencies), "modal_masses", path.name))
    if not (root_masses > 0.0).all():
        raise UserError("modal_masses must be positive")
    shapes = shapes * scale / root_masses[:, None, None]
    if nodes:
        where = {label: row for row, label in enumerate(labels.tolist())}
        missing = next((node for node in nodes if node not in where), None)
        if missing is not None:
            raise UserError(f"{path.name} has no node {missing}")
        rows = [where[node] for node in nodes]
        labels, points, shapes = labels[rows], points[rows], shapes[:, rows]
    out = io.BytesIO()
    np.savez_compressed(
        out,
        frequencies_hz=frequencies,
        damping_ratios=ratios,
        nodes_mm=points * 1e3,
        shapes=shapes,
        names=labels.astype(str),
    )
    return out.getvalue()


def _each(given: float | Sequence[float], count: int, what: str, source: str) -> Array:
    values = np.asarray(given, dtype=np.float64)
    if values.ndim and values.shape != (count,):
        raise UserError(f"{source} has {count} modes, but {what} has {len(values)} numbers")
    return np.broadcast_to(values, (count,))
