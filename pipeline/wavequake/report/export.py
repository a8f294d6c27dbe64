"""A store as one file for other programs: NetCDF or FITS with every array, or CSV with a row per case."""

import csv
import os
import uuid
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from wavequake.errors import UserError

_LABELS = ("case", "seed", "disturbance", "springs", "realization", "replicate", "status", "message")
# Dimensions of which each entry has a column of its own: by its name, or by its number from 1.
_NAMED = ("controller", "firmware", "signal", "statistic")
_SPREAD = ("excitation", "field", "wavelength", "axis", "mode", *_NAMED)
_ROWS = 5000
_NETCDF3_BYTES = 2**31 - 2**20


def export(dataset: xr.Dataset, path: str | Path, overwrite: bool = False) -> Path:
    """Write what ``open_store`` gives to a .nc, .fits or .csv file, which appears whole or not at all.

    NetCDF is of version 3 (64-bit offsets), at most 2 GiB of numbers; integers that do not fit its 32 bits,
    such as seeds, become decimal text. FITS, which needs Astropy, has a table ``CASES`` of the labels and
    scalars of each case, and an image extension per array, whose last axis is the case. CSV holds the labels
    of each case, its scalars, and the mean and rms (about zero) over its instants or the statistics that a
    summary holds, at each field, wavelength and excitation (``_field1_wavelength2``, from 1) and of each
    controller (``_FF``); a number that is missing is an empty cell.

    Raises
    ------
    UserError
        If the file exists and shall not be overwritten, its name ends otherwise, its folder is missing, the
        store is too large for NetCDF 3, or Astropy is missing.
    """
    target = target_of(path, overwrite)
    partial = target.with_name(f".{target.name}.partial-{uuid.uuid4().hex}")
    try:
        _WRITERS[target.suffix](dataset, partial)
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)
    return target.resolve()


def target_of(path: str | Path, overwrite: bool = False) -> Path:
    """Return the file to export to; raises UserError as :func:`export`, without reading any number."""
    target = Path(path)
    if target.suffix not in _WRITERS:
        raise UserError(f"{target} must end in .nc, .fits or .csv, which says what to export to.")
    if target.suffix == ".fits" and find_spec("astropy") is None:
        raise UserError("FITS files need Astropy: pip install 'wavequake[fits]'.")
    if target.is_dir() or not target.parent.is_dir():
        raise UserError(f"{target} is a folder, or is in none; name a file in a folder that exists.")
    if target.exists() and not overwrite:
        raise UserError(f"{target} exists already; choose another name or give --overwrite.")
    return target


def _write_netcdf(dataset: xr.Dataset, path: Path) -> None:
    if dataset.nbytes > _NETCDF3_BYTES:
        raise UserError(
            f"The store has {dataset.nbytes / 2**30:.1f} GiB and NetCDF 3 holds 2; export to .csv, or read "
            "the store with xarray.open_zarr."
        )
    plain = dataset.drop_encoding().load()
    converted = {name: _netcdf3(variable) for name, variable in plain.variables.items()}
    coordinates = {name: converted.pop(name) for name in plain.coords}
    xr.Dataset(converted, coordinates, plain.attrs).to_netcdf(path, engine="scipy", format="NETCDF3_64BIT")


def _netcdf3(variable: xr.Variable) -> xr.Variable:
    values = variable.to_numpy()
    if values.dtype.kind in "iu" and values.dtype.itemsize > 4:
        limits = np.iinfo(np.int32)
        fits = not values.size or (values.min() >= limits.min and values.max() <= limits.max)
        values = values.astype(np.int32 if fits else str)
    if values.dtype.kind not in "biuf":
        values = values.astype(object)
    return xr.Variable(variable.dims, values, variable.attrs)


def _write_fits(dataset: xr.Dataset, path: Path) -> None:
    from astropy.io import fits

    columns, images = [], []
    for name, variable in dataset.load().variables.items():
        values, unit = variable.to_numpy(), str(variable.attrs.get("units", ""))
        if variable.dims == ("case",):
            if values.dtype.kind not in "biuf":
                texts = [str(text).encode("ascii", "replace").decode() for text in values.tolist()]
                values = np.array(texts, dtype=f"U{max(1, *map(len, texts))}")
            columns.append(fits.Column(str(name), _fits_format(values), unit, array=values))
        elif values.dtype.kind in "biuf":
            image = fits.ImageHDU(
                values.astype(np.uint8) if values.dtype.kind == "b" else values, name=str(name)
            )
            image.header["BUNIT"] = unit
            for number, dim in enumerate(reversed(variable.dims), 1):  # FITS counts axes from the last
                image.header[f"CTYPE{number}"] = str(dim)
            images.append(image)
    first = fits.PrimaryHDU()
    for key, name in (("ORIGIN", "title"), ("STUDYID", "study_sha256"), ("CREATED", "created")):
        first.header[key] = str(dataset.attrs.get(name, "")).encode("ascii", "replace").decode()[:60]
    cases = fits.BinTableHDU.from_columns(columns, name="CASES")
    fits.HDUList([first, cases, *images]).writeto(path, checksum=True)


def _fits_format(values: NDArray[Any]) -> str:
    """Return the FITS code of a column: text, logical, 64-bit integer or 64-bit number."""
    kind = values.dtype.kind
    return f"{values.dtype.itemsize // 4}A" if kind == "U" else {"b": "L", "f": "D"}.get(kind, "K")


def _write_csv(dataset: xr.Dataset, path: Path) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        # By blocks of cases, of which there may be more than fit into memory as text; none still have a head.
        for first in range(0, max(dataset.sizes["case"], 1), _ROWS):
            columns = _columns(dataset.isel(case=slice(first, first + _ROWS)))
            if first == 0:
                writer.writerow(columns)
            writer.writerows(zip(*columns.values(), strict=True))


def _columns(dataset: xr.Dataset) -> dict[str, list[Any]]:
    """Return header -> cells of the cases of a dataset."""
    columns = {name: dataset[name].to_numpy().tolist() for name in _LABELS if name in dataset.variables}
    for name, variable in dataset.data_vars.items():
        dims = tuple(map(str, variable.dims))
        if name in _LABELS or dims[:1] != ("case",) or not {*dims} <= {"case", "time", *_SPREAD}:
            continue
        spread = [dim for dim in dims if dim in _SPREAD]
        unit = f" ({variable.attrs.get('units', '1')})"
        for place in np.ndindex(*(dataset.sizes[dim] for dim in spread)):
            one = variable.isel(dict(zip(spread, place, strict=True))).to_numpy()
            column = str(name) + "".join(
                _suffix(dataset, dim, index) for dim, index in zip(spread, place, strict=True)
            )
            if "time" in dims:
                columns |= _over_instants(column, unit, one, _present(dataset, one))
            else:
                columns[f"{column}{unit}"] = _cells(one)
    return columns


def _suffix(dataset: xr.Dataset, dim: str, index: int) -> str:
    """Return what names one of several columns: ``_x``, ``_y``, ``_rms``, or a dimension and a number."""
    if dim in _NAMED:
        return f"_{dataset[dim].to_numpy()[index]}"
    return f"_{'xy'[index]}" if dim == "axis" else f"_{dim}{index + 1}"


def _present(dataset: xr.Dataset, values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which instants each case has, (case, time): all of them where none has a time of its own."""
    if "time_s" not in dataset:
        return np.ones(values.shape, dtype=bool)
    return np.broadcast_to(np.isfinite(dataset["time_s"].to_numpy()), values.shape)


def _over_instants(
    name: str, unit: str, values: NDArray[np.float64], present: NDArray[np.bool_]
) -> dict[str, list[str]]:
    """Return mean and rms over the instants that a case has; one missing number makes both missing."""
    count = np.maximum(present.sum(axis=1), 1)
    none = np.where(present.any(axis=1), 0.0, np.nan)
    mean = np.where(present, values, 0.0).sum(axis=1) / count + none
    rms = np.sqrt(np.where(present, np.square(values), 0.0).sum(axis=1) / count) + none
    return {f"{name}_mean{unit}": _cells(mean), f"{name}_rms{unit}": _cells(rms)}


def _cells(values: NDArray[np.float64]) -> list[str]:
    """Return numbers as the shortest text that reads back the same."""
    return ["" if value != value else repr(value) for value in values.tolist()]


_WRITERS = {".nc": _write_netcdf, ".fits": _write_fits, ".csv": _write_csv}
