"""From a store to the populations of its report: one per disturbance model, without the cases that failed."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE, STATUS_MEANINGS, TODO
from wavequake.errors import UserError
from wavequake.report.statistics import Jitter, Quantile, case_rms, jitter, quantile

_SERIES = ("wfe_rms", "wfe_rms_raw", "segment_piston_rms", "strehl", "los", "centroid")
_VERDICTS = ("rayleigh", "marechal")
_NEEDED = (*_SERIES, *_VERDICTS, "ee80", "peak", "time_s", "status", "disturbance")


@dataclass(frozen=True)
class Population:
    """Finished cases of one disturbance model: C cases of T instants; and how many cases it lacks.

    Attributes
    ----------
    name : str
    cases : ndarray of int, shape (C,)
        Case ids.
    time_s : ndarray, shape (C, T)
    wfe, wfe_raw : ndarray, shape (C, T)
        Wavefront error rms of each instant, nm: of the Zernike terms j >= 4, and over all rays on glass
        without piston.
    segment_piston : ndarray, shape (C, T)
        Rms over the segments of their displacement along the normal, nm.
    los, centroid : ndarray, shape (C, T, 2)
        Line of sight by Störkle 2018, Eq. (3.39), and center of irradiance, mas.
    strehl : ndarray, shape (C, T)
    ee80 : ndarray, shape (C,)
        Radius of 80 % encircled energy, lambda/D; +inf beyond the frame.
    peak : ndarray, shape (C,)
        Largest irradiance of the exposure, which motion of the line of sight lowers, too.
    rayleigh, marechal : ndarray, shape (C,)
        Shares of a case's instants that are diffraction-limited by Störkle 2018, Eq. 3.54 and Eq. 3.55.
    quarantined, todo, incomplete : int
        Cases left out: failed, not computed yet, and marked done though a number is missing.
    sets : ndarray of int, shape (C,), or None
        The stratified set that each case belongs to; None if all are independent.
    frame : float
        Half the width of the images, lambda/D.
    """

    name: str
    cases: NDArray[np.int64]
    time_s: NDArray[np.float64]
    wfe: NDArray[np.float64]
    wfe_raw: NDArray[np.float64]
    segment_piston: NDArray[np.float64]
    los: NDArray[np.float64]
    centroid: NDArray[np.float64]
    strehl: NDArray[np.float64]
    ee80: NDArray[np.float64]
    peak: NDArray[np.float64]
    rayleigh: NDArray[np.float64]
    marechal: NDArray[np.float64]
    quarantined: int
    todo: int
    incomplete: int
    sets: NDArray[np.int64] | None = None
    frame: float = np.nan

    @cached_property
    def severity(self) -> NDArray[np.float64]:
        """What ranks the cases, shape (C,); :attr:`ranked_by` says what it is.

        The WFE on glass (rms over the instants, nm), unless the cases differ in it by less than 1 %, as where
        only the mount moves: then the line of sight about the mean of the population (rms over the instants,
        mas).
        """
        return self._los_rms if self.ranked_by == "LOS" else case_rms(self.wfe_raw)

    @cached_property
    def ranked_by(self) -> str:
        """``"WFE on glass"`` or ``"LOS"``."""
        wfe = case_rms(self.wfe_raw)
        return (
            "LOS" if len(wfe) and np.ptp(wfe) < 0.01 * wfe.max() and self._los_rms.any() else "WFE on glass"
        )

    @property
    def _los_rms(self) -> NDArray[np.float64]:
        return case_rms(np.linalg.norm(self.los - self.los.mean(axis=(0, 1)), axis=2))

    @property
    def median_index(self) -> int:
        """Index of the case whose :attr:`severity` is the median, the lower of two."""
        return int(np.argsort(self.severity, kind="stable")[(len(self.cases) - 1) // 2])

    @property
    def worst_index(self) -> int:
        """Index of the case of the largest :attr:`severity`."""
        return int(np.argmax(self.severity))


@dataclass(frozen=True)
class Summary:
    """One row of the report's table; units as in :class:`Population`.

    ``los_model`` and ``segment_piston_model`` are what the disturbance's parameters imply, where known;
    ``peak_least`` and ``wfe_raw_most`` are those of the worst case, ``frame`` half the width of images.
    """

    name: str
    cases: int
    quarantined: int
    todo: int
    incomplete: int
    wfe_raw_p50: Quantile
    wfe_raw_p95: Quantile
    wfe_p50: Quantile
    wfe_p95: Quantile
    los_jitter: Jitter
    centroid_jitter: Jitter
    los_model: float | None
    segment_piston: float
    segment_piston_model: float | None
    strehl_p5: Quantile
    strehl_p50: Quantile
    ee80_p50: Quantile
    peak_p5: Quantile
    rayleigh: float
    marechal: float
    frame: float = np.nan
    peak_least: float = np.nan
    wfe_raw_most: float = np.nan


@dataclass(frozen=True)
class Excluded:
    """A case that no statistic contains, and why."""

    case: int
    disturbance: str
    realization: int | None
    reason: str
    message: str


def populations(dataset: xr.Dataset) -> tuple[Population, ...]:
    """Split a store by disturbance, in the order in which the disturbances first appear.

    Raises
    ------
    UserError
        If the dataset is not that of a segment-disturbance campaign.
    """
    arrays = _arrays(dataset)
    arrays["frame"] = np.array(frame_of(dataset))
    names = list(dict.fromkeys(arrays["disturbance"].tolist()))
    return tuple(_population(str(name), arrays) for name in names)


def frame_of(dataset: xr.Dataset) -> float:
    """Return half the width of a store's images, kept or not, in the unit of their axes; NaN without any."""
    if "x" in dataset.coords:
        return -float(dataset["x"].to_numpy().min())
    try:
        imaging = json.loads(dataset.attrs.get("study", "{}"))["imaging"]
        return int(imaging["pixels"]) // 2 * float(imaging["sampling"])
    except (ValueError, KeyError, TypeError):
        return np.nan


def representatives(dataset: xr.Dataset) -> dict[str, tuple[int, int]]:
    """Return the ids of the median and the worst case of each disturbance, those worth recomputing in full.

    A disturbance without finished cases has no entry.
    """
    return {
        population.name: (
            int(population.cases[population.median_index]),
            int(population.cases[population.worst_index]),
        )
        for population in populations(dataset)
        if len(population.cases)
    }


def summarize(population: Population, analytic: tuple[float, str] | None = None) -> Summary:
    """Reduce a population to one row of the table.

    The wavefront error of a case is the rms over its instants; its quantiles are over cases. Strehl quantiles
    are over the instants of all cases. `analytic` is the rms that the disturbance model implies, if it is
    known, and its unit: ``mas`` of the line of sight (radial) or ``nm`` of the segments along their normals.
    """
    cases = len(population.cases)
    value, unit = analytic or (0.0, "")
    raw, fitted = case_rms(population.wfe_raw), case_rms(population.wfe)
    sets = population.sets
    return Summary(
        name=population.name,
        cases=cases,
        quarantined=population.quarantined,
        todo=population.todo,
        incomplete=population.incomplete,
        wfe_raw_p50=quantile(raw, 0.50, sets=sets),
        wfe_raw_p95=quantile(raw, 0.95, sets=sets),
        wfe_p50=quantile(fitted, 0.50, sets=sets),
        wfe_p95=quantile(fitted, 0.95, sets=sets),
        los_jitter=jitter(population.los, sets),
        centroid_jitter=jitter(population.centroid, sets),
        los_model=value if unit == "mas" else None,
        segment_piston=float(np.sqrt(np.mean(population.segment_piston**2))) if cases else np.nan,
        segment_piston_model=value if unit == "nm" else None,
        strehl_p5=quantile(population.strehl, 0.05, cases, sets),
        strehl_p50=quantile(population.strehl, 0.50, cases, sets),
        ee80_p50=quantile(population.ee80, 0.50, sets=sets),
        peak_p5=quantile(population.peak, 0.05, sets=sets),
        rayleigh=float(population.rayleigh.mean()) if cases else np.nan,
        marechal=float(population.marechal.mean()) if cases else np.nan,
        frame=population.frame,
        peak_least=float(population.peak.min()) if cases else np.nan,
        wfe_raw_most=float(raw.max()) if cases else np.nan,
    )


def nothing_known(failed: Mapping[str, int]) -> str:
    """Say of which disturbances every case failed, by how many: they may be the worst of all."""
    names = [name for name, cases in failed.items() if cases]
    if not names:
        return ""
    lost = sum(failed.values())
    all_ = "their" if len(names) > 1 else "its"
    words = f"all {lost} of {all_} cases" if lost > 1 else "its only case"
    return f"Of {' and '.join(names)} nothing is known: {words} failed. "


def excluded(dataset: xr.Dataset) -> list[Excluded]:
    """Return the cases that are in no statistic although computed: quarantined, or with a number missing."""
    arrays = _arrays(dataset)
    return left_out(dataset, missing=(arrays["status"] == DONE) & ~arrays["usable"])


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


def _arrays(dataset: xr.Dataset) -> dict[str, NDArray[Any]]:
    """Load what the statistics need, with the case first, and tell which cases they may use."""
    missing = [name for name in _NEEDED if name not in dataset]
    if missing:
        raise UserError(f"The store has no {missing[0]!r}, so it is not one that this report can be made of.")
    arrays = {name: dataset[name].transpose("case", ...).to_numpy() for name in _NEEDED if name != "time_s"}
    arrays["time_s"] = (
        dataset["time_s"].broadcast_like(dataset["strehl"]).transpose("case", "time").to_numpy()
    )
    arrays["case"] = (
        dataset["case"].to_numpy() if "case" in dataset.coords else np.arange(dataset.sizes["case"])
    )
    if "replicate" in dataset.coords:
        arrays["replicate"] = dataset["replicate"].to_numpy()
    arrays["usable"] = _usable(arrays)
    return arrays


def _usable(arrays: dict[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Tell which cases are done and whole: no number missing, and as many instants as their population has.

    Populations of fewer instants than the longest one end in NaN; an infinite EE80 is a number.
    """
    instants = np.isfinite(arrays["time_s"])
    whole: NDArray[np.bool_] = (
        (arrays["status"] == DONE) & ~np.isnan(arrays["ee80"]) & ~np.isnan(arrays["peak"])
    )
    for name in _SERIES:
        finite = np.isfinite(arrays[name]).reshape(*instants.shape, -1).all(axis=2)
        whole &= (finite | ~instants).all(axis=1)
    count = np.where(whole, instants.sum(axis=1), 0)
    for name in set(arrays["disturbance"].tolist()):
        mine = arrays["disturbance"] == name
        whole[mine] &= (count[mine] == count[mine].max()) & (count[mine] > 0)
    return whole


def _population(name: str, arrays: dict[str, NDArray[Any]]) -> Population:
    mine, status = arrays["disturbance"] == name, arrays["status"]
    usable = mine & arrays["usable"]
    instants = np.isfinite(arrays["time_s"][usable]).any(axis=0)
    series = {key: arrays[key][usable][:, instants].astype(np.float64) for key in (*_SERIES, "time_s")}
    return Population(
        name=name,
        cases=arrays["case"][usable].astype(np.int64),
        time_s=series["time_s"],
        wfe=series["wfe_rms"],
        wfe_raw=series["wfe_rms_raw"],
        segment_piston=series["segment_piston_rms"],
        los=series["los"],
        centroid=series["centroid"],
        strehl=series["strehl"],
        ee80=arrays["ee80"][usable].astype(np.float64),
        peak=arrays["peak"][usable].astype(np.float64),
        rayleigh=arrays["rayleigh"][usable].astype(np.float64),
        marechal=arrays["marechal"][usable].astype(np.float64),
        quarantined=int(np.count_nonzero(mine & (status > DONE))),
        todo=int(np.count_nonzero(mine & (status == TODO))),
        incomplete=int(np.count_nonzero(mine & (status == DONE) & ~usable)),
        sets=arrays["replicate"][usable] if "replicate" in arrays else None,
        frame=float(arrays["frame"]),
    )
