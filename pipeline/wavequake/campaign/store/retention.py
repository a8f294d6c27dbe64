"""What a store keeps: every instant, every n-th or statistics per case; images, also rounded, or none.

A workflow computes histories and knows nothing of this: its template and its results pass through here on
their way to the store.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import ChunkResult, StudyKind, Template, Variable
from wavequake.campaign.engine.chunk_size import stored_bytes

Array = NDArray[np.float64]

STATISTICS = ("mean", "rms", "min", "max", "p95", "last")


@dataclass(frozen=True)
class Retention:
    """Keep every n-th instant, or with ``reduce = "summary"`` statistics over the instants of a case.

    Images are kept in double or single precision, or not at all ("none").
    """

    every: int = 1
    reduce: str = "none"
    images: str = "double"


@lru_cache(maxsize=8)
def retention_of(study: str) -> Retention:
    """Return what the study with this identity text keeps."""
    section = json.loads(study).get("store", {})
    return Retention(section.get("every", 1), section.get("reduce", "none"), section.get("images", "double"))


def stored_template(workflow: StudyKind, study: str) -> Template:
    """Return what a store of this study holds of what its workflow computes."""
    return kept_template(retention_of(study), workflow.template(study))


def kept_template(retention: Retention, computed: Template) -> Template:
    """Return what is kept of a template.

    In a summary the dimension ``statistic`` takes the place of ``time``, vectors (lines of sight, centroids)
    become their lengths, that is distances from rest, and coefficients their rms, as ``zernike_rms``. Without
    images the labels of their dimensions go, too.
    """
    if retention == Retention():
        return computed
    per_case: dict[str, Variable] = {}
    for name, variable in computed.per_case.items():
        per_case |= _kept_variable(retention, name, variable)
    fixed = dict(computed.fixed)
    if retention.images == "none":
        gone = _dims(filter(_is_image, computed.per_case.values())) - _dims(per_case.values())
        fixed = {name: entry for name, entry in fixed.items() if not gone & {*entry[0]}}
    for name, (dims, values, attrs) in computed.fixed.items():
        if name not in fixed or "time" not in dims:
            continue
        if retention.reduce == "none":
            fixed[name] = (dims, _decimated(values, dims.index("time"), retention.every), attrs)
        else:
            del fixed[name]
    if retention.reduce == "summary":
        words = {"long_name": "statistic over the instants of a case"}
        fixed["statistic"] = (("statistic",), np.array(STATISTICS, dtype=object), words)
    return Template(per_case, fixed, max(computed.working_bytes, stored_bytes(computed)))


def _dims(variables: Iterable[Variable]) -> set[str]:
    return {dim for variable in variables for dim in variable.dims}


def _is_image(variable: Variable) -> bool:
    return {"y", "x"} <= {*variable.dims}


def _kept_variable(retention: Retention, name: str, variable: Variable) -> dict[str, Variable]:
    """Return what is kept of a variable, under its name; nothing of the time axis of a summary."""
    if _is_image(variable):
        if retention.images == "none":
            return {}
        if retention.images == "single":
            variable = replace(variable, dtype="float32")
    sizes = dict(zip(variable.dims, variable.shape, strict=True))
    if "time" not in sizes:
        return {name: variable}
    if retention.reduce == "none":
        sizes["time"] //= retention.every
        return {name: replace(variable, shape=tuple(sizes.values()))}
    if variable.coordinate:
        return {}
    words = "over the instants of a case, "
    if "noll" in sizes:
        name, words = f"{name}_rms", "rms over the instants of "
        del sizes["time"]
    elif sizes.pop("axis", None):
        words += "distance from rest: "
    kept = {"statistic" if dim == "time" else dim: size for dim, size in sizes.items()}
    kept |= {"statistic": len(STATISTICS)} if "time" in sizes else {}
    attrs = {**variable.attrs, "long_name": words + variable.attrs["long_name"]}
    found = replace(variable, dims=tuple(kept), shape=tuple(kept.values()), attrs=attrs, dtype="float64")
    return {name: found}


def kept_result(study: str, computed: Template, result: ChunkResult) -> ChunkResult:
    """Return what the study with this identity text keeps of results that have the shapes of `computed`."""
    retention = retention_of(study)
    if retention == Retention():
        return result
    instants = _instants(computed, result.arrays, len(result.status))
    arrays: dict[str, NDArray[Any]] = {}
    for name, variable in computed.per_case.items():
        for kept, stored in _kept_variable(retention, name, variable).items():
            values = _kept_array(retention, variable, result.arrays[name], instants)
            arrays[kept] = values.astype(stored.dtype, copy=False)
    return replace(result, arrays=arrays)


def _instants(computed: Template, arrays: Mapping[str, NDArray[Any]], cases: int) -> NDArray[np.int64]:
    """Return how many instants each case has, the first ones; none of a case that failed."""
    if "time_s" in computed.per_case:
        return np.asarray(np.isfinite(arrays["time_s"]).sum(axis=1), dtype=np.int64)
    shapes = (zip(one.dims, one.shape, strict=True) for one in computed.per_case.values())
    most = max(size for shape in shapes for dim, size in shape if dim == "time")
    return np.full(cases, most, dtype=np.int64)


def _kept_array(
    retention: Retention, variable: Variable, values: NDArray[Any], instants: NDArray[np.int64]
) -> NDArray[Any]:
    if "time" not in variable.dims:
        return values
    axis = 1 + variable.dims.index("time")
    if retention.reduce == "none":
        return _decimated(values, axis, retention.every)
    series = np.moveaxis(values.astype(np.float64, copy=False), axis, 1)
    if "noll" in variable.dims:
        return _by_count(series, instants, _rms)
    if "axis" in variable.dims:
        series = np.linalg.norm(series, axis=1 + variable.dims.index("axis"))
    return np.moveaxis(_by_count(series, instants, statistics_over_time), 1, axis)


def _decimated(values: NDArray[Any], axis: int, every: int) -> NDArray[Any]:
    """Return the last of every `every` instants along an axis."""
    return values[(slice(None),) * axis + (slice(every - 1, None, every),)]


def _by_count(series: Array, instants: NDArray[np.int64], reducer: Callable[[Array], Array]) -> Array:
    """Reduce the first instants of each case (case, time, ...); those of equal number together."""
    found = np.full((len(series), *reducer(series[:0]).shape[1:]), np.nan)
    for count in np.unique(instants[instants > 0]):
        mine = instants == count
        found[mine] = reducer(np.ascontiguousarray(series[mine, :count]))
    return found


def _rms(series: Array) -> Array:
    with np.errstate(over="ignore"):
        return np.asarray(np.sqrt(np.mean(series**2, axis=1)))


def statistics_over_time(series: Array) -> Array:
    """Return the STATISTICS (case, 6, ...) of series (case, n, ...)."""
    rows = np.ascontiguousarray(np.moveaxis(series, 1, -1))  # each sum has its own order, whatever is beside
    with np.errstate(invalid="ignore", over="ignore"):  # of a case that diverged
        found = [
            np.mean(rows, axis=-1),
            np.sqrt(np.mean(rows**2, axis=-1)),
            rows.min(axis=-1),
            rows.max(axis=-1),
            np.quantile(rows, 0.95, axis=-1),
            rows[..., -1],
        ]
    return np.stack(found, axis=1)
