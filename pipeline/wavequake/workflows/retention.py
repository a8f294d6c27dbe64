"""What of the numbers over time a store keeps: all of them, every n-th instant, or statistics per case."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.workflows.contract import Variable
from wavequake.workflows.segment_study import SegmentStoreSection

STATISTICS = ("mean", "rms", "min", "max", "p95", "last")
_RMS_ONLY = "zernike"


def kept_variables(section: SegmentStoreSection, variables: Mapping[str, Variable]) -> dict[str, Variable]:
    """Return the variables that a store keeps of those that are computed.

    In a summary the dimension ``statistic`` takes the place of ``time``, lines of sight and centroids become
    their distance from rest, and ``zernike`` becomes ``zernike_rms``.
    """
    kept = {}
    for name, variable in variables.items():
        if "time" not in variable.dims:
            kept[name] = variable
        elif section.reduce == "none":
            shape = (variable.shape[0] // section.every, *variable.shape[1:])
            kept[name] = replace(variable, shape=shape)
        elif name == _RMS_ONLY:
            kept[f"{name}_rms"] = replace(
                variable,
                dims=variable.dims[1:],
                shape=variable.shape[1:],
                attrs=_described(variable, "rms over the instants of "),
            )
        elif not variable.coordinate:
            distance = "distance from rest: " if variable.dims[1:] == ("axis",) else ""
            kept[name] = replace(
                variable,
                dims=("statistic",),
                shape=(len(STATISTICS),),
                attrs=_described(variable, f"over the instants of a case, {distance}"),
            )
    return kept


def _described(variable: Variable, before: str) -> dict[str, str]:
    return {**variable.attrs, "long_name": before + variable.attrs["long_name"]}


def kept_arrays(
    section: SegmentStoreSection,
    variables: Mapping[str, Variable],
    arrays: Mapping[str, NDArray[Any]],
    instants: NDArray[np.int64],
) -> dict[str, NDArray[Any]]:
    """Return what a store keeps of `arrays` (case, ...), of which the first `instants` (case,) count."""
    kept: dict[str, NDArray[Any]] = {}
    for name, variable in variables.items():
        values = arrays[name]
        if "time" not in variable.dims:
            kept[name] = values
        elif section.reduce == "none":
            kept[name] = values[:, section.every - 1 :: section.every]
        elif name == _RMS_ONLY:
            kept[f"{name}_rms"] = _by_count(values, instants, values.shape[2:], _rms)
        elif not variable.coordinate:
            series = np.linalg.norm(values, axis=2) if values.ndim == 3 else values
            kept[name] = _by_count(series, instants, (len(STATISTICS),), statistics_over_time)
    return kept


def _by_count(values: NDArray[Any], instants: NDArray[np.int64], shape: tuple[int, ...], reducer: Any) -> Any:
    """Reduce the first instants of each case; those of equal number together."""
    found = np.full((len(values), *shape), np.nan)
    for count in np.unique(instants):
        mine = instants == count
        found[mine] = reducer(np.ascontiguousarray(values[mine, :count]))
    return found


def _rms(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sqrt(np.mean(values**2, axis=1)), dtype=np.float64)


def statistics_over_time(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the STATISTICS (case, 6) of series (case, n)."""
    return np.stack(
        [
            np.mean(values, axis=1),
            _rms(values),
            values.min(axis=1),
            values.max(axis=1),
            np.quantile(values, 0.95, axis=1),
            values[:, -1],
        ],
        axis=1,
    )
