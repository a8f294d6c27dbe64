"""Matrices in NumPy (``.npz``) and HDF5 (``.h5``) files.

A file holds ``stiffness`` and ``mass``, each a square array or compressed columns ``NAME_data``,
``NAME_indices``, ``NAME_indptr`` (in HDF5 also a group NAME of ``data``, ``indices``, ``indptr``), perhaps
``dofs`` (n, 2: number of the node, direction 1 to 3), ``nodes`` (N, 3) and ``node_numbers`` (N,; 1..N where
absent). An ``.npz`` of `scipy.sparse.save_npz` holds one matrix.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake import user_files
from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Array, Contents, Entries, Integers, read_bytes
from wavequake.user_files import read_npz as read_arrays

Content = Mapping[str, NDArray[Any]]

MATRICES = ("stiffness", "mass")


def read_npz(path: Path) -> Contents:
    """Return what an ``.npz`` file holds.

    Raises
    ------
    UserError
        If it is no such file, or its arrays make no square matrices.
    """
    content = _named(path, lambda: read_arrays(read_bytes(path)))
    if "format" in content:
        return Contents({"": _saved_by_scipy(content, path.name)})
    return _contents(content, path.name)


def read_hdf5(path: Path) -> Contents:
    """Return what an HDF5 file holds.

    Raises
    ------
    UserError
        If the file is none of HDF5, or its arrays make no square matrices.
    """
    read_bytes(path)
    content = _named(path, lambda: user_files.read_hdf5(path))
    return _contents({name.replace("/", "_"): values for name, values in content.items()}, path.name)


def _named(path: Path, read: Callable[[], Content]) -> Content:
    try:
        return read()
    except UserError as error:
        raise UserError(f"{path.name}: {error}") from None


def _contents(content: Content, source: str) -> Contents:
    """Sort named arrays into matrices, degrees of freedom and nodes."""
    matrices = {}
    for name in MATRICES:
        label = f"{name} of {source}"
        parts = [f"{name}_{part}" for part in ("data", "indices", "indptr")]
        if name in content:
            matrix = _real(content[name], 2, label)
            if matrix.shape[0] != matrix.shape[1]:
                raise UserError(f"{label} has the shape {matrix.shape}, it must be square")
            rows, columns = np.nonzero(matrix)
            matrices[name] = _entries(rows, columns, matrix[rows, columns], len(matrix), label)
        elif all(part in content for part in parts):
            matrices[name] = _compressed([content[part] for part in parts], label)
    if not matrices:
        raise UserError(
            f"{source} holds no matrix called stiffness or mass, only "
            f"{', '.join(sorted(content)) or 'nothing'}"
        )
    dofs, nodes, labels = (content.get(name) for name in ("dofs", "nodes", "node_numbers"))
    if nodes is None:
        return Contents(matrices, None if dofs is None else _whole(dofs, 2, f"dofs of {source}", 2))
    points = _real(nodes, 2, f"nodes of {source}", 3)
    if labels is None:
        numbers = np.arange(1, len(points) + 1)
    else:
        numbers = _whole(labels, 1, f"node_numbers of {source}")
    if len(numbers) != len(points):
        raise UserError(f"node_numbers of {source} are {len(numbers)}, but there are {len(points)} nodes")
    return Contents(
        matrices,
        None if dofs is None else _whole(dofs, 2, f"dofs of {source}", 2),
        numbers,
        points,
    )


def _real(values: NDArray[Any], axes: int, label: str, columns: int | None = None) -> Array:
    """Return real numbers in an array of that many axes, and perhaps columns; UserError if it is none."""
    if values.dtype.kind == "c":
        raise UserError(f"{label} is complex, a real matrix is needed")
    if values.dtype.kind not in "biuf":
        raise UserError(f"{label} holds {values.dtype}, numbers are needed")
    if values.ndim != axes or (columns and values.shape[-1] != columns):
        needed = f"{columns} columns are needed" if columns else f"{axes} axes are needed"
        raise UserError(f"{label} has the shape {values.shape}, {needed}")
    with np.errstate(over="ignore"):  # infinite numbers are refused where they are used
        return values.astype(np.float64)


def _whole(values: NDArray[Any], axes: int, label: str, columns: int | None = None) -> Integers:
    """Return whole numbers in an array as `_real` does."""
    numbers = _real(values, axes, label, columns)
    if not (np.abs(numbers) < 2.0**53).all() or (numbers != np.rint(numbers)).any():
        raise UserError(f"{label} must be whole numbers")
    return numbers.astype(np.int64)


def _compressed(parts: Sequence[NDArray[Any]], label: str) -> Entries:
    """Return a matrix of compressed columns."""
    data, indices, indptr = parts
    values = _real(data, 1, f"data of {label}")
    rows, bounds = (_whole(part, 1, f"{what} of {label}") for part, what in
                    ((indices, "indices"), (indptr, "indptr")))  # fmt: skip
    size = len(bounds) - 1
    if size < 0 or bounds[0] or (np.diff(bounds) < 0).any() or not bounds[-1] == len(rows) == len(values):
        raise UserError(f"{label} is no square matrix of compressed columns: indptr does not fit its data")
    return _entries(rows, np.repeat(np.arange(size), np.diff(bounds)), values, size, label)


def _saved_by_scipy(content: Content, source: str) -> Entries:
    """Return the matrix that `scipy.sparse.save_npz` wrote."""
    kind = content["format"].item() if content["format"].ndim == 0 else None
    kind = kind.decode(errors="replace") if isinstance(kind, bytes) else str(kind)
    parts = {"csc": ("data", "indices", "indptr"), "csr": ("data", "indices", "indptr"),
             "coo": ("data", "row", "col")}.get(kind)  # fmt: skip
    if parts is None:
        raise UserError(f"{source} holds a sparse matrix of the format {kind[:20]!r}; save it as csc")
    missing = [name for name in (*parts, "shape") if name not in content]
    if missing:
        raise UserError(f"{source} holds a sparse matrix of the format {kind}, but no {missing[0]}")
    shape = _whole(content["shape"], 1, f"the shape of {source}").tolist()
    if len(shape) != 2 or shape[0] != shape[1]:
        raise UserError(f"{source} has the shape {tuple(shape)}, it must be square")
    if kind == "coo":
        rows, columns = (_whole(content[name], 1, f"{name} of {source}") for name in parts[1:])
        found = _entries(rows, columns, _real(content["data"], 1, f"data of {source}"), shape[0], source)
    else:
        found = _compressed([content[name] for name in parts], source)
        if kind == "csr":
            found = replace(found, rows=found.columns, columns=found.rows)
    if found.size != shape[0]:
        raise UserError(f"{source} has the shape {tuple(shape)}, but its entries are of order {found.size}")
    return found


def _entries(rows: Integers, columns: Integers, values: Array, size: int, label: str) -> Entries:
    if not len(rows) == len(columns) == len(values):
        raise UserError(f"{label} has {len(values)} values, {len(rows)} rows and {len(columns)} columns")
    outside = (rows < 0) | (rows >= size) | (columns < 0) | (columns >= size)
    if outside.any():
        at = int(np.argmax(outside))
        raise UserError(f"{label}: row {rows[at]}, column {columns[at]} lies outside its order {size}")
    return Entries(label, rows.astype(np.int64), columns.astype(np.int64), values, size, False)
