"""The report of a sweep over mirror models: which reduced model is good enough at every point."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.table import Table

from wavequake.campaign.schema import study_from_identity
from wavequake.campaign.store.store import read_manifest
from wavequake.drawing.ticks import label_powers
from wavequake.report.figures import STYLE, WIDTH, curve_style, one_panel
from wavequake.report.mirrors.report import results_of, worded
from wavequake.report.mirrors.variants import (
    MEASURES,
    Criterion,
    ModelResult,
    VariantResult,
    few,
    largest,
)
from wavequake.report.page import Page, Picture, picture
from wavequake.report.plain import short
from wavequake.report.populations import left_out
from wavequake.report.table import number, table_of_rows
from wavequake.words import counted
from wavequake.workflows.sweep import SweepStudy, Value, label_names, point_study, points_of

_MOST_LINES = 8
_DEFINITIONS = [
    (
        "good enough",
        "The largest error over time and over the excitations that decide, against the reference of the same "
        "point, is at most the criterion of the study.",
    ),
    ("f max", "Largest eigenfrequency of the reduced model: an integrator's step would have to follow it."),
    ("reference", "The rich intermediate model of each point, from which its variants are made."),
]


@dataclass(frozen=True)
class Point:
    """One model at one point of a sweep.

    Attributes
    ----------
    values : mapping
        Label -> value of each swept key.
    model : ModelResult
    criterion : Criterion
    wfe : float
        Largest rms wavefront error of the reference over time and the excitations that decide, nm.
    """

    values: Mapping[str, Value]
    model: ModelResult
    criterion: Criterion
    wfe: float

    def place(self, without: str = "") -> str:
        """Return the values in words, but for one."""
        return ", ".join(f"{name} {short(value)}" for name, value in self.values.items() if name != without)


def points_done(store: Path, dataset: xr.Dataset) -> list[Point]:
    """Return every model at every point of a sweep's store, in its order."""
    study = study_from_identity(SweepStudy, read_manifest(store).study)
    names, cases, found = label_names(study), dataset["case"].to_numpy(), []
    for index, values in enumerate(points_of(study)):
        mine = dataset.isel(case=np.flatnonzero(cases // study.each == index))
        if not mine.sizes["case"]:
            continue
        text = point_study(study.base, values).identity_text()
        models, criterion = results_of(mine.assign_attrs(study=text))
        row_of = {int(case): row for row, case in enumerate(mine["case"].to_numpy())}
        for model in models:
            wfe = np.nan
            if model.reference is not None:
                over_time = mine["wfe_rms"].isel(case=row_of[model.reference.case]).to_numpy().max(axis=-1)
                wfe = float(over_time[list(criterion.excitations)].max())
            found.append(Point(dict(zip(names, values.values(), strict=True)), model, criterion, wfe))
    return found


def answer(points: Sequence[Point]) -> str:
    """Say which variant is good enough at all points, and which is the smallest at single ones."""
    words = []
    for name in dict.fromkeys(one.model.name for one in points):
        mine = [one for one in points if one.model.name == name]
        judged = [one for one in mine if one.model.variants]
        if not judged:
            words.append(f"{name}: no variant is done beside a reference, so nothing can be said yet.")
            continue
        criterion = judged[0].criterion
        what = f"the {MEASURES[criterion.measure]} below {worded(criterion.bound, criterion)}"
        if len({one.criterion for one in judged}) > 1:
            what = "its error below the limit"
        everywhere = _enough_everywhere(judged)
        if everywhere is not None:
            words.append(
                f"{name}: {everywhere.variant} ({everywhere.order} coordinates) is the smallest variant that "
                f"keeps {what} at {_all(judged)}."
            )
        elif any(one.model.enough for one in judged):
            words.append(f"{name}: no variant keeps {what} at {_all(judged)}.")
        else:
            words.append(f"{name}: no variant keeps {what} at any point; {_nearest(judged)}.")
        known = [one for one in judged if one.model.enough is not None]
        orders = {one.model.enough.order for one in known if one.model.enough is not None}
        if len(orders) > 1:
            least, most = (by(known, key=_order) for by in (min, max))
            words.append(f"At single points from {_named(least)} to {_named(most)} are enough.")
        if known and len(known) < len(judged):
            bad = next(one for one in judged if one.model.enough is None)
            words.append(f"None does at {counted(len(judged) - len(known), 'point')}, first {bad.place()}.")
        if len(judged) < len(mine):
            words.append(f"{counted(len(mine) - len(judged), 'point')} not done are left out.")
    return " ".join(words)


def _enough_everywhere(points: Sequence[Point]) -> VariantResult | None:
    """Return the smallest variant that is good enough at all points: the record of the first point."""
    good = [
        {one.variant for one in at.model.variants if largest(one, at.criterion) <= at.criterion.bound}
        for at in points
    ]
    shared = set.intersection(*good)
    return next((one for one in points[0].model.variants if one.variant in shared), None)


def _all(points: Sequence[Point]) -> str:
    if len(points) > 1:
        return f"all {len(points)} points"
    return f"the one point that is done, {points[0].place()}"


def _nearest(points: Sequence[Point]) -> str:
    error, name, place = min(
        (largest(one, at.criterion), one.variant, at.place()) for at in points for one in at.model.variants
    )
    return f"the least is {worded(error, points[0].criterion)} ({name} at {place})"


def _order(point: Point) -> float:
    return point.model.enough.order if point.model.enough else np.nan


def _named(point: Point) -> str:
    assert point.model.enough is not None
    return f"{point.model.enough.order} ({point.model.enough.variant} at {point.place()})"


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table for the terminal: a row per model and point."""
    points = points_done(store, dataset)
    return table_of_rows([_row(point) for point in points], answer(points))


def _row(point: Point) -> dict[str, tuple[str, str]]:
    """Return header -> (value, small print) of one model at one point."""
    enough = point.model.enough
    found = enough.variant if enough else "none" if point.model.variants else "not done"
    error = worded(largest(enough, point.criterion), point.criterion) if enough else "–"
    return {
        "model": (point.model.name, ""),
        **{name: (short(value), "") for name, value in point.values.items()},
        "smallest good enough": (found, ""),
        "order": (str(enough.order) if enough else "–", ""),
        "its error": (error, ""),
        "its f max (kHz)": (number(enough.pseudo_frequency_max / 1e3) if enough else "–", ""),
        "WFE (nm)": (number(point.wfe), ""),
    }


def page_of(store: Path, dataset: xr.Dataset, device: str) -> Page:
    """Return the HTML report."""
    points = points_done(store, dataset)
    return Page(
        answer=answer(points) or "No case is done yet.",
        table=[_row(point) for point in points],
        small_print="Its error: the largest over time and over the excitations that decide, of the measure "
        "that the study's criterion names. WFE: the largest of the reference, whatever model computes it.",
        overview=list(_pictures(points)),
        sections=[],
        definitions=_DEFINITIONS,
        kind="variant",
        left_out=left_out(dataset, ["model", "variant"]),
    )


def _pictures(points: Sequence[Point]) -> Iterator[Picture]:
    judged = [one for one in points if one.model.variants]
    if not judged:
        return
    yield picture(
        "order",
        "Least error over the number of coordinates",
        errors_over_order(few(judged, _MOST_LINES)),
        "The best of all variants with at most as many coordinates, a line per point: where it passes below "
        "the dashed bound, a model is good enough. "
        + ("Of many points some are drawn." if len(judged) > _MOST_LINES else ""),
    )
    for name in judged[0].values:
        if len({one.values[name] for one in judged}) < 2 or not _is_number(judged[0].values[name]):
            continue
        lines = _lines(judged, name)
        yield picture(
            f"needed-{name}",
            f"Coordinates that are enough, over {name}",
            _over(lines, name, "order of the smallest variant that is good enough", _order, whole=True),
            "A gap is a point at which no variant is good enough. "
            + ("Of many lines some are drawn." if len(judged) > sum(map(len, lines.values())) else ""),
        )
        yield picture(
            f"wfe-{name}",
            f"Wavefront error of the reference over {name}",
            _over(lines, name, "largest rms wavefront error (nm)", lambda point: point.wfe, whole=False),
            "What the swept value does to the light itself, whatever model computes it: the worst of the "
            "excitations that decide.",
        )


def _is_number(value: Value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _lines(points: Sequence[Point], name: str) -> dict[str, list[Point]]:
    """Return the points that differ in one value only, by what else they are; the first few."""
    found: dict[str, list[Point]] = {}
    for point in points:
        found.setdefault(_words(points, point, name), []).append(point)
    return dict(islice(found.items(), _MOST_LINES))


def _words(points: Sequence[Point], one: Point, without: str = "") -> str:
    """Return what tells a point from the others, but for one value."""
    several = len({point.model.name for point in points}) > 1
    return ", ".join(filter(None, (one.model.name if several else "", one.place(without)))) or one.model.name


@rc_context(STYLE)
def errors_over_order(points: Sequence[Point]) -> Figure:
    """Draw the least error of all variants of at most some order, a step line per point."""
    figure, axes = one_panel(2 * WIDTH)
    for index, point in enumerate(points):
        known = [one for one in point.model.variants if np.isfinite(largest(one, point.criterion))]
        errors = [max(largest(one, point.criterion), 1e-12) for one in known]
        axes.step(
            [one.order for one in known],
            np.minimum.accumulate(errors) if errors else [],
            where="post",
            marker=".",
            **curve_style(index),
            label=_words(points, point),
        )
    for bound in {point.criterion.bound for point in points}:
        axes.axhline(bound, color="#444444", linewidth=0.8, linestyle=(0, (5, 2)))
    axes.set_yscale("log")
    label_powers(axes.yaxis)
    axes.set_xlabel("order (coordinates of the variant)")
    axes.set_ylabel(f"largest {MEASURES[points[0].criterion.measure]}, relative")
    axes.legend(fontsize=7.5, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


@rc_context(STYLE)
def _over(
    lines: Mapping[str, Sequence[Point]],
    name: str,
    label: str,
    value_of: Callable[[Point], float],
    *,
    whole: bool,
) -> Figure:
    figure, axes = one_panel()
    for index, (words, points) in enumerate(lines.items()):
        ordered = sorted(points, key=lambda one: float(one.values[name]))  # type: ignore[arg-type]
        values = [value_of(one) for one in ordered]
        axes.plot(
            [float(one.values[name]) for one in ordered],  # type: ignore[arg-type]
            values,
            marker="o",
            label=words,
            **curve_style(index),
        )
    axes.yaxis.set_major_locator(MaxNLocator(integer=whole))
    axes.set(xlabel=name, ylabel=label)
    axes.legend(fontsize=7.5)
    return figure
