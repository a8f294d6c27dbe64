"""From a system-disturbance store to the populations of its report: what each does at every field point."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE
from wavequake.campaign.store.retention import STATISTICS
from wavequake.report.histories import has_histories
from wavequake.report.statistics import Jitter, case_rms, jitter_of_cases
from wavequake.report.uncertain import PartedResult, parted_results
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.systems.bench import SystemBench

Array = NDArray[np.float64]

_SERIES = ("wfe_rms", "wfe_change", "spot_rms", "wfe_rms_raw", "strehl", "los_mm")
_BLOCK_BYTES = 2**26  # of time series in memory at a time
_INSTANTS = 2**20  # about the most whose Strehl ratios a median is taken of


@dataclass(frozen=True)
class FieldResult:
    """What one population does at one field point, at the primary wavelength.

    ``wfe``, ``raw`` (of the rays that arrive), ``change`` (nm), ``spot`` (um) and ``moved`` (line of sight,
    distance from rest, mm) hold the rms over its instants of each case, (C,); ``sets`` the stratified set of
    each, if cases are not independent; ``peak`` and ``ee80`` (lambda/D) are of the exposures (C,), where
    there are images, and ``peak_at_rest`` of the design itself.
    """

    field: str
    wfe: Array
    change: Array
    spot: Array
    strehl_p50: float
    marechal: float
    moved: Array
    los: Jitter
    vignetted: int
    raw: Array
    lost: int
    sets: NDArray[np.int64] | None = None
    peak: Array | None = None
    ee80: Array | None = None
    peak_at_rest: float = np.nan


@dataclass(frozen=True)
class SystemPopulation:
    """The finished cases of one disturbance.

    Attributes
    ----------
    name : str
    cases : ndarray of int, shape (C,)
        Ids.
    fields : tuple of FieldResult
    worst : int or None
        Case of the largest change of the wavefront at any instant and field point.
    """

    name: str
    cases: NDArray[np.int64]
    fields: tuple[FieldResult, ...]
    worst: int | None


def populations(dataset: xr.Dataset, bench: SystemBench) -> list[SystemPopulation]:
    """Split a store by disturbance, in the order in which the disturbances first appear.

    A few chunks are read at a time; numbers per case stay, and so many instants of the Strehl ratio that a
    median needs.
    """
    light = dataset.isel(wavelength=bench.system.primary_wavelength)
    names = np.array([str(name) for name in dataset["disturbance"].to_numpy()])
    done = dataset["status"].to_numpy() == DONE
    if "reduction" in dataset:  # of models that are compared, the full ones tell what a disturbance does
        done = done & np.array([str(one) == FULL for one in dataset["reduction"].to_numpy()])
    places = {name: np.flatnonzero(done & (names == name)) for name in dict.fromkeys(names.tolist())}
    present = {
        name: np.isfinite(light["time_s"].isel(case=rows[0]).to_numpy())  # as many instants in each case
        for name, rows in places.items()
        if len(rows) and has_histories(light)
    }
    parts: dict[str, list[dict[str, Array]]] = {name: [] for name in places}
    for first, last in _blocks(light):
        rows = {name: mine[(first <= mine) & (mine < last)] - first for name, mine in places.items()}
        if not any(map(len, rows.values())):
            continue
        block = {key: light[key].isel(case=slice(first, last)).to_numpy() for key in _SERIES if key in light}
        block.setdefault(
            "strehl", np.full_like(block["wfe_change"], np.nan)
        )  # the modal model does not know it
        for name, mine in rows.items():
            if len(mine) and not present:
                parts[name].append(_of_summary(block, mine))
            elif len(mine):
                every = -(-present[name].sum() * len(places[name]) // _INSTANTS)
                parts[name].append(_per_case(block, mine, present[name], every))
    return [_population(light.isel(case=places[name]), name, parts[name]) for name in places]


def _blocks(light: xr.Dataset) -> Iterator[tuple[int, int]]:
    """Yield the first case and the case after the last of blocks of whole chunks."""
    cases = light.sizes["case"]
    chunk = max(1, *light.chunks.get("case", (cases,)))
    each = sum(light[key].nbytes for key in _SERIES if key in light) / max(1, cases)
    rows = chunk * max(1, int(_BLOCK_BYTES / max(1.0, each * chunk)))
    for first in range(0, cases, rows):
        yield first, min(first + rows, cases)


def _per_case(
    block: dict[str, Array], rows: NDArray[np.int64], present: NDArray[np.bool_], every: int
) -> dict[str, Array]:
    """Return what is kept of some cases: numbers per case and field, and every n-th Strehl ratio."""
    values = {key: series[rows][:, present] for key, series in block.items()}
    return {
        **{key: case_rms(values[key]) for key in ("wfe_rms", "wfe_change", "spot_rms", "wfe_rms_raw")},
        "los_mean": values["los_mm"].mean(axis=1),
        "los_variance": values["los_mm"].var(axis=1),
        "strehl": values["strehl"][:, ::every].reshape(-1, values["strehl"].shape[2]),
        "worst": values["wfe_change"].max(axis=(1, 2)),
    }


def _of_summary(block: dict[str, Array], rows: NDArray[np.int64]) -> dict[str, Array]:
    """Return the same of statistics (case, statistic, field); of the line of sight about rest."""
    mean, rms, largest = (
        {key: series[rows, STATISTICS.index(name)] for key, series in block.items()}
        for name in ("mean", "rms", "max")
    )
    squares = np.repeat(rms["los_mm"][..., None] ** 2 / 2.0, 2, axis=-1)  # of both axes together
    return {
        **{key: rms[key] for key in ("wfe_rms", "wfe_change", "spot_rms", "wfe_rms_raw")},
        "los_mean": np.zeros_like(squares),
        "los_variance": squares,
        "strehl": mean["strehl"],
        "worst": largest["wfe_change"].max(axis=1),
    }


def _population(light: xr.Dataset, name: str, parts: Sequence[dict[str, Array]]) -> SystemPopulation:
    cases = light["case"].to_numpy()
    if not len(cases):
        return SystemPopulation(name, cases, (), None)
    values = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    sets = light["replicate"].to_numpy() if "replicate" in light.coords else None
    vignetted, lost, marechal = (light[name].to_numpy() for name in ("vignetted", "lost", "marechal"))
    at_rest = peaks_at_rest(light)
    fields = tuple(
        FieldResult(
            field=str(label),
            wfe=values["wfe_rms"][:, index],
            change=values["wfe_change"][:, index],
            spot=values["spot_rms"][:, index],
            strehl_p50=float(np.median(values["strehl"][:, index])),
            marechal=float(marechal[:, index].mean()),
            moved=np.sqrt((values["los_mean"][:, index] ** 2 + values["los_variance"][:, index]).sum(axis=1)),
            los=jitter_of_cases(
                values["los_mean"][:, index] * 1e3, values["los_variance"][:, index] * 1e6, sets
            ),
            vignetted=int(vignetted[:, index].max()),
            raw=values["wfe_rms_raw"][:, index],
            lost=int(lost[:, index].max()),
            sets=sets,
            peak_at_rest=float(at_rest[index]),
            **{key: light[key].to_numpy()[:, index] for key in ("peak", "ee80") if key in light},
        )
        for index, label in enumerate(light["field"].to_numpy())
    )
    return SystemPopulation(name, cases, fields, int(cases[np.argmax(values["worst"])]))


def peaks_at_rest(dataset: xr.Dataset) -> Array:
    """Return the peak of the design's image at every field point; NaN without images."""
    if "exposure_static" not in dataset:
        return np.full(dataset.sizes["field"], np.nan)
    found: Array = dataset["exposure_static"].max(["y", "x"]).to_numpy()
    return found


def parted_variance(found: Sequence[SystemPopulation]) -> list[PartedResult]:
    """Return the parts of the variance by excitation and by what is not known of the structure."""
    return parted_results(
        (
            one.name,
            {
                words: np.stack([getattr(field, key) for field in one.fields], axis=1)
                for words, key in (("WFE change", "change"), ("line of sight", "moved"))
            },
            one.fields[0].sets,
        )
        for one in found
        if one.fields
    )
