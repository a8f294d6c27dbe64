"""What telemetry says, as a page: spectra with lines, what moves at each of them, and what is not seen."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.figure import Figure

from wavequake.campaign.schema import Study
from wavequake.drawing.style import COLORS, HEIGHT, STYLE, WIDTH
from wavequake.report.answers.identify import identify_notes, lines_table, modes_table, spectra_figure
from wavequake.report.page import OF_A_RECORD, Page, Picture, Section, picture, render_page, write_page
from wavequake.report.table import rows_of
from wavequake.workflows.identify.identify import Identified, doubts
from wavequake.workflows.identify.study_text import explanation_words

_MOST_SIGNALS = 12
_MOST_SAID = 3
_DEFINITIONS = (
    ("line", "A resonance of the record: a damped oscillation that noise drives, or a tone."),
    ("95 % intervals", "In brackets: of a Gaussian likelihood of the spectra (Whittle)."),
    (
        "what moves",
        "The motion that explains the line in all signals best, by the sensitivities of the study, and what "
        "explains it nearly as well.",
    ),
)


def write_identified(found: Identified, study: Study, data: Path, file: Path) -> Path:
    """Write the page of what telemetry says and return its absolute path; UserError if that fails."""
    notes = list(identify_notes(found))
    overview = [
        picture(
            "spectra",
            f"Spectra of {data.name}, and what was found in them",
            spectra_figure(found, data.name),
            "The band is what was measured with its 95 % interval, the curve the lines and the rest that "
            "explain it; dotted are the frequencies of the lines.",
        ),
        *_shares(found),
    ]
    modes = modes_table(found)
    page = Page(
        answer=" ".join([notes[0], *_moving(found)]),
        table=rows_of(lines_table(found)),
        small_print=" ".join([str(lines_table(found).caption or ""), *notes[1:], *doubts(found)]),
        overview=overview,
        sections=[Section("modes of the structure", [_modes(found)])] if modes is not None else [],
        definitions=list(_DEFINITIONS),
        kind=OF_A_RECORD,
        left_out=(),
    )
    about = {"study_title": f"What {data.name} says of {study.study.name}", "telemetry": data.name}
    return write_page(render_page(xr.Dataset(attrs={**about, "study": study.identity_text()}), page), file)


def _moving(found: Identified) -> Iterator[str]:
    """Say of the strongest lines what moves."""
    strong = sorted(range(len(found.lines)), key=lambda k: -float(np.abs(found.lines[k].rms).max()))
    for number in strong[:_MOST_SAID]:
        yield f"At {found.lines[number].frequency_hz:.4g} Hz: {explanation_words(found, number)}."


def _shares(found: Identified) -> list[Picture]:
    """Draw how strong every line is in every signal; none without lines."""
    if not found.lines:
        return []
    return [
        picture(
            "strengths",
            "How strong every line is in the signals",
            _strengths(found),
            "Each row is a signal in parts of its own rms, each column a line; colors tell the sign: signals "
            "of one color move together.",
        )
    ]


@rc_context(STYLE)
def _strengths(found: Identified) -> Figure:
    channels = found.record.channels[:_MOST_SIGNALS]
    values = np.array([line.rms[: len(channels)] for line in found.lines]).T
    sizes = np.sqrt(np.sum(values**2, axis=1, keepdims=True))
    shown = values / np.where(sizes > 0.0, sizes, 1.0)
    figure = Figure(figsize=(WIDTH, 1.0 + 0.32 * len(channels)), layout="constrained")
    axes = figure.subplots()
    drawn = axes.imshow(shown, cmap="RdBu_r", vmin=-1.0, vmax=1.0, aspect="auto")
    axes.set_xticks(range(len(found.lines)), [f"{line.frequency_hz:.4g}" for line in found.lines])
    axes.set_yticks(range(len(channels)), [f"{one.element}.{one.axis}" for one in channels])
    axes.set_xlabel("line (Hz)")
    figure.colorbar(drawn, ax=axes, label="rms with sign, share of all lines")
    return figure


def _modes(found: Identified) -> Picture:
    """Draw the frequencies of modes by model and measurement."""
    return picture(
        "modes",
        "Modes of the structure: by the model, and as measured",
        _frequencies([(one.model_hz, one.line.frequency_hz) for one in found.modes]),
        "Dots on the diagonal: model and measurement agree.",
    )


@rc_context(STYLE)
def _frequencies(pairs: Sequence[tuple[float, float]]) -> Figure:
    model, measured = np.array(pairs).T
    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    axes = figure.subplots()
    ends = [0.9 * min(model.min(), measured.min()), 1.1 * max(model.max(), measured.max())]
    axes.plot(ends, ends, color="#999999", linewidth=0.8)
    axes.plot(model, measured, "o", color=COLORS[0])
    axes.set(xlabel="frequency by the model (Hz)", ylabel="measured (Hz)")
    return figure
