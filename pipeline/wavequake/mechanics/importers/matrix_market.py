"""Matrix Market files (``.mtx``), coordinate or array, general or symmetric."""

import io
from pathlib import Path

import numpy as np
import scipy  # its parts load when first used
from scipy.sparse import coo_array

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Contents, Entries, read_bytes, whole_lines

HEADER = b"%%MatrixMarket"


def is_matrix_market(path: Path) -> bool:
    """Tell whether a file begins as a Matrix Market file does."""
    return read_bytes(path).startswith(HEADER)


def read_matrix(path: Path) -> Contents:
    """Return the matrix of a Matrix Market file.

    Raises
    ------
    UserError
        If the file is damaged, complex, a mere pattern, or not square.
    """
    data = whole_lines(path)
    try:
        rows, columns, count, storage, kind, symmetry = scipy.io.mminfo(io.BytesIO(data))
        _require_entries(data, count if storage == "coordinate" else _dense(rows, columns, symmetry))
        matrix = (
            coo_array(scipy.io.mmread(io.BytesIO(data), spmatrix=False))
            if kind in ("real", "integer")
            else None
        )
    except (ValueError, OverflowError) as error:
        raise UserError(f"{path.name} is no complete Matrix Market file: {error}") from error
    if matrix is None:
        raise UserError(f"{path.name} holds a {kind} matrix, a real one is needed")
    if rows != columns:
        raise UserError(f"{path.name} holds a matrix of {rows} rows and {columns} columns, it must be square")
    if symmetry == "skew-symmetric":
        raise UserError(f"{path.name} holds a skew-symmetric matrix, a symmetric one is needed")
    row, column = (place.astype(np.int64) for place in matrix.coords)
    return Contents({"": Entries(path.name, row, column, matrix.data.astype(np.float64), rows, False)})


def _dense(rows: int, columns: int, symmetry: str) -> int:
    """Return how many entries an array file has: of a symmetric matrix the lower triangle."""
    return int(rows * columns if symmetry == "general" else rows * (rows + 1) // 2)


def _require_entries(data: bytes, count: int) -> None:
    """Raise ValueError unless `count` lines follow the sizes: SciPy would crash on more."""
    found = data.count(b"\n") - data.count(b"\n%") - 2
    if found != count:  # blank lines are allowed
        found = sum(1 for line in data.split(b"\n") if line.strip() and not line.startswith(b"%")) - 1
    if found != count:
        raise ValueError(f"it announces {count} entries and has {found}")
