"""Displacements and modes in Ansys' results (``.rst``), through the optional package ansys-mapdl-reader."""

from pathlib import Path

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.importers.ansys import library_arrays
from wavequake.mechanics.nodal.step import Kind, Step, Written

_KINDS: dict[int, Kind] = {0: "case", 2: "mode", 4: "time"}  # Ansys' analysis types


def read_rst(path: Path) -> Written:
    """Return nodes, and displacements per load step, instant or mode.

    Raises
    ------
    UserError
        If ansys-mapdl-reader is not installed, the file is no such file, or of another analysis.
    """
    arrays = library_arrays(path)
    kind = _KINDS.get(int(arrays["analysis"]))
    if kind is None:
        raise UserError(f"{path.name} holds no static, modal or transient analysis of Ansys")
    steps = [
        Step(kind, number + 1, float(value), arrays["labels"], one)
        for number, (value, one) in enumerate(zip(arrays["values"], arrays["displacements"], strict=True))
    ]
    kept = np.isfinite(arrays["displacements"]).all(axis=(0, 2))
    steps = [Step(one.kind, one.number, one.value, one.labels[kept], one.values[kept]) for one in steps]
    return Written(path.name, tuple(steps), arrays["node_numbers"], arrays["points"])
