"""What reports can show of stores that keep less than all instants, and what they say of it."""

import json

import xarray as xr

_SUMMARY = (
    "The store keeps statistics of each case over its instants (store.reduce = 'summary'): lines of sight "
    "are distances from rest, Strehl ratios means of cases, and figures over time are left out. `wavequake "
    "rerun STORE --case ID` gives the histories of a case."
)
_DECIMATED = (
    "The store keeps one of every {} instants (store.every): what is said over time is of these, and figures "
    "that need all are left out. `wavequake rerun STORE --case ID` gives all instants of a case."
)


def has_histories(dataset: xr.Dataset) -> bool:
    """Return whether a store keeps numbers over time."""
    return "time" in dataset.dims


def has_all_instants(dataset: xr.Dataset) -> bool:
    """Return whether a store keeps every instant."""
    return has_histories(dataset) and _every(dataset) == 1


def what_is_kept(dataset: xr.Dataset) -> str:
    """Return in words what a store keeps over time, with a space before; nothing where that is all."""
    if not has_histories(dataset):
        return f" {_SUMMARY}"
    return "" if _every(dataset) == 1 else " " + _DECIMATED.format(_every(dataset))


def _every(dataset: xr.Dataset) -> int:
    study = json.loads(dataset.attrs.get("study", "{}"))
    return int(study.get("store", {}).get("every", 1))


def over_time(values: xr.DataArray, statistic: str, skipna: bool | None = None) -> xr.DataArray:
    """Return the mean or max over the instants of each case, lazily; of a summary what it holds."""
    if "statistic" in values.dims:
        return values.sel(statistic=statistic, drop=True)
    found: xr.DataArray = getattr(values, statistic)("time", skipna=skipna)
    return found


def wander(sight: xr.DataArray) -> xr.DataArray:
    """Return the rms of the line of sight about the mean of each case, lazily; of a summary about rest."""
    if "statistic" in sight.dims:
        return sight.sel(statistic="rms", drop=True)
    found: xr.DataArray = ((sight - sight.mean("time")) ** 2).sum("axis").mean("time") ** 0.5
    return found
