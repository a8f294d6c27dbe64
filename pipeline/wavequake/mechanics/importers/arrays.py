"""Matrices in NumPy (``.npz``) and HDF5 (``.h5``) files.

A file holds ``stiffness`` and ``mass``, each a square array or compressed columns ``NAME_data``,
``NAME_indices``, ``NAME_indptr`` (in HDF5 also a group NAME of ``data``, ``indices``, ``indptr``), perhaps
``dofs`` (n, 2: number of the node, direction 1 to 3), ``nodes`` (N, 3) and ``node_numbers`` (N,; 1..N where
absent). An ``.npz`` of `scipy.sparse.save_npz` holds one matrix.
"""

import io
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csc_array

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Contents, Entries, read_bytes

MATRICES = ("stiffness", "mass")


def read_npz(path: Path) -> Contents:
    """Return what an ``.npz`` file holds.

    Raises
    ------
    UserError
        If it is no such file, or its arrays make no square matrices.
    """
    data = io.BytesIO(read_bytes(path))
    try:
        with np.load(data, allow_pickle=False) as file:
            content = {name: file[name] for name in file.files}
    except (
        OSError,
        ValueError,
        EOFError,
        NotImplementedError,
        RuntimeError,
        zlib.error,
        zipfile.BadZipFile,
    ) as error:
        raise UserError(f"{path.name} is no NumPy .npz file: {error}") from error
    if "format" in content:
        from scipy.sparse import load_npz

        return Contents({"": _sparse(coo_array(load_npz(path)), path.name)})
    return _contents(content, path.name)


def read_hdf5(path: Path) -> Contents:
    """Return what an HDF5 file holds.

    Raises
    ------
    UserError
        If the file is none of HDF5, or its arrays make no square matrices.
    """
    import h5py  # takes a while to load

    read_bytes(path)
    content: dict[str, Any] = {}

    def collect(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            content[name.replace("/", "_")] = item[()]

    try:
        with h5py.File(path, "r") as file:
            file.visititems(collect)
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        raise UserError(f"{path.name} is no HDF5 file: {error}") from error
    return _contents(content, path.name)


def _contents(content: Mapping[str, Any], source: str) -> Contents:
    """Sort named arrays into matrices, degrees of freedom and nodes."""
    matrices = {}
    for name in MATRICES:
        label = f"{name} of {source}"
        compressed = [content.get(f"{name}_{part}") for part in ("data", "indices", "indptr")]
        if name in content:
            matrix = np.asarray(content[name])
            if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
                raise UserError(f"{label} has the shape {matrix.shape}, it must be square")
            matrices[name] = _sparse(coo_array(matrix), label)
        elif all(part is not None for part in compressed):
            size = len(compressed[2]) - 1  # type: ignore[arg-type]
            try:
                matrices[name] = _sparse(coo_array(csc_array(tuple(compressed), shape=(size, size))), label)
            except (ValueError, TypeError) as error:
                raise UserError(f"{label} is no square matrix of compressed columns: {error}") from error
    if not matrices:
        raise UserError(
            f"{source} holds no matrix called stiffness or mass, only "
            f"{', '.join(sorted(content)) or 'nothing'}"
        )
    dofs, nodes, labels = (content.get(name) for name in ("dofs", "nodes", "node_numbers"))
    return Contents(
        matrices,
        None if dofs is None else _table(dofs, 2, f"dofs of {source}").astype(np.int64),
        None if nodes is None else np.arange(1, len(nodes) + 1) if labels is None else np.asarray(labels),
        None if nodes is None else _table(nodes, 3, f"nodes of {source}").astype(np.float64),
    )


def _table(values: Any, columns: int, label: str) -> Any:
    table = np.asarray(values)
    if table.ndim != 2 or table.shape[1] != columns:
        raise UserError(f"{label} has the shape {table.shape}, {columns} columns are needed")
    return table


def _sparse(matrix: coo_array, source: str) -> Entries:
    if matrix.shape[0] != matrix.shape[1]:
        raise UserError(f"{source} has the shape {matrix.shape}, it must be square")
    if np.iscomplexobj(matrix.data):
        raise UserError(f"{source} is complex, a real matrix is needed")
    rows, columns = (place.astype(np.int64) for place in matrix.coords)
    return Entries(source, rows, columns, matrix.data.astype(np.float64), int(matrix.shape[0]), False)
