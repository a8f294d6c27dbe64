"""Matrices of an Ansys ``.full`` file, through the optional package ansys-mapdl-reader."""

from pathlib import Path

import numpy as np
from scipy.sparse import coo_array

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Contents, Entries
from wavequake.user_files import require_file


def read_matrices(path: Path) -> Contents:
    """Return stiffness, mass and degrees of freedom of a ``.full`` file.

    Raises
    ------
    UserError
        If ansys-mapdl-reader is not installed, or the file is no ``.full`` file.
    """
    try:
        from ansys.mapdl import reader
    except ImportError as error:
        raise UserError(
            f"reading {path.name} needs the package ansys-mapdl-reader: pip install ansys-mapdl-reader"
        ) from error
    require_file(path)
    try:
        dofs, stiffness, mass = reader.read_binary(str(path)).load_km(as_sparse=True, sort=False)
    except Exception as error:  # the reader raises whatever its parser trips over
        raise UserError(f"{path.name} cannot be read as an Ansys .full file: {error}") from error
    matrices = {}
    for name, matrix in (("stiffness", coo_array(stiffness)), ("mass", coo_array(mass))):
        rows, columns = (place.astype(np.int64) for place in matrix.coords)
        values = np.asarray(matrix.data, dtype=np.float64)
        source = f"{name} of {path.name}"
        matrices[name] = Entries(source, rows, columns, values, matrix.shape[0], True)
    # Its directions count from 0, ours from 1.
    table = np.asarray(dofs, dtype=np.int64) + np.array([0, 1])
    return Contents(matrices, dofs=table, keeps_fixed=True)
