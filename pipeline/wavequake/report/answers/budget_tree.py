"""The tree of a budget: what every group may be and is, as a table and a figure."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from rich.table import Table

from wavequake.report.figures import COLORS, STYLE, WIDTH
from wavequake.report.table import MISSING, empty_table, number
from wavequake.workflows.budgets.kept import unit_of

if TYPE_CHECKING:
    import xarray as xr

_LONGEST_NAME = 24
_CERTAIN = 0.3  # width of the interval of a correlation that is shown
_OPEN = 0.5  # width of an interval, as a share of the number, that leaves it open


def depths(found: "xr.Dataset") -> list[int]:
    """Return how deep every group of a budget lies, the whole at 0."""
    parents = dict(zip(found["branch"].to_numpy().tolist(), found["parent"].to_numpy().tolist(), strict=True))

    def depth(name: str) -> int:
        return 0 if not parents[name] else 1 + depth(parents[name])

    return [depth(name) for name in parents]


def allocated(found: "xr.Dataset") -> list[str]:
    """Return the quantities of which the groups are of interest: those with allocations, or else all."""
    every = [str(name) for name in found["quantity"].to_numpy()]
    some = [name for name in every if np.isfinite(found["allocation"].sel(quantity=name)).any()]
    return some or every


def tree_tables(found: "xr.Dataset", titles: dict[str, str]) -> Iterator[Table]:
    """Yield one table of the groups per quantity; none of a budget without groups."""
    if "branch" not in found.dims:
        return
    for quantity in allocated(found):
        one, unit = found.sel(quantity=quantity), unit_of(found, quantity)
        table = empty_table(
            ("group", "may be", "is", "margin", "verdict", "branches apart", "correlation"),
            ("group", "verdict"),
            fixed=True,
            pad_edge=False,
            title=f"{titles.get(quantity, quantity)}: groups ({unit} rms)",
        )
        names = [f"{'  ' * deep}{name}" for deep, name in zip(depths(one), _names(one), strict=True)]
        table.columns[0].min_width = min(max(map(len, names)), _LONGEST_NAME)
        for row, name in enumerate(names):
            table.add_row(name, *_cells(one.isel(branch=row)))
        yield table


def _names(found: "xr.Dataset") -> list[str]:
    return [str(name) for name in found["branch"].to_numpy()]


def _cells(one: "xr.Dataset") -> list[str]:
    value, low, high = (float(one[f"branch_rms{end}"]) for end in ("", "_low", "_high"))
    limit, apart = float(one["allocation"]), float(one["branch_apart"])
    ends = [float(one[f"branch_correlation{end}"]) for end in ("", "_low", "_high")]
    correlation = MISSING if np.isnan(ends[0]) else f"{ends[0]:+.2f}"
    if ends[2] - ends[1] > _CERTAIN:
        correlation = f"{ends[1]:+.1f} to {ends[2]:+.1f}"
    return [
        number(limit),
        f"{number(value)} ({number(low)}–{number(high)})",
        f"{number(limit - value)}" if np.isfinite(limit) else MISSING,
        verdict(limit, value, low, high),
        number(apart),
        correlation,
    ]


def verdict(limit: float, value: float, low: float, high: float) -> str:
    """Say whether a number that is known by an interval keeps its limit, in a word."""
    if np.isnan(limit):
        return ""
    if high <= limit:
        return "kept"
    if low > limit:
        return "over"
    return "unresolved" if high - low > _OPEN * value else "open"


def tree_explanations(found: "xr.Dataset") -> list[str]:
    """Return what the table of the groups means, and where allocations do not fit each other, in lines."""
    if "branch" not in found.dims:
        return []
    lines = [
        "Groups: each alone, its mean square beyond that at rest; the whole with what there is at rest. "
        "Branches apart: the root of the sum of squares of a group's branches, what they would be if they "
        "were independent; correlation: 0 makes that, 1 their sum, below 0 they cancel. Kept and over: with "
        "the whole 95 % interval; open: the allocation lies in it; unresolved: and it is wide, take more "
        "cases (--cases)."
    ]
    names, parents = (found[key].to_numpy().tolist() for key in ("branch", "parent"))
    for quantity in allocated(found):
        limits = found["allocation"].sel(quantity=quantity).to_numpy()
        for place, name in enumerate(names):
            below = limits[[k for k, parent in enumerate(parents) if parent == name]]
            total = float(np.sqrt(np.nansum(below**2)))
            if np.isfinite(below).any() and total > limits[place]:
                unit = unit_of(found, quantity)
                lines.append(
                    f"The branches of {name} may be {number(total)} {unit} together (root of the sum of "
                    f"squares), but {name} may be {number(float(limits[place]))} only."
                )
    return lines


@rc_context(STYLE)
def tree_figure(found: "xr.Dataset", titles: dict[str, str]) -> Figure:
    """Draw what every group may be and is, a panel per quantity."""
    quantities, names = allocated(found), _names(found)
    deep, rows = depths(found), np.arange(len(names))
    figure = Figure(figsize=(WIDTH, 1.3 + 0.32 * len(names)), layout="constrained")
    panels = figure.subplots(1, len(quantities), sharey=True, squeeze=False)[0]
    for axes, quantity in zip(panels, quantities, strict=True):
        one = found.sel(quantity=quantity)
        value, low, high = (one[f"branch_rms{end}"].to_numpy() for end in ("", "_low", "_high"))
        limit = one["allocation"].to_numpy()
        over = np.array([verdict(*row) == "over" for row in zip(limit, value, low, high, strict=True)])
        axes.barh(rows, np.where(np.isfinite(limit), limit, 0.0), color="#dddddd", height=0.7, label="may be")
        for these, label, color in ((~over, "is", COLORS[0]), (over, "is, over", COLORS[1])):
            error = np.clip([value - low, high - value], 0.0, None)[:, these]
            style = {"fmt": "o", "markersize": 4, "color": color, "label": label}
            axes.errorbar(value[these], rows[these], xerr=error, **style)
        mark = {"linestyle": "none", "marker": "|", "markersize": 12, "color": "#444444"}
        axes.plot(one["branch_apart"].to_numpy(), rows, label="branches apart", **mark)
        axes.set_xlim(left=0.0)
        axes.set_xlabel(f"{unit_of(found, quantity)} rms")
        axes.set_title(titles.get(quantity, quantity))
    panels[0].set_yticks(rows, [f"{'› ' * depth}{name}" for depth, name in zip(deep, names, strict=True)])
    panels[0].invert_yaxis()
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure
