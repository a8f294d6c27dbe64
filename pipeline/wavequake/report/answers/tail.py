"""Rare events in a store: what is hardly ever exceeded, and how often a limit is."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from wavequake.campaign.contract import DONE
from wavequake.campaign.statistics.judged import Judged, judgeable, judged_in, populations_of, selected, title
from wavequake.campaign.statistics.quantiles import Quantile
from wavequake.campaign.statistics.tail import Tail, exceedance, fit_tail, fits, rare_value, steadiness
from wavequake.campaign.store.store import open_store
from wavequake.errors import UserError
from wavequake.report.table import MISSING, empty_table, number
from wavequake.workflows.kinds import compared_labels

Array = NDArray[np.float64]

_USUAL = "wfe_rms_raw"  # judged where a store has it and nothing is named
_OVER_TIME = {"mean": "mean", "rms": "rms", "min": "min", "max": "max", "last": "last"}


@dataclass(frozen=True)
class RareEvents:
    """What is known of the tail of one population.

    ``value`` is exceeded with `probability`; ``odds`` is how often `limit` is (None: no limit was given);
    ``steady`` is ``value`` by the upper half of the exceedances.
    """

    name: str
    tail: Tail
    value: Quantile
    steady: Quantile | None
    odds: Quantile | None


@dataclass(frozen=True)
class RareQuestion:
    """What is asked of a store: of the upper tail, or of the lower one if `below`.

    Without a `variable` it is the wavefront error on the glass.
    """

    variable: str | None
    statistic: str
    probability: float
    limit: float | None = None
    threshold: float | None = None
    below: bool = False


@dataclass(frozen=True)
class RareAnswer:
    """The variable judged, the tails of populations, in sentences why others have none, and the unit."""

    variable: str
    found: tuple[RareEvents, ...]
    reasons: tuple[str, ...]
    unit: str


def rare_events(store: Path | str, question: RareQuestion) -> RareAnswer:
    """Return the tails of all populations of a store, at each label that was not chosen.

    Raises
    ------
    UserError
        If there is no such variable, label or statistic, none is named and there is not the usual one, or no
        population has a tail, as of too few cases.
    """
    if not 0.0 < question.probability < 0.5:
        raise UserError(
            f"The probability {question.probability:g} is not rare; it must be between 0 and 0.5, as 1e-4."
        )
    for name in ("limit", "threshold"):
        value = getattr(question, name)
        if value is not None and not np.isfinite(value):
            raise UserError(f"The {name} {value} is no number that a tail can be compared with.")
    dataset = open_store(store)
    if "log_weight" in dataset.variables:
        raise UserError(
            f"The cases of {store} are drawn near a limit and have no tail of their own; take wavequake rare."
        )
    variable = question.variable or _USUAL
    if not question.variable and _USUAL not in dataset:
        raise UserError(
            f"{store} holds no wavefront error on the glass, which is judged where nothing is named; name "
            f"one of {', '.join(judgeable(dataset))} (--variable NAME)."
        )
    judged = judged_in(variable, dataset)
    compared = compared_labels(dataset.attrs["study"]) if "study" in dataset.attrs else ()
    names = populations_of(dataset, compared)
    done = dataset["status"].to_numpy() == DONE
    numbers = per_case(dataset, judged, question.statistic, question.below)
    stratified = "replicate" in dataset.variables
    sign = -1.0 if question.below else 1.0
    found, reasons = list[RareEvents](), list[str]()
    for name in dict.fromkeys(names.tolist()):
        for label, values in numbers.items():
            mine = sign * values[(names == name) & done]
            try:
                found.append(_one(title(name, label), mine, question, sign, stratified))
            except UserError as error:
                reasons.append(str(error))
    if not found:
        raise UserError(reasons[0])
    unit = str(dataset[judged.variable].attrs.get("units", "1"))
    return RareAnswer(variable, tuple(found), tuple(reasons), unit)


def _one(name: str, values: Array, question: RareQuestion, sign: float, stratified: bool) -> RareEvents:
    threshold = None if question.threshold is None else sign * question.threshold
    try:
        tail = fit_tail(values, threshold)
    except UserError as error:
        mirrored = " (Small values are judged as those times -1.)" if question.below else ""
        raise UserError(f"{name}: {error}{mirrored}") from None
    odds = None if question.limit is None else exceedance(tail, sign * question.limit)
    value, steady = rare_value(tail, question.probability), steadiness(tail, question.probability)
    if stratified:  # the likelihood of cases that are not independent is not known
        value, odds = Quantile(value.value, np.nan, np.nan), odds and Quantile(odds.value, np.nan, np.nan)
    return RareEvents(name, tail, value, steady, odds)


def per_case(dataset: xr.Dataset, judged: Judged, statistic: str, below: bool = False) -> dict[str, Array]:
    """Return a number per case, by label: a statistic over instants, the worst of fields and wavelengths.

    The worst is the largest, or the smallest where small values are judged (`below`). Of a line of sight it
    is the distance from rest. Raises as :func:`rare_events`.
    """
    if statistic not in _OVER_TIME:
        raise UserError(f"There is no statistic {statistic!r}; use one of {', '.join(_OVER_TIME)}.")
    variable, numbers = dataset[judged.variable], defaultdict[str, list[Array]](list)
    if "statistic" in variable.dims:
        variable = variable.sel(statistic=statistic)
    for _, found in selected(judged, variable):
        for label, values in found.items():
            numbers[label].append(_number(values, statistic, below))
    return {label: np.concatenate(parts) for label, parts in numbers.items()}


def _number(values: xr.DataArray, statistic: str, below: bool) -> Array:
    if "time" in values.dims:
        values = _over_time(values, statistic)
    others = [dim for dim in values.dims if dim != "case"]
    if others:
        values = values.min(others) if below else values.max(others)
    return np.asarray(values.to_numpy(), dtype=np.float64)


def _over_time(values: xr.DataArray, statistic: str) -> xr.DataArray:
    """Reduce instants; those that a case does not have are NaN at the end."""
    if statistic == "rms":
        return (values**2).mean("time") ** 0.5
    if statistic == "last":
        instant = xr.DataArray(np.arange(values.sizes["time"]), dims="time")
        return values.where(instant == instant.where(values.notnull()).max("time")).max("time")
    reduced: xr.DataArray = getattr(values, statistic)("time")
    return reduced


def rare_table(answer: RareAnswer, question: RareQuestion) -> Table:
    """Return the tails as a table for the terminal."""
    unit = answer.unit
    side = "below" if question.below else "above"
    sign = -1.0 if question.below else 1.0
    headers = ("disturbance", "cases", f"threshold\n({unit})", f"cases\n{side} it", "shape")
    table = empty_table(headers, pad_edge=False)
    wanted = Text(f"{answer.variable} ({unit}),\n{side} it: {question.probability:g}")
    table.add_column(wanted, justify="right", no_wrap=True)
    if question.limit is not None:
        table.add_column(f"share {side}\n{question.limit:g} {unit}", justify="right", no_wrap=True)
    for one in answer.found:
        cells = [
            str(len(one.tail.values)),
            number(sign * one.tail.threshold),
            str(len(one.tail.excesses)),
            f"{one.tail.shape:.2f}",
            _interval(one.value, sign),
        ]
        table.add_row(Text(one.name), *cells, *([_interval(one.odds)] if one.odds else []))
    return table


def _interval(found: Quantile, sign: float = 1.0) -> str:
    low, high = (found.low, found.high) if sign > 0 else (found.high, found.low)
    if np.isnan(low):
        return number(sign * found.value)
    ends = [number(sign * end) if np.isfinite(end) else MISSING for end in (low, high)]
    return f"{number(sign * found.value)} ({ends[0]}–{ends[1]})"


def rare_notes(answer: RareAnswer, question: RareQuestion) -> Iterator[str]:
    """Yield what the numbers mean and where they are not to be trusted, in lines."""
    over = f"the {question.statistic} over the instants of a case"
    yield (
        f"Of cases ({over}): a generalized Pareto distribution fitted to what is beyond the threshold; in "
        "brackets 95 % confidence intervals of the profile likelihood. It holds as far as the tail goes on "
        "as it is."
    )
    if any(question.probability * len(one.tail.values) < 1.0 for one in answer.found):
        yield (
            "So rare a value is beyond all cases, where normal tails lie somewhat above the law; where a "
            "disturbance draws Gaussian numbers, wavequake rare gives the probability with proof."
        )
    yield from (f"Not judged: {reason}" for reason in answer.reasons)
    for one in answer.found:
        if np.isnan(one.value.low):
            yield f"{one.name}: no interval, as its cases are stratified or share models."
        elif not fits(one.tail):
            yield (
                f"WARNING {one.name}: cases beyond the threshold do not follow the law (Anderson-Darling, "
                "2.5 %); give a farther --threshold."
            )
        elif one.steady and not one.value.low <= one.steady.value <= one.value.high:
            sign = -1.0 if question.below else 1.0
            yield (
                f"WARNING {one.name}: the farther half of these cases alone gives "
                f"{_interval(one.steady, sign)}: the tail changes its kind; give a farther --threshold."
            )
