"""The report of a sweep: every number over the values of every key, and what plain reports show."""

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from wavequake.campaign.contract import DONE
from wavequake.campaign.schema import study_from_identity
from wavequake.campaign.store.store import read_manifest
from wavequake.report import plain
from wavequake.report.figures import COLORS, LINES, STYLE, one_panel
from wavequake.report.mirrors import swept as variants
from wavequake.report.page import Page, Picture, picture
from wavequake.report.table import empty_table, number
from wavequake.words import counted
from wavequake.workflows.sweep import SweepStudy, label_names, template

_MOST_LINES, _MOST_ENTRIES, _MOST_COLUMNS, _MOST_PICTURES = 8, 4, 6, 12
# Kinds whose cases are variants of one model, over which no median means anything.
_OF_VARIANTS = ("mirror-mor", "segment-mor")
_SET = ("segment_piston_rms",)  # what a study moves, not what comes of it
_NAMELESS = ("realization", "seed", "replicate")
_HOW = (
    "Points are medians over the cases of a value; where there are more than eight kinds of cases, the line "
    "is the median of all and the band holds 90 % of them."
)


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table for the terminal: the medians of the first numbers that change, a row per point."""
    study = study_from_identity(SweepStudy, read_manifest(store).study)
    if study.base["study"]["workflow"] in _OF_VARIANTS:
        return variants.table_of(store, dataset)
    shown = rows(store, dataset)[:_MOST_COLUMNS]
    table = empty_table(
        (" / ".join(plain.compared_labels(store, dataset)), "cases", *(row.title for row in shown)),
        padding=(0, 1, 0, 0),
        pad_edge=False,
        caption=f"Medians over the cases of a point. {plain.OVER_TIME}",
    )
    for group, mine in plain.groups_of(store, dataset).items():
        known = [row.values[mine & np.isfinite(row.values)] for row in shown]
        medians = [number(float(np.median(one))) if len(one) else "–" for one in known]
        table.add_row(group, str(int(mine.sum())), *medians)
    return table


def page_of(store: Path, dataset: xr.Dataset, device: str) -> Page:
    """Return the HTML report."""
    study = study_from_identity(SweepStudy, read_manifest(store).study)
    if study.base["study"]["workflow"] in _OF_VARIANTS:
        return variants.page_of(store, dataset, device)
    names, found = label_names(study), rows(store, dataset)
    swept = [
        name
        for name, one in zip(names, study.sweep, strict=True)
        if len(one.values) > 1 and not isinstance(one.values[0], str | bool | tuple)
    ]
    each = (over_values(dataset, found, name, names) for name in swept)
    pictures = [picture for one in each for picture in islice(one, _MOST_PICTURES)]
    answer = " ".join(_words(dataset, found, name, names) for name in swept)
    return plain.page_of(store, dataset, device, found, pictures, answer)


def rows(store: Path, dataset: xr.Dataset) -> list[plain.Row]:
    """Return the numbers that differ between cases, without those of long lists and of stopwatches."""
    per_case = template(read_manifest(store).study).per_case
    every = plain.rows(dataset)
    entries = Counter(row.name for row in every)
    done = dataset["status"].to_numpy() == DONE
    return [
        row
        for row in every
        if entries[row.name] <= _MOST_ENTRIES
        and not (row.name in per_case and per_case[row.name].measured)
        and np.isfinite(row.values[done]).any()
        and np.nanmax(row.values[done]) - np.nanmin(row.values[done]) > 0.0
    ]


def _words(dataset: xr.Dataset, found: list[plain.Row], name: str, swept: Sequence[str]) -> str:
    """Say what number of which cases changes most with a key, and how the first; where all cases are done."""
    values, status = dataset[name].to_numpy().astype(np.float64), dataset["status"].to_numpy()
    kinds = _kinds(dataset, name, swept)
    results = [row for row in found if row.name not in _SET]
    changes = list[tuple[float, str, str]]()  # how much, what, from which median to which
    for kind, mine in kinds.items():
        whole = [one for one in np.unique(values) if (status[mine & (values == one)] == DONE).all()]
        for row in results:
            medians = np.array([np.median(row.values[mine & (values == one)]) for one in whole])
            if len(whole) < 2 or not (medians > 0.0).all() or not medians.max() > medians.min():
                continue
            low, high = medians.argmin(), medians.argmax()
            of, unit = f" of {kind}" if len(kinds) > 1 else "", f" {row.units}" if row.units else ""
            span = (
                f"{number(medians[low])}{unit} at {whole[low]:g} and {number(medians[high])}{unit} at "
                f"{whole[high]:g}"
            )
            changes.append((medians.max() / medians.min(), f"{row.name}{of}", span))
    words = f"Nothing changes with {name}."
    if changes:
        _, most, span = max(changes)
        words = f"With {name}, {most} changes most: its median is {span}"
        first = [one for one in changes if one[1].split(" of ")[0] == results[0].name]
        if first and (leading := max(first))[1] != most:
            words += f"; that of {leading[1]} is {leading[2]}"
        words += "."
    if failed := int(np.count_nonzero(status > DONE)):
        words += f" {counted(failed, 'case')} failed; values at which some did are left out of this."
    return words


def over_values(
    dataset: xr.Dataset, found: list[plain.Row], name: str, swept: Sequence[str]
) -> Iterator[Picture]:
    """Yield a picture of every number that changes with one key."""
    values, done = dataset[name].to_numpy().astype(np.float64), dataset["status"].to_numpy() == DONE
    lines = _lines(dataset, name, swept)
    for index, row in enumerate(found):
        known = np.isfinite(row.values) & done
        curves = {}
        for kind, mine in lines.items():
            places = np.unique(values[mine & known])
            levels = [
                np.quantile(row.values[mine & known & (values == x)], [0.05, 0.5, 0.95]) for x in places
            ]
            if levels:
                curves[kind] = np.column_stack([places, levels])
        if any(np.ptp(curve[:, 2]) > 0.0 for curve in curves.values()):
            figure = _over(curves, name, row.title)
            yield picture(f"sweep-{name}-{index}", f"{row.title} over {name}", figure, _HOW)


def _lines(dataset: xr.Dataset, name: str, swept: Sequence[str]) -> dict[str, NDArray[np.bool_]]:
    """Return which cases make a line, by their other labels; one line if there are too many."""
    kinds = _kinds(dataset, name, swept)
    return kinds if len(kinds) <= _MOST_LINES else {"all cases": np.ones(dataset.sizes["case"], dtype=bool)}


def _kinds(dataset: xr.Dataset, name: str, swept: Sequence[str]) -> dict[str, NDArray[np.bool_]]:
    """Return which cases have the same labels but for one key."""
    others = [
        one
        for one in dataset.coords
        if dataset[one].dims == ("case",)
        and one not in (*swept, *_NAMELESS)
        and dataset[one].dtype.kind not in "biuf"
    ]
    words = [""] * dataset.sizes["case"]
    for one in [*others, *(one for one in swept if one != name)]:
        labels = map(plain.short, dataset[one].to_numpy().tolist())
        longer = [" / ".join(filter(None, pair)) for pair in zip(words, labels, strict=True)]
        if len(set(longer)) > len(set(words)):  # it tells cases apart that the others do not
            words = longer
    return {kind: np.array(words) == kind for kind in dict.fromkeys(words)}


@rc_context(STYLE)
def _over(curves: dict[str, NDArray[np.float64]], name: str, label: str) -> Figure:
    """Draw curves of value, 5 % quantile, median and 95 % quantile."""
    figure, axes = one_panel()
    for index, (kind, curve) in enumerate(curves.items()):
        places, low, middle, high = curve.T
        color, line = COLORS[index % len(COLORS)], LINES[index % len(LINES)]
        axes.plot(places, middle, color=color, linestyle=line, marker="o", label=kind or None)
        if (high > low).any():
            axes.fill_between(places, low, high, color=color, alpha=0.15, linewidth=0)
    medians = np.concatenate([curve[:, 2] for curve in curves.values()])
    if (medians > 0.0).all() and medians.max() > 30.0 * medians.min():
        axes.set_yscale("log")
    axes.set(xlabel=name, ylabel=label, title=f"{label} over {name}")
    if curves.keys() != {""}:
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure
