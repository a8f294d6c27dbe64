"""What reports can show of stores that keep less than all instants or no images, and what they say of it."""

import json
from typing import Any

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
_NO_IMAGES = (
    "The store keeps no images (store.images = 'none'), and figures of them are left out. `wavequake rerun "
    "STORE --case ID` gives those of a case."
)
_NEAR_LIMIT = (
    "These cases are drawn near a limit, and no number here is weighted: how often the limit is exceeded "
    "says wavequake rare."
)


def has_histories(dataset: xr.Dataset) -> bool:
    """Return whether a store keeps numbers over time."""
    return "time" in dataset.dims


def has_all_instants(dataset: xr.Dataset) -> bool:
    """Return whether a store keeps every instant."""
    return has_histories(dataset) and _every(dataset) == 1


def what_is_kept(dataset: xr.Dataset) -> str:
    """Return in words what a store keeps, each sentence with a space before; nothing where that is all."""
    words = []
    if not has_histories(dataset):
        words.append(_SUMMARY)
    elif _every(dataset) > 1:
        words.append(_DECIMATED.format(_every(dataset)))
    if _kept(dataset).get("images") == "none":
        words.append(_NO_IMAGES)
    if "log_weight" in dataset.variables:
        words.append(_NEAR_LIMIT)
    return "".join(f" {one}" for one in words)


def _every(dataset: xr.Dataset) -> int:
    return int(_kept(dataset).get("every", 1))


def _kept(dataset: xr.Dataset) -> dict[str, Any]:
    try:
        study = json.loads(dataset.attrs.get("study", "{}"))
    except ValueError:  # a store without a study, which reports take
        return {}
    found: dict[str, Any] = study.get("store", {})
    return found


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
