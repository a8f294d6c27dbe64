"""Budgets of disturbances: the table for the terminal and the figures of the report."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from rich.table import Table

from wavequake.campaign.store.store import BUDGET
from wavequake.report.answers.budget_tree import tree_explanations, tree_figure, tree_tables
from wavequake.report.figures import COLORS, STYLE, WIDTH
from wavequake.report.page import Picture, picture
from wavequake.report.table import MISSING, empty_table, number
from wavequake.words import are
from wavequake.workflows.budgets.kept import LOSSES, open_budget, unit_of

if TYPE_CHECKING:
    import xarray as xr

_TITLES = {
    "wfe_rms_raw": "WFE on glass",
    "wfe_rms": "WFE j ≥ 4",
    "los": "LOS",
    "wfe_change": "change of WFE j ≥ 4",
    "image_motion": "motion of the image",
}
# An interval wider than this many percent of the whole says as good as nothing.
_WIDEST, UNRESOLVED = 50.0, "unresolved"
_SHOWN = 0.1  # percent
_SHARES = {
    "share": "of the mean square, switched off",
    "first": "of the variance, alone",
    "total": "of the variance, with interactions",
}


def tables(found: "xr.Dataset") -> Iterator[Table]:
    """Yield one table per quantity: sources, the largest contributions first, and rings or elements.

    And then those of the groups.
    """
    for quantity in map(str, found["quantity"].to_numpy()):
        yield _table(found, quantity)
    yield from tree_tables(found, _TITLES)


def _table(found: "xr.Dataset", quantity: str) -> Table:
    one, unit = found.sel(quantity=quantity), unit_of(found, quantity)
    of_unit = "" if unit == "1" else f" {unit}"
    table = empty_table(
        ("factor", "contributes\n" + unit, "without it\n" + unit, *_HEADERS),
        fixed=True,
        pad_edge=False,
        title=f"{_title(quantity)}: {number(float(one['rms']))}{of_unit} rms, at rest "
        f"{number(float(one['rms_rest']))}{of_unit}",
    )
    names = [len(_words(one.isel(factor=row))) for row in range(one.sizes["factor"])]
    table.columns[0].min_width = min(max(names, default=0), _LONGEST_NAME)
    for kind in dict.fromkeys(one["kind"].to_numpy().tolist()):
        rows = np.flatnonzero(one["kind"].to_numpy() == kind)
        if kind != "ring":
            rows = rows[np.argsort(-one["share"].to_numpy()[rows], kind="stable")]
        for row in rows.tolist():
            factor = one.isel(factor=row)
            cells = [
                _part(factor, float(one["rms"])),
                number(float(factor["rms_without"])),
                *(_share(factor, key) for key in _SHARES),
            ]
            table.add_row(_words(factor), *cells, end_section=row == rows[-1])
    return table


def _title(quantity: str) -> str:
    return _TITLES.get(quantity, f"1 - {quantity}" if quantity in LOSSES else quantity)


def _words(factor: "xr.Dataset") -> str:
    name = str(factor["factor"].item())
    return f"{name} ({int(factor['segments'])} segments)" if factor["kind"].item() == "ring" else name


_LONGEST_NAME = 24
_HEADERS = ("mean square %\nswitched off", "variance %\nalone", "variance %\nwith interactions")


def _percent(factor: "xr.Dataset", key: str) -> tuple[float, float, float]:
    """Return a share and its interval, in percent."""
    value, low, high = (100.0 * float(factor[f"{key}{end}"]) for end in ("", "_low", "_high"))
    return value, low, high


def _share(factor: "xr.Dataset", key: str) -> str:
    value, low, high = _percent(factor, key)
    if np.isnan(value):
        return MISSING
    # Parts of a variance are not negative: an interval that is has met the one case in twenty.
    if high - low > _WIDEST or (key != "share" and high <= 0.0):
        return f"{UNRESOLVED} ({low:.0f} to {high:.0f})"
    if low < 0.0 < high:
        return f"below {max(high, _SHOWN):.1f}"
    value, low, high = (round(one, 1) + 0.0 for one in (value, low, high))  # no -0.0
    return f"{value:.1f} ({low:.1f} to {high:.1f})"


def _part(factor: "xr.Dataset", rms: float) -> str:
    """Return what a factor contributes to an rms, or the most that it may where its share may be none."""
    value, low, high = _percent(factor, "share")
    if not high - low <= _WIDEST:
        return MISSING
    if low < 0.0 < high:
        return f"< {number(np.sqrt(high / 100.0) * rms)}"
    return number(np.sqrt(value / 100.0) * rms) if value > 0.0 else "0"


def _single(found: "xr.Dataset") -> Iterator["xr.Dataset"]:
    """Yield every factor of every quantity."""
    for quantity in range(found.sizes["quantity"]):
        for factor in range(found.sizes["factor"]):
            yield found.isel(quantity=quantity, factor=factor)


def explanations(found: "xr.Dataset") -> list[str]:
    """Return what the numbers mean, in lines."""
    lost = found.attrs["cases"] - found.attrs["cases_used"]
    rings = "ring" in found["kind"].to_numpy()
    system = "image_motion" in found["quantity"].to_numpy()
    over = ", of all field points at the primary wavelength" if system else ""
    lines = [
        f"Budget of {found.attrs['population']}, {found.attrs['cases_used']} cases: rms over cases and "
        f"instants{over}; LOS and image relative to rest; in brackets 95 % confidence intervals (bootstrap "
        "over cases).",
        "Switched off: by what the mean square falls without the factor, on the same draws. Variance of the "
        "cases' rms: by the factor alone (first-order Sobol index), and with all that it interacts in "
        "(total index)"
        + ("; rings have none where segments are disturbed together, as by wind." if rings else "."),
    ]
    if any(UNRESOLVED in _share(one, key) for key in _SHARES for one in _single(found)):
        lines.append(
            f"Unresolved: the interval is wider than {_WIDEST:.0f} %, or that of a variance below 0, so "
            f"{found.attrs['cases_used']} cases "
            "say next to nothing of that share; take more (--cases), intervals shrink with their square root."
        )
    if "vignetted" in found.attrs:
        lines.append(found.attrs["vignetted"])
    if lost:
        lines.append(f"{are(lost, 'case')} left out: light was lost with some factor on or off.")
    return [*lines, *tree_explanations(found)]


def pictures(store: Path) -> list[Picture]:
    """Return the figure of the budget that a store keeps; none if it keeps none."""
    if not (Path(store) / BUDGET).exists():
        return []
    found = open_budget(store)
    words = f"Budget of {found.attrs['population']}: shares by factor, with 95 % confidence"
    tree = (
        [
            picture(
                "budget-groups",
                f"Budget of {found.attrs['population']}: what every group may be and is",
                tree_figure(found, _TITLES),
                "Bars are allocations, dots what the groups contribute alone with 95 % intervals, ticks the "
                "root of the sum of squares of their branches: where the two part, these are correlated.",
            )
        ]
        if "branch" in found.dims
        else []
    )
    return [
        *tree,
        picture(
            "budget",
            words,
            budget_figure(found),
            "A marker is the share of the variance that one disturbance causes, "
            "alone or with others; lines are 95 % intervals.",
        ),
    ]


@rc_context(STYLE)
def budget_figure(found: "xr.Dataset") -> Figure:
    """Draw the shares of every factor in the wavefront error and the line of sight."""
    names = [str(name) for name in found["factor"].to_numpy()]
    figure = Figure(figsize=(WIDTH, 1.3 + 0.3 * len(names)), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, quantity in zip(panels, found["quantity"].to_numpy()[[0, -1]].tolist(), strict=True):
        one = found.sel(quantity=quantity)
        for place, (key, label) in enumerate(_SHARES.items()):
            value, low, high = (100.0 * one[f"{key}{end}"].to_numpy() for end in ("", "_low", "_high"))
            height = np.arange(len(names)) + 0.25 * (place - 1)
            error = np.clip([value - low, high - value], 0.0, None)
            style = {"fmt": "osD"[place], "markersize": 4, "color": COLORS[place % len(COLORS)]}
            axes.errorbar(value, height, xerr=error, label=label, **style)
        axes.axvline(0.0, color="#444444", linewidth=0.7)
        axes.set_yticks(range(len(names)), names)
        axes.set_xlabel("share (%)")
        axes.set_title(_title(quantity))
    panels[0].invert_yaxis()
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=1)
    return figure
