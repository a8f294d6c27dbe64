"""What telemetry says, as a table, sentences and figures."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from wavequake.drawing.style import COLORS, HEIGHT, STYLE, WIDTH, svg_text
from wavequake.errors import UserError
from wavequake.mechanics.telemetry.line import NORMAL, Line
from wavequake.mechanics.telemetry.whittle import oscillator
from wavequake.report.figures import stacked
from wavequake.report.table import MISSING, empty_table
from wavequake.words import counted
from wavequake.workflows.identify.identify import Identified
from wavequake.workflows.identify.study_text import explanation_words

_MOST_COLUMNS = 4
_MOST_PANELS = 8
_PICTURES = (".svg", ".png", ".pdf")


def lines_table(found: Identified) -> Table:
    """Return a row per line: frequency, damping, rms in each signal, and what moves."""
    channels = found.record.channels
    few = len(channels) <= _MOST_COLUMNS
    signals = [f"{one.element}.{one.axis} ({one.unit})" for one in channels] if few else ["rms"]
    flat = ["direction °"] * ([one.axis for one in channels] == ["x", "y"])
    table = empty_table(
        ("Hz", "damping %", *signals, *flat, "what moves"),
        ("what moves",),
        caption="95 % intervals in brackets. rms with signs: equal signs move together."
        + ("" if few else f" Of {len(channels)} signals the strongest is shown."),
    )
    for number, line in enumerate(found.lines):
        ends = line.interval
        cells = [
            _ends(line.frequency_hz, *ends[0]),
            _percent(line) if line.resolved else f"< {100.0 * line.damping:.2g}",
        ]
        shown = [_ends(value, *both, digits=3) for value, both in zip(line.rms, ends[2:], strict=True)]
        if few:
            cells += shown
        else:
            best = int(np.argmax(np.abs(line.rms) / np.maximum(line.deviations[2:], 1e-300)))
            cells.append(f"{channels[best].name} {shown[best]}")
        if flat:
            angle, error = direction(line)
            cells.append(_ends(angle, angle - NORMAL * error, angle + NORMAL * error, digits=4))
        table.add_row(*cells, explanation_words(found, number))
    return table


def direction(line: Line) -> tuple[float, float]:
    """Return the direction of a line in two signals of one unit and its standard deviation, degrees.

    Between -90 and 90, from the first signal to the second.
    """
    x, y = line.rms
    slope = np.array([-y, x]) / (x * x + y * y)
    angle = (np.degrees(np.arctan2(y, x)) + 90.0) % 180.0 - 90.0
    return float(angle), float(np.degrees(np.sqrt(slope @ line.covariance[2:, 2:] @ slope)))


def _ends(value: float, low: float, high: float, *, digits: int = 0) -> str:
    """Return a value with its interval; without digits as many as the interval is wide."""
    if not digits:
        width = max(high - low, 1e-12 * abs(value))
        places = max(0, 2 - int(np.floor(np.log10(width))) - 1)
        return f"{value:.{places}f} [{low:.{places}f}, {high:.{places}f}]"
    return f"{value:.{digits}g} [{low:.{digits}g}, {high:.{digits}g}]"


def _percent(line: Line) -> str:
    return _ends(100.0 * line.damping, *(100.0 * line.interval[1]), digits=3)


def modes_table(found: Identified) -> Table | None:
    """Return a row per mode of the structure that is a line, or None."""
    if not found.modes:
        return None
    headers = ("mode", "model Hz", "measured Hz", "model damping %", "measured %", "shapes alike")
    table = empty_table(headers, (), caption="Modes of the study's structure that are lines.")
    for one in found.modes:
        table.add_row(
            str(one.number),
            f"{one.model_hz:.5g}",
            _ends(one.line.frequency_hz, *one.line.interval[0]),
            f"{100.0 * one.model_damping:.3g}",
            _percent(one.line),
            MISSING if np.isnan(one.likeness) else f"{one.likeness:.0%}",
        )
    return table


def identify_notes(found: Identified) -> Iterator[str]:
    """Yield what the record cannot say."""
    record = found.record
    yield (
        f"{counted(len(found.lines), 'line')} in {record.duration:.6g} s of "
        f"{counted(len(record.channels), 'signal')} at {1.0 / record.step:.6g} Hz."
    )
    if found.seen is None:
        return
    elements = len(found.seen.elements)
    said = (
        f"These signals tell {found.rank} of the {6 * elements} motions of {counted(elements, 'element')} "
        "apart."
    )
    if found.dark:
        said += f" They do not see {_some(found.dark)}."
    for group in found.alike:
        said += f" {_some(group)} look alike to them."
    yield said


def _some(names: list[str] | tuple[str, ...], most: int = 8) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


@rc_context(STYLE)
def spectra_figure(found: Identified, title: str = "") -> Figure:
    """Draw the spectra of the signals with their 95 % intervals, and those of lines and rest."""
    channels = found.record.channels[:_MOST_PANELS]
    figure, panels = stacked(len(channels), 1.4 * WIDTH, 0.6 * HEIGHT * len(channels) + 0.6)
    low, high = found.spectra.interval()
    frequency = found.spectra.frequency
    model = _model(found)
    for number, (one, axes) in enumerate(zip(channels, panels, strict=True)):
        axes.fill_between(
            frequency, low[:, number], high[:, number], color="#bbbbbb", linewidth=0.0, label="measured, 95 %"
        )
        axes.plot(frequency, model[:, number], color=COLORS[0], linewidth=1.0, label="lines and rest")
        for line in found.lines:
            axes.axvline(line.frequency_hz, color=COLORS[1], linewidth=0.5, linestyle=":")
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylabel(f"{one.element}.{one.axis}\n({one.unit}²/Hz)")
        bottom = min(low[:, number].min(), model[:, number].min())
        axes.set_ylim(0.5 * bottom, 2.0 * high[:, number].max())
    panels[0].set_title(title or "What was measured, and the lines (dotted) that were found")
    panels[0].legend(loc="best")
    panels[-1].set_xlabel("frequency (Hz)")
    return figure


def _model(found: Identified) -> NDArray[np.float64]:
    """Return the density of lines and rest (F, c) as the averaged spectra show it."""
    frequency, step = found.spectra.frequency, found.record.step
    floor = found.floor
    rest = floor.directions.T**2 @ floor.densities
    total = np.stack([np.interp(frequency, floor.middles_hz, column) for column in rest], axis=1)
    width = 1.5 * float(frequency[1] - frequency[0])  # equivalent noise bandwidth of the averages' window
    for line in found.lines:
        if line.resolved:
            total += np.outer(oscillator(frequency, line.frequency_hz, line.damping, step), line.rms**2)
        else:
            total[int(np.argmin(np.abs(frequency - line.frequency_hz)))] += line.rms**2 / width
    return total


def require_outputs(files: list[Path]) -> None:
    """Raise UserError unless the names of files say what they hold, and their folders are there."""
    for file in files:
        if file.suffix.lower() not in (".toml", ".html", *_PICTURES):
            raise UserError(
                f"{file} must end in .toml (a study), .html (a page) or {', '.join(_PICTURES)} (a figure)."
            )
        if not file.absolute().parent.is_dir():
            raise UserError(f"{file} cannot be written: there is no folder {file.parent}.")
        if file.suffix.lower() == ".toml" and file.exists():
            raise UserError(f"{file} exists; name another file with --output, or remove it.")


def write_figure(figure: Figure, file: Path) -> None:
    """Write a figure as its name says; UserError if that fails."""
    try:
        if file.suffix.lower() == ".svg":
            file.write_text(svg_text(figure), encoding="utf-8")
        else:
            figure.savefig(file, dpi=150)
    except OSError as error:
        raise UserError(f"{file} cannot be written: {error.strerror}.") from None
