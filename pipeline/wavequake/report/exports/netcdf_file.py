"""A dataset as a NetCDF-4 file of any size, written by blocks of cases.

HDF5 crashes on a disk that is full. So it lays out the file only, and the numbers go to their places by plain
writes, whose errors Python tells.
"""

from pathlib import Path

import h5netcdf
import h5py
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from wavequake.campaign.statistics.blocks import pieces

_LAYOUT_BYTES = 2**20  # more than names, attributes and dimensions take


def write_netcdf(dataset: xr.Dataset, path: Path) -> None:
    """Write every variable of a dataset, whose arrays may be larger than memory.

    Texts become arrays of characters in UTF-8, which all readers know; truth values 8-bit integers, marked
    as xarray marks them.

    Raises
    ------
    OSError
        If the file cannot be written, as on a full disk.
    """
    path.write_bytes(bytes(_LAYOUT_BYTES))
    variables, attributes = xr.conventions.encode_dataset_coordinates(dataset)
    types = {str(name): _stored_type(variable) for name, variable in variables.items()}
    with h5netcdf.File(path, "w") as layout:
        for dim, size in dataset.sizes.items():
            layout.dimensions[str(dim)] = size
        layout.attrs.update(attributes)
        for name, variable in variables.items():
            _lay_out(layout, str(name), variable, types[str(name)])
    with h5py.File(path) as layout:
        places = {name: _place(layout, name) for name, one in variables.items() if one.size and one.ndim}
    with path.open("r+b") as file:
        for name, place in places.items():
            file.seek(place)
            for _, values in pieces(variables[name]):
                file.write(np.ascontiguousarray(_encoded(values, types[name])).data)


def _stored_type(variable: xr.Variable) -> np.dtype[np.generic]:
    """Return the type of an array in the file, of texts that of the longest."""
    kind = variable.dtype.kind
    if kind in "biuf":
        return np.dtype(np.int8) if kind == "b" else variable.dtype.newbyteorder("<")
    lengths = (_encoded(values, np.dtype("S")).itemsize for _, values in pieces(variable))
    return np.dtype(f"S{max([1, *lengths])}")


def _lay_out(file: h5netcdf.File, name: str, variable: xr.Variable, dtype: np.dtype[np.generic]) -> None:
    dims, attributes = tuple(map(str, variable.dims)), dict(variable.attrs)
    if variable.dtype.kind == "b":
        attributes["dtype"] = "bool"
    if dtype.kind == "S":
        attributes["_Encoding"] = "utf-8"
        dims = (*dims, f"string{dtype.itemsize}")
        if dims[-1] not in file.dimensions:
            file.dimensions[dims[-1]] = dtype.itemsize
    at_once = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    at_once.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    stored = "S1" if dtype.kind == "S" else dtype
    fill = np.nan if dtype.kind == "f" else None
    target = file.create_variable(name, dims, stored, fillvalue=fill, fill_time="never", dcpl=at_once)
    target.attrs.update(attributes)
    if not variable.ndim:  # HDF5 gives these no place before they are written
        target[...] = _encoded(variable.to_numpy(), dtype).reshape(-1).view(stored).reshape(target.shape)


def _place(file: h5py.File, name: str) -> int:
    """Return where the numbers of a variable begin; one with the name of a dimension has another in HDF5."""
    other = f"_nc4_non_coord_{name}"
    return int(file[other if other in file else name].id.get_offset())


def _encoded(values: NDArray[np.generic], dtype: np.dtype[np.generic]) -> NDArray[np.generic]:
    if dtype.kind != "S":
        return values.astype(dtype, copy=False)
    return np.array([str(text).encode() for text in values.ravel().tolist()], dtype)
