"""Compare stores case by case: cases of equal labels (disturbance, realization, seed...) are paired.

Paired cases saw the same draw, so that the differences between two models, mirrors or settings stand out from
the scatter of the draws.
"""

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import scipy
import xarray as xr
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE
from wavequake.campaign.statistics.blocks import few_at_once
from wavequake.campaign.store.store import open_store
from wavequake.errors import UserError
from wavequake.report.figures import STYLE, one_panel

CONFIDENCE = 0.95
# Coordinates over which measures are averaged, so that two stores must have the same.
_AXES = {"field", "field_x", "field_y", "wavelength", "frequency", "excitation", "controller", "shortcut"}
_NO_LABELS = {"case", "status", "message"}
_IMAGES = {"exposure", "psf"}
_CLOCKS = {"seconds", "reduce_seconds"}  # readings of a clock, which say nothing of the models
_MIXED = {"noll", "segment", "dof", "surface", "term"}  # dims of numbers that no mean may mix


@dataclass(frozen=True)
class Difference:
    """One measure of one group of paired cases in a store, against the first store.

    Attributes
    ----------
    group : str
        Value of the stores' first text label: the disturbance, the variant...
    measure, units : str
    cases : int
    first, second : float
        Means over the cases; NaN for images, of which only the difference is a number.
    differences : ndarray, shape (cases,)
        Second minus first; for images the L2 norm of the difference of unit-energy images.
    each : ndarray, shape (cases,)
        The measure in the first store.
    variants : tuple of str
        Names of reduced models, where these are the cases; else none.
    sets : ndarray of int, shape (cases,), or None
        The stratified set that each case belongs to; None if all are independent.
    """

    group: str
    measure: str
    units: str
    cases: int
    first: float
    second: float
    differences: NDArray[np.float64]
    each: NDArray[np.float64]
    variants: tuple[str, ...] = ()
    sets: NDArray[np.int64] | None = None

    @property
    def relative(self) -> NDArray[np.float64]:
        """Differences of the cases as shares of the first store's values; NaN where those are zero."""
        none = np.full(self.cases, np.nan)
        shares: NDArray[np.float64] = np.divide(
            self.differences, np.abs(self.each), out=none, where=self.each != 0.0
        )
        return shares

    @property
    def mean(self) -> float:
        """Mean difference."""
        return float(self.differences.mean())

    @property
    def margin(self) -> float:
        """Half the 95 % confidence interval of the mean difference (Student); NaN if there is none.

        Independent are the cases, or if they are stratified the sets: of these there must be two.
        """
        excess = self.differences - self.mean
        if self.sets is not None:  # sums over sets: they may differ in size by failed cases
            which = np.unique(self.sets, return_inverse=True)[1]
            excess = np.bincount(which, excess).astype(np.float64)
        if excess.size < 2:
            return float("nan")
        error = excess.std(ddof=1) * np.sqrt(excess.size) / self.cases
        return float(scipy.stats.t.ppf(0.5 + CONFIDENCE / 2, excess.size - 1) * error)


@few_at_once()
def compare(one_set: xr.Dataset, other_set: xr.Dataset, first: str, second: str) -> list[Difference]:
    """Compare the finished cases that two datasets of stores share; `first` and `second` are their names.

    Raises
    ------
    UserError
        If the two share no finished case; says which label differs.
    """
    _require_alike(one_set, other_set, first, second)
    one, two = _by_label(one_set), _by_label(other_set)
    labels = [name for name in one.labels if name in two.labels]
    by_variant = "variant" in labels and "realization" not in labels
    if by_variant:  # one case each: another seed is another draw of its random excitations, no other case
        labels = [name for name in labels if name != "seed"]
    if not labels:
        raise UserError(f"{first} and {second} have no labels in common, so their cases cannot be paired.")
    ours, theirs = (pd.MultiIndex.from_frame(part.frame[labels]) for part in (one, two))
    for index, path in ((ours, first), (theirs, second)):
        if not index.is_unique:
            raise UserError(
                f"several cases of {path} have the same {', '.join(labels)}: they cannot be paired."
            )
    shared = ours.intersection(theirs, sort=False)
    if not len(shared):
        raise UserError(_why_nothing_is_shared(one.frame, two.frame, labels, first, second))
    left = one.dataset.isel(case=ours.get_indexer(shared))
    right = two.dataset.isel(case=theirs.get_indexer(shared))
    kinds = [name for name in labels if not pd.api.types.is_numeric_dtype(one.frame[name])]
    groups = shared.get_level_values(kinds[0]).to_numpy() if kinds else np.full(len(shared), "all")
    variants = shared.get_level_values("variant").to_numpy() if by_variant else None
    sets = shared.get_level_values("replicate").to_numpy() if "replicate" in labels else None
    return list(_differences(left, right, groups, variants, sets))


def _require_alike(one: xr.Dataset, two: xr.Dataset, first: str, second: str) -> None:
    """Refuse stores whose numbers mean different things: other workflows, fields, frequencies..."""
    studies = [json.loads(data.attrs.get("study", "{}")) for data in (one, two)]
    ours, theirs = (study.get("study", {}).get("workflow") for study in studies)
    if ours != theirs:
        raise UserError(f"{first} holds results of {ours}, {second} of {theirs}: they cannot be compared.")
    plans = [study.get("campaign", {"sampling": "random"}) for study in studies]
    if plans[0] != plans[1]:
        words = [", ".join(f"{key} {value}" for key, value in plan.items()) for plan in plans]
        raise UserError(
            f"{first} and {second} have other draws ({words[0]} there, {words[1]} here), so their cases "
            "cannot be paired; take the same sampling, replicates and cases."
        )
    known, others = ({str(name) for name in data.coords} for data in (one, two))
    for name in sorted((_AXES & known & others) | ({"field"} & (known ^ others))):
        mine, yours = (data.get(name, xr.DataArray(["a single one"])) for data in (one, two))
        if not np.array_equal(mine.to_numpy(), yours.to_numpy()):
            raise UserError(
                f"{first} and {second} differ in their {name}: {_shown(mine)} there, {_shown(yours)} here; "
                "compare stores that were computed at the same."
            )


def _shown(values: xr.DataArray) -> str:
    return ", ".join(map(str, values.to_numpy()[:3])) + (", ..." if values.size > 3 else "")


@dataclass(frozen=True)
class _Labelled:
    dataset: xr.Dataset
    frame: pd.DataFrame

    @property
    def labels(self) -> list[str]:
        return list(self.frame.columns)


def _by_label(dataset: xr.Dataset) -> _Labelled:
    done = dataset.isel(case=np.flatnonzero(dataset["status"].to_numpy() == DONE))
    labels = {
        str(name): done[name].to_numpy()
        for name in done.coords
        if done[name].dims == ("case",) and name not in _NO_LABELS
    }
    return _Labelled(done, pd.DataFrame(labels))


def _why_nothing_is_shared(
    one: pd.DataFrame, two: pd.DataFrame, labels: list[str], first: str, second: str
) -> str:
    if one.empty or two.empty:
        return f"{first if one.empty else second} has no finished case to compare."
    for name in labels:
        if not set(one[name]) & set(two[name]):
            return (
                f"{first} and {second} share no case: {name} is {one[name].iloc[0]} there, "
                f"{two[name].iloc[0]} here."
            )
    return f"{first} and {second} share no case: no {', '.join(labels)} agree."


def _differences(
    left: xr.Dataset,
    right: xr.Dataset,
    groups: NDArray[np.object_],
    variants: NDArray[np.object_] | None,
    sets: NDArray[np.int64] | None,
) -> Iterator[Difference]:
    places = {str(group): np.flatnonzero(groups == group) for group in dict.fromkeys(groups)}
    for measure in left.data_vars:
        name = str(measure)
        if name not in right or left[name].dtype.kind != "f" or name in _CLOCKS:
            continue
        dims, others = ({*map(str, data[name].dims)} for data in (left, right))  # other ones of a summary
        if "case" not in dims or _MIXED & dims or (dims ^ others) - {"time", "axis", "statistic"}:
            continue
        if name in _IMAGES:
            if left[name].shape != right[name].shape:
                continue
            one = two = np.full(len(groups), np.nan)
            apart = _image_difference(left[name], right[name])
        else:
            one, two = _reduced(left[name]), _reduced(right[name])
            with np.errstate(invalid="ignore"):  # both infinite, as radii beyond the frame: not counted
                apart = two - one
        units = str(left[name].attrs.get("units", "1"))
        for group, rows in places.items():
            kept = rows[np.isfinite(apart[rows])]
            if len(kept):
                yield Difference(
                    group,
                    name,
                    units,
                    len(kept),
                    float(one[kept].mean()),
                    float(two[kept].mean()),
                    apart[kept],
                    one[kept],
                    () if variants is None else tuple(map(str, variants[kept])),
                    None if sets is None else sets[kept],
                )


def _reduced(values: xr.DataArray) -> NDArray[np.float64]:
    """Return one number per case: the mean Strehl ratio, else the rms over all other dims."""
    if "statistic" in values.dims:  # a summary holds it
        values = values.sel(statistic="mean" if values.name == "strehl" else "rms")
    others = [dim for dim in values.dims if dim != "case"]
    if not others:
        return np.asarray(values.to_numpy())
    if values.name == "strehl":
        return np.asarray(values.mean(others).to_numpy())
    along = [dim for dim in others if dim != "axis"]
    square = (values**2).sum("axis", skipna=False) if "axis" in others else values**2
    return np.asarray(np.sqrt(square.mean(along).to_numpy()))


def _image_difference(one: xr.DataArray, two: xr.DataArray) -> NDArray[np.float64]:
    """Return the L2 norm of the difference of two images of unit energy, per case."""
    over = one.dims[1:]
    # As variables, which have no labels to align, and lazily: a few cases are in memory at a time.
    parts = [images.variable.astype(np.float64) for images in (one, two)]
    first, second = (images / images.sum(over, skipna=False) for images in parts)
    return np.asarray(np.sqrt(((second - first) ** 2).sum(over, skipna=False).to_numpy()))


@rc_context(STYLE)
def comparison_figure(names: Sequence[str], comparisons: Sequence[Sequence[Difference]]) -> Figure:
    """Draw the mean differences, relative to the first store, with their confidence intervals.

    Numbers that no store has otherwise are left out, unless all are alike.
    """
    changed = {_line(one) for part in comparisons for one in part if one.differences.any()}
    shown = [
        (_line(one), *_drawn(one), store)
        for store, differences in enumerate(comparisons)
        for one in differences
        if one.first and np.isfinite(one.first) and (_line(one) in changed or not changed)
    ]
    lines = list(dict.fromkeys(label for label, *_ in shown))
    figure, axes = one_panel(7.0, 1.2 + 0.24 * max(1, len(lines)))
    axes.axvline(0.0, color="#444444", linewidth=0.7)
    for store, name in enumerate(names[1:]):
        mine = [entry for entry in shown if entry[3] == store]
        height = [lines.index(label) + 0.18 * (store - (len(comparisons) - 1) / 2) for label, *_ in mine]
        for one in comparisons[store]:
            row = lines.index(_line(one)) if one.variants and _line(one) in lines else None
            if row is not None:
                axes.plot(100 * one.relative, np.full(one.cases, row), "|", color="#888888", markersize=6)
        margin = [0.0 if np.isnan(error) else error for _, _, error, _ in mine]
        axes.errorbar(
            [value for _, value, *_ in mine], height, xerr=margin, fmt="o", markersize=4, label=name
        )
    axes.set_yticks(range(len(lines)), lines)
    axes.invert_yaxis()
    words = "median and each variant" if any(c.variants for part in comparisons for c in part) else None
    axes.set_xlabel(f"difference from {names[0]} (%), {words or '95 % confidence'}")
    axes.set_title(f"{names[1] if len(names) == 2 else 'Stores'} compared with {names[0]}")
    axes.legend(loc="best")
    return figure


def _line(one: Difference) -> str:
    return f"{one.measure}  {one.group}"


def _drawn(one: Difference) -> tuple[float, float]:
    """Return what is drawn of a measure and its margin, in percent: the median of variants, else the mean."""
    if one.variants:
        known = one.relative[np.isfinite(one.relative)]
        return 100 * float(np.median(known)) if len(known) else 0.0, float("nan")
    return 100 * one.mean / one.first, 100 * one.margin / abs(one.first)


def compare_stores(
    stores: Sequence[str | Path], figure: Path | None = None
) -> tuple[list[str], list[list[Difference]]]:
    """Compare stores with the first one; return their names, and the differences of each other one.

    They are drawn into `figure`, if one is given. Raises as `compare`.
    """
    if len(stores) < 2:
        raise UserError("compare needs at least two stores.")
    names = [Path(store).name or str(store) for store in stores]
    if len(set(names)) < len(names):
        names = [str(store) for store in stores]
    if figure and figure.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise UserError(f"The figure {figure} must end in .png, .svg or .pdf.")
    first, *others = [open_store(store) for store in stores]
    comparisons = [compare(first, one, names[0], name) for one, name in zip(others, names[1:], strict=True)]
    try:
        if figure:
            comparison_figure(names, comparisons).savefig(figure, dpi=150)
    except OSError as error:
        reason = os.strerror(error.errno or 0).lower()
        raise UserError(f"{figure} cannot be written ({reason}); choose another with --figure.") from None
    return names, comparisons
