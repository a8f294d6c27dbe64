"""The campaign's table: one row per disturbance model, for the terminal and for HTML."""

import textwrap
from collections.abc import Container, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from wavequake.report.populations import Population
    from wavequake.report.statistics import Jitter, Quantile

Array = NDArray[np.float64]

MISSING = "–"
Row = Mapping[str, tuple[str, str]]

_LEVELS = ((0.5, "P50"), (0.95, "P95"), (0.999, "P99.9"))
_WFE = (
    "WFE: rms of a case over its instants; {} over cases, in brackets the 95 % confidence interval (≤, ≥: "
    "too few cases for both bounds)."
)
_LAST = ("EE80 P50 (λ/D)", "peak P5", "Rayleigh")
OF_WHOLE = (
    "LOS: rms of both axes about the mean of all cases and instants, ± standard error; segments: rms along "
    "their normals; in brackets what the model implies. Strehl: over all instants. EE80: median over cases. "
    "Peak: of the exposure over the perfect one, line of sight included; 5 % of the cases are below. "
    "Rayleigh, Maréchal: share of instants with a peak to valley of at most λ/4, with an rms of at most "
    "λ/14, piston and tilt removed."
)
OF_OTHERS = (
    "LOS: rms of a case over its instants, the distance from rest; segments: rms along their normals, "
    "in brackets what the model implies. "
    "Maréchal: share of instants with an rms of at most λ/14, piston and tilt removed."
)


def number(value: float, digits: int = 3) -> str:
    """Format a number with significant digits, without an exponent where it can be read without one."""
    if np.isnan(value):
        return MISSING
    if np.isinf(value) or abs(value) < 1e-12:  # rounding of what is nothing
        return f"{value:g}" if np.isinf(value) else "0"
    exponent = int(np.floor(np.log10(abs(float(f"{value:.{digits - 1}e}")))))
    if exponent < -4 or exponent > 5:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(0, digits - 1 - exponent)}f}"


def share(value: float) -> str:
    """Format a share in percent; only all is 100 % and only none 0 %."""
    if np.isnan(value):
        return MISSING
    percent = 100.0 * value
    if 0.0 < percent < 1.0 or 99.0 < percent < 100.0:
        return "< 1 %" if percent < 1.0 else "> 99 %"
    return f"{percent:.0f} %"


def difference(mean: float, margin: float, first: float, largest: float) -> tuple[str, str]:
    """Format a mean difference with its margin, and as a share of the first mean; "none" of equal cases."""
    if number(largest) == "0":
        return "none", "none"
    share = mean / first if first else np.nan
    percent = "< 0.01%" if abs(share) < 5e-5 else f"{share:+.2%}"
    both = f"{number(mean)} ± {number(margin)}" if np.isfinite(margin) else number(mean)
    return both, MISSING if np.isnan(share) else percent


def interval(quantile: "Quantile", digits: int = 3) -> str:
    """Format a confidence interval; a bound that does not exist is left out."""
    low, high = np.isfinite(quantile.low), np.isfinite(quantile.high)
    if low and high:
        return f"{number(quantile.low, digits)}–{number(quantile.high, digits)}"
    if low:
        return f"≥ {number(quantile.low, digits)}"
    return f"≤ {number(quantile.high, digits)}" if high else MISSING


def radius(value: float, frame: float, digits: int = 3) -> str:
    """Format a radius of encircled energy, infinite where the circle leaves the frame (half its width)."""
    beyond = "beyond the frame" if np.isnan(frame) else f"> {frame:g}, the frame"
    return beyond if np.isposinf(value) else number(value, digits)


def empty_table(
    headers: Iterable[str], words: Container[str] | None = None, *, fixed: bool = False, **style: Any
) -> Table:
    """Return a table for the terminal that has no rows yet; numbers stand right.

    Columns of `words`, by default the first, stand left. The others have no line breaks where they are
    `fixed`. `style` is what rich's Table takes.
    """
    table = Table(**{"box": SIMPLE_HEAD, "caption_justify": "left", "title_justify": "left", **style})
    for place, header in enumerate(headers):
        if place == 0 if words is None else header in words:
            table.add_column(header, overflow="fold")
        else:
            table.add_column(header, justify="right", no_wrap=fixed)
    return table


def table_of_rows(rows: Sequence[Row], caption: str, labels: int = 1, small: str = "") -> Table:
    """Return the table for the terminal of rows of a page, header -> (value, small print).

    The first `labels` columns are words. `small` is how small print stands behind its value, as " ({})"; it
    is left out otherwise.
    """
    headers = list(rows[0]) if rows else []
    words, values = headers[:labels], ["\n".join(header.rsplit(" ", 1)) for header in headers[labels:]]
    table = empty_table([*words, *values], words, fixed=True, caption=caption, padding=(0, 1, 0, 0))
    for row in rows:
        table.add_row(*(value + small.format(print_) if print_ else value for value, print_ in row.values()))
    return table


def rows_of(table: Table) -> list[dict[str, tuple[str, str]]]:
    """Return the rows of a table for the terminal as those of a page."""
    headers = [" ".join(str(column.header).split()) for column in table.columns]
    cells = zip(*(map(str, column.cells) for column in table.columns), strict=True)
    return [{header: (one, "") for header, one in zip(headers, row, strict=True)} for row in cells]


def row_of(one: "Population") -> dict[str, tuple[str, str]]:
    """Return header with unit -> (value, its uncertainty or remark) of a disturbance, all text."""
    row = {"disturbance": (one.name, ""), "cases": (str(len(one.cases)), _left_out(one))}
    named = [("WFE on glass {} (nm)", one.wfe_raw), ("WFE j\u00a0≥\u00a04 {} (nm)", one.wfe)]
    for header, values in [*named, *([] if one.whole else [("LOS {} (mas)", one.los)])]:
        for p, label in levels(one.whole):
            row[header.format(label)] = _quantile(one.quantile(values, p))
    if one.whole:
        row["LOS jitter (mas)"] = _jitter(one.los_jitter)
        row["LOS model (mas)"] = number(one.model_in("mas")), ""
    row |= {
        "segments (nm)": (number(_rms(one.segment_piston)), ""),
        "segments model (nm)": (number(one.model_in("nm")), ""),
    }
    if one.whole:
        row |= {
            "centroid jitter (mas)": _jitter(one.centroid_jitter),
            "Strehl P5": _quantile(one.quantile(one.strehl, 0.05), 4),
            "Strehl P50": _quantile(one.quantile(one.strehl, 0.5), 4),
            "EE80 P50 (λ/D)": _radius(one),
            "peak P5": _quantile(one.quantile(one.peak, 0.05)),
            "Rayleigh": (share(_mean(one.rayleigh)), ""),
        }
    return {**row, "Maréchal": (share(_mean(one.marechal)), "")}


def levels(whole: bool) -> tuple[tuple[float, str], ...]:
    """Return the percentiles of wavefront errors that tables show, with their names."""
    return _LEVELS[:2] if whole else _LEVELS


def _mean(values: Array) -> float:
    return float(values.mean()) if values.size else np.nan


def _rms(values: Array) -> float:
    return float(np.sqrt(_mean(np.square(values))))


def _left_out(one: "Population", before: str = "") -> str:
    counts = {"quarantined": one.quarantined, "to do": one.todo, "incomplete": len(one.incomplete)}
    words = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    return before + words if words else ""


def _quantile(quantile: "Quantile", digits: int = 3) -> tuple[str, str]:
    return number(quantile.value, digits), "" if np.isnan(quantile.value) else interval(quantile, digits)


def _radius(one: "Population") -> tuple[str, str]:
    found = one.quantile(one.ee80, 0.5)
    value, remark = _quantile(found, 4)
    if not np.isposinf(found.value):
        return value, remark
    return radius(found.value, one.frame), remark if np.isfinite(found.low) else ""


def _jitter(jitter: "Jitter") -> tuple[str, str]:
    known = np.isfinite(jitter.standard_error)
    return number(jitter.radial), f"± {number(jitter.standard_error, 2)}" if known else ""


def terminal_table(found: "Sequence[Population]") -> Table:
    """Return the table for a terminal: a few lines per disturbance, which fit 80 columns."""
    whole = any(one.whole for one in found)
    names, labels = ("disturbance\ncases", ""), [label for _, label in levels(whole)]
    numbers = "WFE on glass\nrms (nm)", "WFE j ≥ 4\nrms (nm)", "segments\nrms (nm)", "LOS rms\n(mas)"
    more = ("Strehl\nP50, P5\nMaréchal", "EE80 (λ/D)\npeak P5\nRayleigh") if whole else ("Maréchal",)
    caption = f"{_WFE.format(', '.join(labels))} {OF_WHOLE if whole else OF_OTHERS}"
    headers = (*names, *numbers, *more)
    table = empty_table(headers, names, fixed=True, padding=0, pad_edge=False, caption=caption)
    for one in found:
        row = row_of(one)
        name = ("\n".join(textwrap.wrap(one.name, 15)), "bold")
        raw, fitted, los, strehl = (
            [cell for header, cell in row.items() if header.startswith(start)]
            for start in ("WFE on glass", "WFE j", "LOS P", "Strehl")
        )
        sight = "\n".join([value for value, _ in los] or row["LOS jitter (mas)"])
        marechal = row["Maréchal"][0]
        table.add_row(
            Text.assemble(name, f"\n{len(one.cases)}", (_left_out(one, "\n"), "yellow")),
            "\n".join(labels),
            "\n".join(value if small in ("", MISSING) else f"{value} ({small})" for value, small in raw),
            "\n".join(value for value, _ in fitted),
            row["segments (nm)"][0] + _implied(row["segments model (nm)"][0]),
            sight + (_implied(row["LOS model (mas)"][0]) if whole else ""),
            "\n".join([*(value for value, _ in strehl[::-1]), marechal]),
            *(["\n".join(row[key][0] for key in _LAST)] if whole else []),
        )
    return table


def _implied(model: str) -> str:
    return "" if model == MISSING else f"\n({model})"
