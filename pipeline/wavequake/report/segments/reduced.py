"""The report of a segment-disturbance store without images or instants, or with too many to read them all.

One number per case and quantity, of up to millions of cases; and how good the modal model was.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from wavequake.campaign.contract import DONE
from wavequake.campaign.store.store import read_manifest
from wavequake.mechanics.disturbances.registry import analytic_rms
from wavequake.report.answers import budget
from wavequake.report.certificate import ERRORS, certificate, modal_errors
from wavequake.report.histories import what_is_kept
from wavequake.report.page import Page, Picture, picture
from wavequake.report.populations import left_out
from wavequake.report.segments.fields import base_name
from wavequake.report.segments.vignetting import stopped_light
from wavequake.report.statistics import FEWEST, Quantile, case_rms, quantile
from wavequake.report.systems.figures import distributions
from wavequake.report.table import MISSING, empty_table, interval, number, share
from wavequake.report.uncertain import PartedResult, parted_results, sentence
from wavequake.report.uncertain import pictures as parts_pictures
from wavequake.workflows.segments.bench import bench_of

Array = NDArray[np.float64]

_SMALL_PRINT = (
    "WFE, LOS: rms of a case over its instants, of the LOS the distance from rest; P50, P95 and P99.9 over "
    "cases, with their 95 % confidence interval (≤, ≥: too few cases for both bounds). "
    "Segments: rms along their normals, beneath it what the model of the disturbance implies. Maréchal: "
    "share of instants with an rms of at most λ/14, piston and tilt removed."
)
_SERIES = ("wfe_rms_raw", "wfe_rms", "los", "segment_piston_rms")
_PERCENTILES = ((0.5, "P50"), (0.95, "P95"), (0.999, "P99.9"))
_LISTED = 1000


@dataclass(frozen=True)
class ReducedPopulation:
    """The finished cases of one disturbance, one number per case: nm, mas on the sky, shares."""

    name: str
    wfe_raw: Array
    wfe: Array
    los: Array
    segments: Array
    segments_model: float | None
    marechal: Array
    unfinished: int
    sets: NDArray[np.int64] | None = None

    def quantile(self, values: Array, probability: float) -> Quantile:
        """Return a quantile over the cases."""
        return quantile(values, probability, sets=self.sets)


def _loaded(dataset: xr.Dataset) -> xr.Dataset:
    """Read what the report needs, once: of each series one number per case."""
    names = ["marechal", "status", "message", "traced", *(f"modal_error_{name}" for name in ERRORS)]
    found = dataset[[name for name in names if name in dataset]]
    return found.assign({name: _per_case(dataset, name) for name in _SERIES}).load()


def reduced_populations(store: Path, dataset: xr.Dataset) -> list[ReducedPopulation]:
    """Split what was loaded by disturbance, in the order in which the disturbances first appear."""
    bench = bench_of(read_manifest(store).study)
    model = {entry.name: analytic_rms(entry, bench.layout) for entry in bench.study.disturbance}
    names = dataset["disturbance"].to_numpy()
    done = dataset["status"].to_numpy() == DONE
    per_case = {name: _per_case(dataset, name).to_numpy().astype(np.float64) for name in _SERIES}
    marechal = dataset["marechal"].to_numpy()
    found = []
    for name in dict.fromkeys(names.tolist()):
        mine = (names == name) & done
        value, unit = model.get(base_name(name)) or (0.0, "")
        found.append(
            ReducedPopulation(
                name=str(name),
                wfe_raw=per_case["wfe_rms_raw"][mine],
                wfe=per_case["wfe_rms"][mine],
                los=per_case["los"][mine],
                segments=per_case["segment_piston_rms"][mine],
                segments_model=value if unit == "nm" else None,
                marechal=marechal[mine],
                unfinished=int(np.count_nonzero((names == name) & ~done)),
                sets=dataset["replicate"].to_numpy()[mine] if "replicate" in dataset.coords else None,
            )
        )
    return found


def _per_case(dataset: xr.Dataset, name: str) -> xr.DataArray:
    """Return the rms over the instants of each case (case,), lazily; instants that it has not are NaN."""
    values = dataset[name]
    if "statistic" in values.dims:
        return values.sel(statistic="rms", drop=True)
    if values.dims == ("case",):  # so it was loaded
        return values
    squares = values**2
    if "axis" in values.dims:
        squares = squares.sum("axis", skipna=False)
    return (squares.mean("time") ** 0.5).assign_attrs(values.attrs)


def parted_variance(store: Path, dataset: xr.Dataset) -> list[PartedResult]:
    """Return the parts of the variance by excitation and by what is not known of the segments' supports."""
    if bench_of(read_manifest(store).study).study.structure is None or "replicate" not in dataset.coords:
        return []
    names = {"wfe_rms_raw": "WFE on glass", "los": "line of sight"}
    found = {words: _per_case(dataset, key).transpose("case", ...).to_numpy() for key, words in names.items()}
    return parted_results(dataset, {words: one.reshape(len(one), -1) for words, one in found.items()})


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    kept, light, dataset = what_is_kept(dataset), stopped_light(store, dataset), _loaded(dataset)
    caption = "\n\n".join(
        [
            *([light] if light else []),
            _SMALL_PRINT + kept,
            *certificate(bench_of(read_manifest(store).study).study.optics.modal_tolerance_nm, dataset),
        ]
    )
    words = ("disturbance\ncases", "")
    numbers = "WFE on glass\nrms (nm)", "WFE j ≥ 4\nrms (nm)", "LOS rms\n(mas)", "segments\nrms (nm)"
    headers = (*words, *numbers, "Maréchal")
    table = empty_table(headers, words, fixed=True, padding=0, pad_edge=False, caption=caption)
    for one in reduced_populations(store, dataset):
        model = "" if one.segments_model is None else f"\n({number(one.segments_model)})"
        missing = f"\n{one.unfinished} missing" if one.unfinished else ""
        wide = [_with_interval(one.quantile(one.wfe_raw, p)) for p, _ in _PERCENTILES]
        others = [
            "\n".join(number(one.quantile(values, p).value) for p, _ in _PERCENTILES)
            for values in (one.wfe, one.los)
        ]
        table.add_row(
            Text.assemble((one.name, "bold"), f"\n{len(one.wfe)}", (missing, "yellow")),
            "\n".join(label for _, label in _PERCENTILES),
            "\n".join(wide),
            *others,
            number(_rms(one.segments)) + model,
            share(float(one.marechal.mean())) if len(one.marechal) else MISSING,
        )
    return table


def _with_interval(found: Quantile) -> str:
    return number(found.value) if np.isnan(found.value) else f"{number(found.value)} ({interval(found)})"


def _rms(values: Array) -> float:
    return float(case_rms(values[None])[0]) if values.size else np.nan


def page_of(store: Path, dataset: xr.Dataset, words: str = "", more: Sequence[Picture] = ()) -> Page:
    """Return the HTML report: the table, distributions over cases, those of the model's error, and more."""
    near = "log_weight" in dataset.variables
    kept, light, dataset = what_is_kept(dataset), stopped_light(store, dataset), _loaded(dataset)
    found = [one for one in reduced_populations(store, dataset) if len(one.wfe)]
    done = dataset["status"].to_numpy() == DONE
    pictures: list[Picture] = []
    if found:
        for attribute, label in (
            ("wfe_raw", "WFE on glass, rms of a case (nm)"),
            ("los", "LOS, rms of a case about rest (mas)"),
        ):
            values = {one.name: getattr(one, attribute) for one in found}
            sets = {one.name: one.sets for one in found}
            pictures.append(
                picture(
                    attribute.replace("_", "-"),
                    f"Distribution: {label}",
                    distributions(values, label, sets),
                    "The curve gives the share of cases at or below a value: further left is better.",
                )
            )
    parts = parted_variance(store, dataset)
    errors = modal_errors(dataset, done) if "traced" in dataset else {}
    in_nm = {ERRORS[name]: errors[name] for name in errors if name not in ("los", "centroid")}
    if in_nm:
        label = "largest error of the modal model in a case (nm)"
        how = "What the modal model is off by in cases that were traced in full, too: further left is better."
        pictures.append(picture("modal-error", f"Distribution: {label}", distributions(in_nm, label), how))
    return Page(
        answer=" ".join(
            [
                _answer(found, near) + sentence(parts),
                *([words] if words else []),
                *([light] if light else []),
                *certificate(bench_of(read_manifest(store).study).study.optics.modal_tolerance_nm, dataset),
            ]
        ),
        table=[_row(one) for one in found],
        small_print=_SMALL_PRINT + kept,
        overview=[*pictures, *more, *parts_pictures(parts), *budget.pictures(store)],
        sections=[],
        definitions=[
            (term, str(dataset[name].attrs["long_name"]) + ".")
            for term, name in (
                ("WFE on glass", "wfe_rms_raw"),
                ("WFE j ≥ 4", "wfe_rms"),
                ("LOS", "los"),
                ("segments", "segment_piston_rms"),
                ("Maréchal", "marechal"),
            )
        ],
        kind="disturbance",
        left_out=left_out(dataset, most=_LISTED),
    )


def _answer(found: list[ReducedPopulation], near: bool = False) -> str:
    """Say which disturbance costs the most, and what cases drawn `near` a limit do not say."""
    if not found:
        return "No case is done yet."
    worst = max(found, key=lambda one: quantile(one.wfe_raw, 0.95).value)
    lead = f"Of {len(found)} disturbances, {worst.name} costs the most" if len(found) > 1 else worst.name
    cases, level = len(worst.wfe), quantile(worst.wfe_raw, 0.95).value
    share_of = "95 %"
    if cases < FEWEST:  # they have no percentiles
        share_of, level = "all", float(worst.wfe_raw.max())
    which = "its only case has" if cases == 1 else f"{share_of} of its {cases} cases have"
    most = "" if cases == 1 else "at most "
    rare = " They are drawn near the limit: how often it is exceeded says wavequake rare." if near else ""
    return f"{lead}: {which} a wavefront error of {most}{number(level)} nm rms on glass.{rare}"


def _row(one: ReducedPopulation) -> dict[str, tuple[str, str]]:
    """Return header -> (value, small print) of one population."""
    row = {"disturbance": (one.name, ""), "cases": (str(len(one.wfe)), "")}
    for header, values in (
        ("WFE on glass {} (nm)", one.wfe_raw),
        ("WFE j\u00a0≥\u00a04 {} (nm)", one.wfe),
        ("LOS {} (mas)", one.los),
    ):
        for p, label in _PERCENTILES:
            level = one.quantile(values, p)
            row[header.format(label)] = number(level.value), interval(level)
    model = "" if one.segments_model is None else f"model {number(one.segments_model)}"
    row["segments (nm)"] = number(_rms(one.segments)), model
    row["Maréchal"] = share(float(one.marechal.mean())), ""
    return row
