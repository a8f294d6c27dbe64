"""The errors of a store as a table for the terminal, a figure, and in the table of its report."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from rich.table import Table

from wavequake.drawing.ticks import number_powers
from wavequake.report.answers.errors import SAMPLING, open_errors
from wavequake.report.figures import COLORS, STYLE, WIDTH
from wavequake.report.page import Page, Picture, picture
from wavequake.report.table import MISSING, empty_table, number
from wavequake.words import counted
from wavequake.workflows.refinements import REDUCTION

if TYPE_CHECKING:
    import xarray as xr

TableRow = dict[str, tuple[str, str]]

_SEEN = 1e-6  # percent below which a dot is not drawn
_COUNTS = 0.01  # share of the largest median from which a place counts
_MATTERS = 1e-4  # share of the median from which an error is of interest


@dataclass(frozen=True)
class NumberError:
    """What is known of a measure of a population, over all its places (fields, wavelengths, terms).

    ``level`` is the largest median; ``shares`` are the largest errors by origin, and by sampling of P50 and
    P95, in parts of the median at their place. Places whose median is below a hundredth of the largest do
    not count. ``open`` are origins whose steps do not converge there.
    """

    level: float
    units: str
    shares: Mapping[str, float]
    high: float
    open: frozenset[str]

    @property
    def most(self) -> str:
        """The origin of the largest error, sampling included."""
        known = {name: share for name, share in self.shares.items() if share > 0.0}
        return max(known, key=lambda name: known[name]) if known else MISSING


def number_errors(found: "xr.Dataset", population: int) -> dict[str, NumberError]:
    """Return the errors of every measure of a population by name; none of what is zero everywhere."""
    one = found.isel(population=population)
    level, names = np.abs(one["level"].to_numpy()), one["name"].to_numpy()
    error, sampling, settled = (one[key].to_numpy() for key in ("error", "sampling", "settled"))
    origins, known = one["origin"].to_numpy().tolist(), dict[str, NumberError]()
    for name in dict.fromkeys(names.tolist()):
        places = np.flatnonzero((names == name) & (level[:, 0] > 0.0))
        places = places[level[places, 0] >= _COUNTS * level[places, 0].max(initial=0.0)]
        if not places.size:
            continue
        shares, unsettled = dict[str, float](), set[str]()
        for origin, values, ok in zip(origins, error[places].T, settled[places].T, strict=True):
            parts = values / level[places, 0]
            if np.isfinite(parts).any():
                shares[origin] = float(np.nanmax(parts))
                if not ok[np.nanargmax(parts)]:
                    unsettled.add(origin)
        middle, high = (np.abs(sampling[places, q]) / level[places, q] for q in range(2))
        shares[SAMPLING] = float(middle.max())
        units = str(one["units"].to_numpy()[places[0]])
        largest = float(level[places, 0].max())
        known[name] = NumberError(largest, units, shares, float(high.max()), frozenset(unsettled))
    return known


def errors_table(found: "xr.Dataset") -> Table:
    """Return the errors as a table for the terminal, in percent of the median."""
    origins = [str(name) for name in found["origin"].to_numpy()]
    headers = "P50", *(f"{name}\n%" for name in origins), "sampling\nP50, P95 %", "most by"
    words = "cases", "measure"
    table = empty_table((*words, *headers), words, fixed=True, pad_edge=False)
    for place, population in enumerate(found["population"].to_numpy()):
        head = str(population)
        for name, one in number_errors(found, place).items():
            cells = [_percent(one.shares.get(origin, np.nan), origin in one.open) for origin in origins]
            sampling = f"{_percent(one.shares[SAMPLING])}, {_percent(one.high)}"
            level = f"{number(one.level)} {one.units}".rstrip()
            table.add_row(head, name, level, *cells, sampling, one.most)
            head = ""
    return table


def _percent(share: float, unsettled: bool = False) -> str:
    if np.isnan(share):
        return MISSING
    if np.isinf(share):
        return "?"
    words = number(100.0 * share, 2) if share >= 1e-5 or share == 0.0 else "< 0.001"
    return f"~{words}" if unsettled else words


def errors_notes(found: "xr.Dataset") -> Iterator[str]:
    """Yield what the numbers mean, in lines."""
    yield (
        f"Rms over {counted(found.attrs['cases'], 'case')} computed again, in percent of the median, the "
        "largest of all fields, wavelengths and terms (STORE/errors.zarr has each); sampling: half the 95 % "
        "confidence interval of P50 and P95 over all cases, where these are draws. ~: the steps do not "
        "converge, and the number is their spread; ?: too few cases for an interval."
    )
    for origin, steps in json.loads(found.attrs["steps"]).items():
        joined = "; ".join(steps)
        yield f"{origin}: {joined.removesuffix('.')}."
    if REDUCTION in found["origin"].to_numpy() and REDUCTION not in json.loads(found.attrs["steps"]):
        yield "reduction: against the full model, all stored cases of the same draws."


def pictures(found: "xr.Dataset") -> list[Picture]:
    """Return the figure of the errors of a store; none if nothing is known of any."""
    largest = _largest_errors(found)
    if not largest:
        return []
    return [
        picture(
            "errors",
            "Error of every number, by what it comes from",
            errors_figure(largest),
            "Each dot is the error of a measure by one origin, in percent of its median over cases, the "
            "largest of all populations; the one furthest to the right is worth the next effort.",
        )
    ]


def _largest_errors(found: "xr.Dataset") -> dict[str, dict[str, float]]:
    """Return the largest error of all populations in percent, by measure and origin: what can be drawn."""
    largest: dict[str, dict[str, float]] = {}
    for place in range(found.sizes["population"]):
        for name, one in number_errors(found, place).items():
            for origin, share in one.shares.items():
                if np.isfinite(share) and 100.0 * share > _SEEN:
                    known = largest.setdefault(name, {})
                    known[origin] = max(known.get(origin, 0.0), 100.0 * share)
    return largest


@rc_context(STYLE)
def errors_figure(largest: Mapping[str, Mapping[str, float]]) -> Figure:
    """Draw errors in percent by measure and origin."""
    names = list(largest)
    origins = list(dict.fromkeys(origin for one in largest.values() for origin in one))
    origins.sort(key=lambda origin: origin == SAMPLING)  # it stands last
    figure = Figure(figsize=(WIDTH, 1.2 + 0.26 * len(names)), layout="constrained")
    axes = figure.subplots()
    for place, origin in enumerate(origins):
        style: dict[str, Any] = {"marker": "osDv^<>"[place % 7], "color": COLORS[place % len(COLORS)]}
        shown = [largest[name].get(origin, np.nan) for name in names]
        axes.plot(shown, np.arange(len(names)), linestyle="none", markersize=5, label=origin, **style)
    axes.set_xscale("log")
    axes.set_xlim(axes.get_xlim())
    number_powers(axes.xaxis)
    axes.set_yticks(range(len(names)), [name.replace("_", " ") for name in names])
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlabel("error (% of the median)")
    axes.grid(axis="both", color="#dddddd", linewidth=0.6)
    figure.legend(loc="outside lower center", ncols=len(origins))
    return figure


def page_with_errors(store: Path, page: Page) -> Page:
    """Return a page with the errors that its store keeps: where they matter in the table, all in a figure."""
    found = open_errors(store)
    if found is None:
        return page
    words = (
        " ±: error by rays, terms, linearisation or reduction, where it is larger than half of what sampling "
        "leaves (wavequake errors)."
    )
    return replace(
        page,
        table=with_errors(found, page.table),
        small_print=page.small_print + words,
        overview=[*page.overview, *pictures(found)],
    )


# Columns of tables, as they begin, and the measure that they are of.
_COLUMNS = {
    "WFE on glass P": "wfe_rms_raw",
    "WFE j\u00a0≥\u00a04 P": "wfe_rms",
    "WFE P": "wfe_rms",
    "change P": "wfe_change",
    "LOS jitter": "los",
    "LOS (µm)": "los_mm",
    "spot P": "spot_rms",
    "Strehl": "strehl",
    "EE80": "ee80",
    "peak": "peak",
}


def with_errors(found: "xr.Dataset", table: list[TableRow]) -> list[TableRow]:
    """Return a report's table with the errors that matter: those larger than half of that by sampling."""
    populations, made = found["population"].to_numpy().tolist(), []
    for row in table:
        first = next(iter(row.values()))[0] if row else ""
        errors = number_errors(found, populations.index(first) if first in populations else 0)
        shown = {}
        for header, (value, remark) in row.items():
            heads = (name for head, name in _COLUMNS.items() if header.startswith(head))
            one = errors.get(next(heads, header.split(" ")[0]))
            words = _that_matter(one) if one is not None and value not in ("", MISSING) else ""
            shown[header] = (value, "; ".join(part for part in (remark, words) if part))
        made.append(shown)
    return made


def _that_matter(one: NumberError) -> str:
    """Return the errors that are larger than half of what sampling leaves, in words."""
    least = max(_MATTERS, 0.5 * one.shares[SAMPLING])
    return ", ".join(
        f"{origin} ± {number(100.0 * share, 2)} %"
        for origin, share in one.shares.items()
        if origin != SAMPLING and share > least
    )
