"""The campaign's table: one row per disturbance model, for the terminal and for HTML."""

import textwrap
from collections.abc import Container, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from wavequake.report.populations import Summary
    from wavequake.report.statistics import Jitter, Quantile

MISSING = "–"
Row = Mapping[str, tuple[str, str]]

_CAPTION = (
    "WFE: rms of a case over its instants; P50 and P95 over cases, in brackets the 95 % "
    "confidence interval (≤, ≥: too few cases for both bounds). LOS: rms of both axes about the mean of all "
    "cases and instants, ± standard error; segments: rms along their normals; in brackets what the model "
    "implies. Strehl: over all instants. "
    "EE80: median over cases. Peak: of the exposure over the perfect one, line of sight included; 5 % of "
    "the cases are below. Rayleigh, Maréchal: share of instants with a peak to valley of at most λ/4, "
    "with an rms of at most λ/14, piston and tilt removed."
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


def rows(summaries: "Iterable[Summary]") -> list[dict[str, tuple[str, str]]]:
    """Return one dict per disturbance: header with unit -> (value, its uncertainty or remark), all text."""
    return [_row(summary) for summary in summaries]


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


def _row(summary: "Summary") -> dict[str, tuple[str, str]]:
    return {
        "disturbance": (summary.name, ""),
        "cases": (str(summary.cases), _left_out(summary)),
        "WFE on glass P50 (nm)": _quantile(summary.wfe_raw_p50),
        "WFE on glass P95 (nm)": _quantile(summary.wfe_raw_p95),
        "WFE j\u00a0≥\u00a04 P50 (nm)": _quantile(summary.wfe_p50),
        "WFE j\u00a0≥\u00a04 P95 (nm)": _quantile(summary.wfe_p95),
        "LOS jitter (mas)": _jitter(summary.los_jitter),
        "LOS model (mas)": (_model(summary.los_model), ""),
        "segments (nm)": (number(summary.segment_piston), ""),
        "segments model (nm)": (_model(summary.segment_piston_model), ""),
        "centroid jitter (mas)": _jitter(summary.centroid_jitter),
        "Strehl P5": _quantile(summary.strehl_p5, 4),
        "Strehl P50": _quantile(summary.strehl_p50, 4),
        "EE80 P50 (λ/D)": _radius(summary),
        "peak P5": _quantile(summary.peak_p5),
        "Rayleigh": (share(summary.rayleigh), ""),
        "Maréchal": (share(summary.marechal), ""),
    }


def _model(value: float | None) -> str:
    return MISSING if value is None else number(value)


def _left_out(summary: "Summary", before: str = "") -> str:
    counts = {"quarantined": summary.quarantined, "to do": summary.todo, "incomplete": summary.incomplete}
    words = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    return before + words if words else ""


def _quantile(quantile: "Quantile", digits: int = 3) -> tuple[str, str]:
    return number(quantile.value, digits), "" if np.isnan(quantile.value) else interval(quantile, digits)


def _radius(summary: "Summary") -> tuple[str, str]:
    found = summary.ee80_p50
    value, remark = _quantile(found, 4)
    if not np.isposinf(found.value):
        return value, remark
    return radius(found.value, summary.frame), remark if np.isfinite(found.low) else ""


def _jitter(jitter: "Jitter") -> tuple[str, str]:
    return number(jitter.radial), f"± {number(jitter.standard_error, 2)}" if np.isfinite(
        jitter.standard_error
    ) else ""


def terminal_table(summaries: "Iterable[Summary]") -> Table:
    """Return the table for a terminal: a few lines per disturbance, which fit 80 columns."""
    names = ("disturbance\ncases", "")
    numbers = "WFE on glass\nrms (nm)", "WFE j ≥ 4\nrms (nm)", "segments\nrms (nm)", "LOS rms\n(mas)"
    more = "Strehl\nP50, P5\nMaréchal", "EE80 (λ/D)\npeak P5\nRayleigh"
    headers = (*names, *numbers, *more)
    table = empty_table(headers, names, fixed=True, padding=0, pad_edge=False, caption=_CAPTION)
    for summary in summaries:
        jitter, error = _jitter(summary.los_jitter)
        model = "" if summary.los_model is None else f"\n({number(summary.los_model)})"
        segments = summary.segment_piston_model
        table.add_row(
            Text.assemble(
                ("\n".join(textwrap.wrap(summary.name, 15)), "bold"),
                f"\n{summary.cases}",
                (_left_out(summary, "\n"), "yellow"),
            ),
            "P50\nP95",
            f"{_with_interval(summary.wfe_raw_p50)}\n{_with_interval(summary.wfe_raw_p95)}",
            f"{number(summary.wfe_p50.value)}\n{number(summary.wfe_p95.value)}",
            number(summary.segment_piston) + ("" if segments is None else f"\n({number(segments)})"),
            f"{jitter}\n{error}{model}",
            f"{number(summary.strehl_p50.value, 4)}\n{number(summary.strehl_p5.value, 4)}\n"
            f"{share(summary.marechal)}",
            f"{_radius(summary)[0]}\n{number(summary.peak_p5.value)}\n{share(summary.rayleigh)}",
        )
    return table


def _with_interval(quantile: "Quantile") -> str:
    value, remark = _quantile(quantile)
    return value if remark in ("", MISSING) else f"{value} ({remark})"
