"""The report of any store, from what its measures say: levels, distributions, histories, images.

Cases are told apart by the labels that their kind compares (disturbance, controller, ...). Every measure is
one number per case in the table: of its instants as the measure says, of an axis (x, y) the length.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from wavequake.campaign.contract import DONE
from wavequake.campaign.store.store import read_manifest
from wavequake.report.answers import budget
from wavequake.report.figures import COLORS, LINES, STYLE, distributions, one_panel
from wavequake.report.page import Page, Picture, Section, picture
from wavequake.report.populations import left_out
from wavequake.report.statistics import quantile
from wavequake.report.table import empty_table, interval, number
from wavequake.words import counted
from wavequake.workflows import kinds
from wavequake.workflows.kinds import find_kind

Array = NDArray[np.float64]

_PERCENTILES = ((0.5, "P50"), (0.95, "P95"))
_ENTRIES = 6  # rows of a measure over fields, modes, ...; the store has all
_IMAGE = ("y", "x")
_REDUCED = {
    "rms": lambda one: (one**2).mean("time") ** 0.5,
    "mean": lambda one: one.mean("time"),
    "max": lambda one: one.max("time"),
    "last": lambda one: one.ffill("time").isel(time=-1),
}


OVER_TIME = (
    "Over time each measure is one number per case (rms unless it says otherwise), along x and y the length."
)
SMALL_PRINT = (
    f"{OVER_TIME} P50 and P95 over cases with their 95 % confidence interval (≤, ≥: too few cases for both "
    "bounds)."
)


@dataclass(frozen=True)
class Row:
    """One measure at one place of its further dimensions: a number per case (case,)."""

    name: str
    label: str
    units: str
    values: Array

    @property
    def title(self) -> str:
        """Name, place and unit."""
        return " ".join(p for p in (self.name, self.label, f"({self.units})" if self.units else "") if p)


def compared_labels(store: Path, dataset: xr.Dataset) -> list[str]:
    """Return the labels that the store's cases are told apart by."""
    return [one for one in kinds.compared_labels(read_manifest(store).study) if one in dataset.coords]


def groups_of(store: Path, dataset: xr.Dataset) -> dict[str, NDArray[np.bool_]]:
    """Return which finished cases belong to each combination of compared labels, in order of appearance."""
    compared = compared_labels(store, dataset)
    done = dataset["status"].to_numpy() == DONE
    if not compared:
        return {"all cases": done}
    # A name says what it is; a number, or one of several labels, does so with that of its label.
    said = [len(compared) > 1 or dataset[one].dtype.kind in "fiub" for one in compared]
    labels = np.array(
        [
            " / ".join(
                f"{label} {short(value)}" if named else short(value)
                for label, value, named in zip(compared, row, said, strict=True)
            )
            for row in zip(*(dataset[c].to_numpy() for c in compared), strict=True)
        ]
    )
    return {str(name): (labels == name) & done for name in dict.fromkeys(labels.tolist())}


def short(value: object) -> str:
    """Return a label in few characters."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def _numbers(dataset: xr.Dataset) -> Iterator[xr.DataArray]:
    """Yield what the table shows: numbers of cases that label nothing and are no images."""
    for name in dataset.data_vars:
        one = dataset[name]
        if one.dims[:1] != ("case",) or name == "status" or one.dtype.kind not in "fiu":
            continue
        if not set(_IMAGE) <= set(one.dims):
            yield one


def rows(dataset: xr.Dataset) -> list[Row]:
    """Return a row per measure, and per entry of its further dimensions (the first ones of many)."""
    found = []
    for one in _numbers(dataset):
        reduced = one.astype(np.float64)
        if "time" in one.dims:
            reduced = _REDUCED[str(one.attrs.get("over_time", "rms"))](reduced)
        if "statistic" in one.dims:
            reduced = reduced.sel(statistic="rms", drop=True)
        if "axis" in one.dims:
            reduced = (reduced**2).sum("axis", skipna=False) ** 0.5
        units = (
            str(one.attrs.get("units", "1")).replace("1", "", 1)
            if one.attrs.get("units") == "1"
            else str(one.attrs.get("units", ""))
        )
        rest = reduced.dims[1:]
        table = reduced.stack(entry=rest) if rest else reduced.expand_dims("entry", axis=1)
        for index in range(min(table.sizes["entry"], _ENTRIES)):
            labels = (
                ""
                if not rest
                else ", ".join(
                    f"{dim} {_label(dataset, str(dim), int(place))}"
                    for dim, place in zip(
                        rest, np.unravel_index(index, [reduced.sizes[d] for d in rest]), strict=True
                    )
                )
            )
            values = table.isel(entry=index).to_numpy()
            found.append(Row(str(one.name), labels, units, values))
    return found


def _label(dataset: xr.Dataset, dim: str, place: int) -> str:
    if dim not in dataset.coords:
        return str(place)
    value = dataset[dim].to_numpy()[place]
    return f"{value:g}" if isinstance(value, float) else str(value)


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    groups = groups_of(store, dataset)
    words = "cases", "measure"
    headers = (*words, *(label for _, label in _PERCENTILES))
    table = empty_table(headers, words, padding=(0, 1, 0, 0), pad_edge=False, caption=SMALL_PRINT)
    found = rows(dataset)
    for group, mine in groups.items():
        head: str | Text = Text.assemble((group, "bold"), f"\n{int(mine.sum())}")
        for row in found:
            levels = [quantile(_finite(row.values[mine]), p) for p, _ in _PERCENTILES]
            table.add_row(
                head,
                row.title,
                *(
                    f"{number(one.value)}" + ("" if np.isnan(one.value) else f" ({interval(one)})")
                    for one in levels
                ),
            )
            head = ""
    return table


def _finite(values: Array) -> Array:
    return values[~np.isnan(values)]


def page_of(
    store: Path,
    dataset: xr.Dataset,
    device: str,
    found: list[Row] | None = None,
    first: Sequence[Picture] = (),
    answer: str = "",
) -> Page:
    """Return the HTML report: table, distributions, histories, images, and the pictures of the study kind.

    The rows `found` are shown instead of all, the pictures `first` instead of their distributions, and the
    `answer` is more than that cases are done.
    """
    groups = {name: mine for name, mine in groups_of(store, dataset).items() if mine.any()}
    found = rows(dataset) if found is None else found
    kind = find_kind(read_manifest(store).workflow)
    own = [
        picture(f"own-{index}", one.title, one.figure, one.caption)
        for index, one in enumerate(kind.pictures(read_manifest(store).study, dataset))
    ]
    sections = [
        Section(name, figures)
        for name, figures in (
            ("Distributions over cases", [] if first else [*_distributions(found, groups)]),
            ("Over time", [*_histories(dataset, groups)]),
            ("Images", [*_images(dataset, groups)]),
        )
        if figures
    ]
    cases = int(sum(mine.sum() for mine in groups.values()))
    return Page(
        answer=(answer or f"{counted(cases, 'case')} of {kind.name} are done.")
        if cases
        else "No case is done yet.",
        table=[_page_row(group, mine, found) for group, mine in groups.items()],
        small_print=SMALL_PRINT,
        overview=[*first, *own, *budget.pictures(store)],
        sections=sections,
        definitions=[(str(one.name), str(one.attrs.get("long_name", "")) + ".") for one in _numbers(dataset)],
        kind=" / ".join(compared_labels(store, dataset)),
        left_out=left_out(dataset, compared_labels(store, dataset), most=1000),
    )


def _page_row(group: str, mine: NDArray[np.bool_], found: list[Row]) -> dict[str, tuple[str, str]]:
    row = {"cases of": (group, counted(int(mine.sum()), "case"))}
    for one in found:
        for p, label in _PERCENTILES:
            level = quantile(_finite(one.values[mine]), p)
            head = " ".join(part for part in (one.name, one.label, label) if part)
            unit = f" ({one.units})" if one.units else ""
            row[head + unit] = number(level.value), "" if np.isnan(level.value) else interval(level)
    return row


def _distributions(found: list[Row], groups: dict[str, NDArray[np.bool_]]) -> Iterator[Picture]:
    for index, one in enumerate(found):
        values = {name: _finite(one.values[mine]) for name, mine in groups.items()}
        values = {name: numbers[np.isfinite(numbers)] for name, numbers in values.items()}
        values = {name: numbers for name, numbers in values.items() if len(numbers) > 1}
        label = one.title
        if values and any(np.ptp(numbers) > 0.0 for numbers in values.values()):
            yield picture(
                f"distribution-{index}",
                f"Share of cases with at most so much {label}",
                distributions(values, label),
                "The curve gives the share of cases at or below a value.",
            )


def _histories(dataset: xr.Dataset, groups: dict[str, NDArray[np.bool_]]) -> Iterator[Picture]:
    for one in _numbers(dataset):
        if "time" not in one.dims or "time_s" not in dataset.variables or not groups:
            continue
        values = one.astype(np.float64)
        if "axis" in values.dims:
            values = (values**2).sum("axis", skipna=False) ** 0.5
        rest = [dim for dim in values.dims if dim not in ("case", "time")]
        if rest:
            values = values.isel(dict.fromkeys(rest, 0))
        units = str(one.attrs.get("units", ""))
        yield picture(
            f"history-{one.name}",
            f"{one.name} over time",
            _history(dataset["time_s"].to_numpy(), values.to_numpy(), groups, f"{one.name} ({units})"),
            "The median of the cases, and the band that holds 90 % of them.",
        )


@rc_context(STYLE)
def _history(time_s: Array, values: Array, groups: dict[str, NDArray[np.bool_]], label: str) -> Figure:
    figure, axes = one_panel()
    for index, (name, mine) in enumerate(groups.items()):
        there = np.isfinite(values[mine]).any(axis=0)
        if not there.any():
            continue
        times = time_s[mine][:, there] if time_s.ndim > 1 else time_s[there][None]
        low, middle, high = np.nanquantile(values[mine][:, there], [0.05, 0.5, 0.95], axis=0)
        color = COLORS[index % len(COLORS)]
        axes.fill_between(times[0], low, high, color=color, alpha=0.15, linewidth=0)
        axes.plot(times[0], middle, color=color, linestyle=LINES[index % len(LINES)], label=name)
    axes.set(xlabel="time (s)", ylabel=label, title=label)
    axes.legend()
    return figure


def _images(dataset: xr.Dataset, groups: dict[str, NDArray[np.bool_]]) -> Iterator[Picture]:
    for name in dataset.data_vars:
        one = dataset[name]
        if one.dims[:1] != ("case",) or not set(_IMAGE) <= set(one.dims):
            continue
        for group, mine in groups.items():
            if not mine.any():  # none of its cases is done
                continue
            case = int(np.flatnonzero(mine)[0])
            rest = [dim for dim in one.dims if dim not in ("case", *_IMAGE)]
            image = one.isel({"case": case, **dict.fromkeys(rest, 0)}).transpose(*_IMAGE)
            yield picture(
                f"image-{name}-{len(group)}-{case}", f"{name} of case {case}, {group}", _image(image)
            )


@rc_context(STYLE)
def _image(image: xr.DataArray) -> Figure:
    figure, axes = one_panel()
    x, y = (
        image[dim].to_numpy() if dim in image.coords else np.arange(image.sizes[dim]) for dim in ("x", "y")
    )
    drawn = axes.pcolormesh(x, y, image.to_numpy(), cmap="magma", rasterized=True)
    units = str(image["x"].attrs.get("units", "pixels")) if "x" in image.coords else "pixels"
    axes.set(xlabel=f"x ({units})", ylabel=f"y ({units})", aspect="equal", title=str(image.name))
    figure.colorbar(drawn, ax=axes, label=str(image.attrs.get("units", "")))
    return figure
