"""From a store to the populations of its report: one per disturbance model, without the cases that failed."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE, STATUS_MEANINGS, TODO
from wavequake.campaign.statistics.blocks import blocks
from wavequake.errors import UserError
from wavequake.report.statistics import Jitter, Quantile, jitter_of_cases, quantile

Array = NDArray[np.float64]

_SERIES = ("wfe_rms", "wfe_rms_raw", "segment_piston_rms", "los")
_MOTIONS = ("los", "centroid")
_NEEDED = (*_SERIES, "marechal", "status", "disturbance")
_OF_WHOLE = ("strehl", "centroid", "rayleigh", "ee80", "peak", "time_s")
_MOST_INSTANTS = 2_000_000  # of all cases: the report of every instant takes some 0.3 GB then


@dataclass(frozen=True)
class Population:
    """Finished cases of one disturbance model, a number per case each: C cases; and how many it lacks.

    Attributes
    ----------
    name : str
    cases : ndarray of int, shape (C,)
        Case ids.
    whole : bool
        Whether the store keeps images, and every instant of few enough: without, nothing is known of
        jitter, ``strehl``, ``ee80``, ``peak`` and ``rayleigh``.
    wfe, wfe_raw : ndarray, shape (C,)
        Wavefront error, rms over the instants, nm: of the Zernike terms j >= 4, and over all rays on glass
        without piston.
    segment_piston : ndarray, shape (C,)
        Rms over segments and instants of their displacement along the normal, nm.
    los : ndarray, shape (C,)
        Distance of the line of sight by Störkle 2018, Eq. (3.39), from rest, rms over the instants, mas.
    los_about : ndarray, shape (C,)
        The same about the mean of the population; not of a whole store as `los`.
    los_jitter, centroid_jitter : Jitter
        Of the line of sight, and of the center of irradiance, mas.
    strehl : ndarray, shape (C, T)
        Of each instant.
    ee80 : ndarray, shape (C,)
        Radius of 80 % encircled energy, lambda/D; +inf beyond the frame.
    peak : ndarray, shape (C,)
        Largest irradiance of the exposure, which motion of the line of sight lowers, too.
    rayleigh, marechal : ndarray, shape (C,)
        Shares of a case's instants that are diffraction-limited by Störkle 2018, Eq. 3.54 and Eq. 3.55.
    quarantined, todo : int
        Cases left out: failed, and not computed yet.
    incomplete : ndarray of int
        Rows of the store that are left out: marked done though a number is missing.
    sets : ndarray of int, shape (C,), or None
        The stratified set that each case belongs to; None if all are independent.
    frame : float
        Half the width of the images, lambda/D.
    model : (float, str) or None
        The rms that the disturbance implies by its definition, and its unit: ``mas`` of the line of sight
        (both axes together) or ``nm`` of the segments along their normals.
    """

    name: str
    cases: NDArray[np.int64]
    whole: bool
    wfe: Array
    wfe_raw: Array
    segment_piston: Array
    los: Array
    los_about: Array
    los_jitter: Jitter
    centroid_jitter: Jitter
    strehl: Array
    ee80: Array
    peak: Array
    rayleigh: Array
    marechal: Array
    quarantined: int
    todo: int
    incomplete: NDArray[np.int64]
    sets: NDArray[np.int64] | None = None
    frame: float = np.nan
    model: tuple[float, str] | None = None

    def quantile(self, values: Array, probability: float) -> Quantile:
        """Return a quantile over the cases, or over the instants of all of them."""
        return quantile(values, probability, len(self.cases), self.sets)

    def model_in(self, unit: str) -> float:
        """Return what the disturbance implies in this unit; NaN where that is not known."""
        return self.model[0] if self.model and self.model[1] == unit else np.nan

    @property
    def severity(self) -> Array:
        """What ranks the cases, shape (C,); :attr:`ranked_by` says what it is.

        The WFE on glass (rms over the instants, nm), unless the cases differ in it by less than 1 %, as where
        only the mount moves: then the line of sight about the mean of the population (rms over the instants,
        mas).
        """
        return self.los_about if self.ranked_by == "LOS" else self.wfe_raw

    @cached_property
    def ranked_by(self) -> str:
        """``"WFE on glass"`` or ``"LOS"``."""
        wfe = self.wfe_raw
        alike = len(wfe) > 0 and np.ptp(wfe) < 0.01 * wfe.max()
        return "LOS" if alike and self.los_about.any() else "WFE on glass"

    @property
    def median_index(self) -> int:
        """Index of the case whose :attr:`severity` is the median, the lower of two."""
        return int(np.argsort(self.severity, kind="stable")[(len(self.cases) - 1) // 2])

    @property
    def worst_index(self) -> int:
        """Index of the case of the largest :attr:`severity`."""
        return int(np.argmax(self.severity))


@dataclass(frozen=True)
class Histories:
    """The instants of a population's cases: time, s, WFE on glass, nm, and line of sight, mas.

    Their shapes are (C, T), (C, T), (C, T, 2).
    """

    time_s: Array
    wfe_raw: Array
    los: Array


@dataclass(frozen=True)
class Excluded:
    """A case that no statistic contains, and why."""

    case: int
    disturbance: str
    realization: int | None
    reason: str
    message: str


def is_whole(dataset: xr.Dataset) -> bool:
    """Return whether a store has images, and instants that are few enough to be in memory together."""
    series = dataset["wfe_rms"]
    return "exposure" in dataset and "time" in series.dims and series.size <= _MOST_INSTANTS


def populations(
    dataset: xr.Dataset, models: Mapping[str, tuple[float, str]] | None = None
) -> tuple[Population, ...]:
    """Split a store by disturbance, in the order in which the disturbances first appear.

    Of each series one number per case is read, chunk by chunk. `models` are the populations' ``model``.

    Raises
    ------
    UserError
        If the dataset is not that of a segment-disturbance campaign.
    """
    numbers = _numbers(dataset)
    names, frame = numbers["disturbance"].to_numpy(), frame_of(dataset)
    usable = _usable(numbers)
    return tuple(
        _population(str(name), numbers, usable, frame, (models or {}).get(str(name)))
        for name in dict.fromkeys(names.tolist())
    )


def histories_of(dataset: xr.Dataset, population: Population) -> Histories:
    """Read the instants of a population from a whole store, or from what of it holds its cases once."""
    ids = dataset["case"].to_numpy() if "case" in dataset.coords else np.arange(dataset.sizes["case"])
    part = dataset.isel(case=np.flatnonzero(np.isin(ids, population.cases)))
    time = part["time_s"].broadcast_like(part["wfe_rms_raw"]).transpose("case", "time").to_numpy()
    kept = np.isfinite(time).any(axis=0)
    wfe, los = (
        part[name].transpose("case", "time", ...).to_numpy()[:, kept].astype(np.float64)
        for name in ("wfe_rms_raw", "los")
    )
    return Histories(time[:, kept], wfe, los)


def frame_of(dataset: xr.Dataset) -> float:
    """Return half the width of a store's images, kept or not, in the unit of their axes; NaN without any."""
    if "x" in dataset.coords:
        return -float(dataset["x"].to_numpy().min())
    try:
        imaging = json.loads(dataset.attrs.get("study", "{}"))["imaging"]
        return int(imaging["pixels"]) // 2 * float(imaging["sampling"])
    except (ValueError, KeyError, TypeError):
        return np.nan


def representatives(found: Iterable[Population]) -> dict[str, tuple[int, int]]:
    """Return the ids of the median and the worst case of each disturbance, those worth recomputing in full.

    A disturbance without finished cases has no entry.
    """
    return {
        one.name: (int(one.cases[one.median_index]), int(one.cases[one.worst_index]))
        for one in found
        if len(one.cases)
    }


def nothing_known(failed: Mapping[str, int]) -> str:
    """Say of which disturbances every case failed, by how many: they may be the worst of all."""
    names = [name for name, cases in failed.items() if cases]
    if not names:
        return ""
    lost = sum(failed.values())
    all_ = "their" if len(names) > 1 else "its"
    words = f"all {lost} of {all_} cases" if lost > 1 else "its only case"
    return f"Of {' and '.join(names)} nothing is known: {words} failed. "


def excluded(dataset: xr.Dataset, found: Sequence[Population], most: int | None = None) -> list[Excluded]:
    """Return the cases that are in no statistic although computed: quarantined, or with a number missing."""
    missing = np.zeros(dataset.sizes["case"], dtype=bool)
    missing[np.concatenate([one.incomplete for one in found])] = True
    return left_out(dataset, most=most, missing=missing)


def left_out(
    dataset: xr.Dataset,
    labels: str | Sequence[str] = "disturbance",
    most: int | None = None,
    missing: NDArray[np.bool_] | bool = False,
) -> list[Excluded]:
    """Return the cases that failed (the first `most` of them), with the reason; `labels` name them.

    Those that are done are among them where a number is `missing`.
    """
    status, meanings = dataset["status"].to_numpy(), STATUS_MEANINGS.split()
    rows = np.flatnonzero(((status != DONE) & (status != TODO)) | missing)[:most]
    failed = dataset.isel(case=rows)
    names = [failed[name].to_numpy() for name in ([labels] if isinstance(labels, str) else labels)]
    ids = failed["case"].to_numpy() if "case" in failed.coords else rows
    messages = failed["message"].to_numpy() if "message" in failed else np.full(len(rows), "")
    realizations = failed["realization"].to_numpy() if "realization" in failed.coords else None
    return [
        Excluded(
            int(ids[place]),
            " / ".join(str(values[place]) for values in names),
            None if realizations is None else int(realizations[place]),
            "a number is missing" if status[row] == DONE else meanings[status[row]].replace("_", " "),
            str(messages[place]),
        )
        for place, row in enumerate(rows)
    ]


def _numbers(dataset: xr.Dataset) -> xr.Dataset:
    """Read what statistics need: of each series one number per case, NaN where an instant has none."""
    whole = is_whole(dataset) if "wfe_rms" in dataset else False
    needed = (*_NEEDED, *(_OF_WHOLE if whole else ()))
    missing = [name for name in needed if name not in dataset]
    if missing:
        raise UserError(f"The store has no {missing[0]!r}, so it is not one that this report can be made of.")
    if "case" not in dataset.coords:
        dataset = dataset.assign_coords(case=np.arange(dataset.sizes["case"]))
    kept = [name for name in (*needed, "replicate") if name in dataset.variables]
    found = dataset[[name for name in kept if name not in (*_SERIES, *_MOTIONS, "time_s")]]
    if "time" not in dataset["wfe_rms"].dims:
        series = {name: dataset[name].sel(statistic="rms", drop=True) for name in _SERIES}
        return found.assign({name: one.astype(np.float64) for name, one in series.items()}).load()
    read = [dataset[name].variable for name in dict.fromkeys((*_SERIES, *(_MOTIONS if whole else ())))]
    parts = [_per_case(dataset.isel(case=part), whole) for part in blocks(read)]
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    axes = ("case", "axis")  # else xarray asks whether arrays are Dask's, and loads it for that
    own = {name: xr.Variable(axes[: one.ndim], one, fastpath=True) for name, one in joined.items()}
    return found.load().assign(own)


def _per_case(part: xr.Dataset, whole: bool) -> dict[str, Array]:
    """Return one number per case (case,) of each series, or a pair (case, axis)."""

    def of(name: str) -> Array:
        wanted = [one for one in ("case", "time", "axis") if one in part[name].dims]
        return part[name].transpose(*wanted).to_numpy().astype(np.float64)

    # Populations of fewer instants than the longest one end in NaN.
    instants = ~np.isnan(np.broadcast_to(of("time_s"), (part.sizes["case"], part.sizes["time"])))
    count = instants.sum(axis=1)

    def mean(values: Array) -> Array:
        tail = (1,) * (values.ndim - 2)
        total = np.where(instants.reshape(*instants.shape, *tail), values, 0.0).sum(axis=1)
        return np.asarray(total / np.where(count > 0, count, np.nan).reshape(-1, *tail))

    found = {"instants": count}
    for name in _SERIES:
        squares = of(name) ** 2
        found[name] = np.sqrt(mean(squares.sum(axis=2) if squares.ndim > 2 else squares))
    for name in _MOTIONS if whole else ():
        found[f"{name}_mean"] = mean(of(name))
        found[f"{name}_variance"] = mean((of(name) - found[f"{name}_mean"][:, None]) ** 2)
    if whole:
        found["strehl_mean"] = mean(of("strehl"))
    return found


def _usable(numbers: xr.Dataset) -> NDArray[np.bool_]:
    """Tell which cases are done and whole: no number missing, and as many instants as their population has.

    An infinite EE80 is a number.
    """
    whole: NDArray[np.bool_] = numbers["status"].to_numpy() == DONE
    for name in (*_SERIES, *(f"{name}_mean" for name in (*_MOTIONS, "strehl")), "ee80", "peak"):
        if name in numbers:
            found = numbers[name].transpose("case", ...).to_numpy()
            whole &= ~np.isnan(found).reshape(len(whole), -1).any(axis=1)
    if "instants" in numbers:
        count, names = np.where(whole, numbers["instants"], 0), numbers["disturbance"].to_numpy()
        for name in set(names.tolist()):
            mine = names == name
            whole[mine] &= (count[mine] == count[mine].max()) & (count[mine] > 0)
    return whole


def _population(
    name: str,
    numbers: xr.Dataset,
    usable: NDArray[np.bool_],
    frame: float,
    model: tuple[float, str] | None,
) -> Population:
    mine, status = numbers["disturbance"].to_numpy() == name, numbers["status"].to_numpy()
    part = numbers.isel(case=np.flatnonzero(mine & usable))
    whole = "strehl" in numbers
    sets = part["replicate"].to_numpy() if "replicate" in part.variables else None

    def of(key: str) -> Array:
        """Return numbers of the finished cases (case, ...); none of what the store has not."""
        return part[key].transpose("case", ...).to_numpy().astype(np.float64) if key in part else np.empty(0)

    means, variances = ([of(f"{key}_{what}") for key in _MOTIONS] for what in ("mean", "variance"))
    known = whole and part.sizes["case"] > 0
    sight, centroid = (jitter_of_cases(*one, sets) for one in zip(means, variances, strict=True))
    away = (means[0] - means[0].mean(axis=0)) ** 2 + variances[0] if known else of("los")[:, None] ** 2
    strehl = of("strehl")
    return Population(
        name=name,
        cases=part["case"].to_numpy().astype(np.int64),
        whole=whole,
        wfe=of("wfe_rms"),
        wfe_raw=of("wfe_rms_raw"),
        segment_piston=of("segment_piston_rms"),
        los=of("los"),
        los_about=np.sqrt(away.sum(axis=1)),
        los_jitter=sight,
        centroid_jitter=centroid,
        strehl=strehl[:, : int(part["instants"].to_numpy().max())] if known else strehl,
        ee80=of("ee80"),
        peak=of("peak"),
        rayleigh=of("rayleigh"),
        marechal=of("marechal"),
        quarantined=int(np.count_nonzero(mine & (status > DONE))),
        todo=int(np.count_nonzero(mine & (status == TODO))),
        incomplete=np.flatnonzero(mine & (status == DONE) & ~usable),
        sets=sets,
        frame=frame,
        model=model,
    )
