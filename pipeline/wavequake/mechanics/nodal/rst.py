"""Displacements, modes and temperatures in Ansys' results, through the optional package ansys-mapdl-reader.

``.rst`` of structures, ``.rth`` of thermal analyses.
"""

from pathlib import Path

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.importers.ansys import reader_arrays
from wavequake.mechanics.nodal.step import Kind, Step, Written

_KINDS: dict[int, Kind] = {0: "case", 2: "mode", 4: "time"}  # Ansys' analysis types


def read_rst(path: Path) -> Written:
    """Return nodes, and displacements per load step, instant or mode.

    Raises
    ------
    UserError
        If ansys-mapdl-reader is not installed, the file is no such file, or of another analysis.
    """
    return _read(path, "displacements")


def read_temperatures(path: Path) -> Written:
    """Return nodes, and temperatures per load step or instant; those amid edges may be missing.

    Raises
    ------
    UserError
        As `read_rst`, or if it has none.
    """
    return _read(path, "temperatures")


def _read(path: Path, what: str) -> Written:
    arrays = reader_arrays(path, what)
    kind = _KINDS.get(int(arrays["analysis"]))
    if kind is None:
        raise UserError(f"{path.name} holds no static, modal or transient analysis of Ansys")
    found = np.atleast_3d(arrays[what])
    if found.shape[2] == 2:
        raise UserError(f"{path.name} holds a plane model, whose nodes move in x and y alone")
    kept = np.isfinite(found).all(axis=(0, 2))
    if not kept.any():
        raise UserError(f"{path.name} has no {what} of nodes")
    steps = tuple(
        Step(kind, number, float(value), arrays["labels"][kept], one[kept])
        for number, (value, one) in enumerate(zip(arrays["values"], found, strict=True), start=1)
    )
    return Written(path.name, steps, arrays["node_numbers"], arrays["points"])
