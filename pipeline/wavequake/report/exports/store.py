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

from wavequake.campaign.statistics.blocks import blocks
from wavequake.errors import UserError

_FIRST, _LAST = ("case", "seed", "disturbance", "springs"), ("realization", "replicate", "status", "message")
# Dimensions of which each entry has a column of its own: by its name, or by its number from 1.
_NAMED = ("controller", "firmware", "signal", "statistic")
_SPREAD = ("excitation", "field", "wavelength", "axis", "mode", *_NAMED)


def export(dataset: xr.Dataset, path: str | Path, overwrite: bool = False) -> Path:
    """Write what ``open_store`` gives to a .nc, .fits or .csv file, which appears whole or not at all.

    The store may be larger than memory: blocks of cases are read one after the other. NetCDF is of version 4
    (HDF5). FITS, which needs Astropy, has a table ``CASES`` of the labels and scalars of each case, and an
    image extension per array, whose last axis is the case. CSV holds the labels of each case, its scalars,
    and the mean and rms (about zero) over its instants or the statistics that a summary holds, at each field,
    wavelength and excitation (``_field1_wavelength2``, from 1) and of each controller (``_FF``); a number
    that is missing is an empty cell.

    Raises
    ------
    UserError
        If the file exists and shall not be overwritten, its name ends otherwise, its folder is missing, it
        cannot be written (a full disk), or Astropy is missing.
    """
    target = target_of(path, overwrite)
    partial = target.with_name(f".{target.name}.partial-{uuid.uuid4().hex}")
    try:
        _WRITERS[target.suffix](dataset, partial)
        os.replace(partial, target)
    except OSError as error:
        reason = os.strerror(error.errno).lower() if error.errno else f"{error} (is the disk full?)"
        raise UserError(f"{target} cannot be written: {reason}.") from None
    finally:
        partial.unlink(missing_ok=True)
    return target.resolve()


def target_of(path: str | Path, overwrite: bool = False) -> Path:
    """Return the file to export to; raises UserError as :func:`export`, without reading any number."""
    target = Path(path)
    if target.suffix not in _WRITERS:
        raise UserError(
            f"{target} must end in .nc, .fits or .csv, or, with --case, in .zmx or .txt, "
            "which says what to export to."
        )
    if target.suffix == ".fits" and find_spec("astropy") is None:
        raise UserError("FITS files need Astropy: pip install astropy.")
    if target.is_dir() or not target.parent.is_dir():
        raise UserError(f"{target} is a folder, or is in none; name a file in a folder that exists.")
    if target.exists() and not overwrite:
        raise UserError(f"{target} exists already; choose another name or give --overwrite.")
    return target


def _write_netcdf(dataset: xr.Dataset, path: Path) -> None:
    from wavequake.report.exports.netcdf_file import write_netcdf  # HDF5 takes a while to load

    write_netcdf(dataset, path)


def _write_fits(dataset: xr.Dataset, path: Path) -> None:
    from wavequake.report.exports.fits_file import write_fits  # Astropy may be missing

    write_fits(dataset, path)


def _write_csv(dataset: xr.Dataset, path: Path) -> None:
    texts = _FIRST + _LAST
    shown = dataset[[name for name in dataset.data_vars if name in texts or _has_columns(dataset[name])]]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        # Text takes several times the memory of numbers; where there are no cases there is a head.
        for cases in list(blocks(shown.variables.values(), 0.25)) or [slice(0, 0)]:
            columns = _columns(shown.isel(case=cases))
            if cases.start == 0:
                writer.writerow(columns)
            writer.writerows(zip(*columns.values(), strict=True))


def _has_columns(variable: xr.DataArray) -> bool:
    dims = tuple(map(str, variable.dims))
    return dims[:1] == ("case",) and {*dims} <= {"case", "time", *_SPREAD}


def _columns(dataset: xr.Dataset) -> dict[str, list[Any]]:
    """Return header -> cells of the cases of a dataset."""
    others = (str(name) for name, one in dataset.coords.items() if one.dims == ("case",))
    labels = [*_FIRST, *(name for name in others if name not in _FIRST + _LAST), *_LAST]
    columns = {name: dataset[name].to_numpy().tolist() for name in labels if name in dataset.variables}
    for name in dataset.data_vars:
        if name in _FIRST + _LAST:
            continue
        variable = dataset[name].load()  # once, not entry by entry
        dims = tuple(map(str, variable.dims))
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
