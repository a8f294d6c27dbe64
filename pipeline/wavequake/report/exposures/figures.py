"""Figures of exposures: panels with the track of the line of sight, and histories over time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wavequake.drawing.ticks import in_inches
from wavequake.report.figures import STYLE, WIDTH, colorbar, curve_style, one_panel, stacked

Array = NDArray[np.float64]

# Decades below the peak that a picture shows.
_DECADES = 4
_TRACK = "#ff4d4d"
# Inches around panels: numbers and label; scale with its own; between columns; below; title.
_LEFT, _RIGHT, _GAP, _BOTTOM, _TITLE = 0.65, 0.95, 0.15, 0.5, 0.35


@dataclass(frozen=True)
class Panel:
    """An exposure (n, n), its title, and the track (instants, 2) of its line of sight in lambda/D.

    Without instants there is no track to draw.
    """

    title: str
    image: Array
    track: Array


@rc_context(STYLE)
def exposure_panels(panels: Sequence[Panel], axis: Array) -> Figure:
    """Show exposures with one logarithmic scale and the line of sight as a line (Fig. 4.32b and 4.45)."""
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    square = (WIDTH - _LEFT - _RIGHT - _GAP * (columns - 1)) / columns
    across, up = square + _GAP, square + _TITLE
    figure = Figure(figsize=(WIDTH, _BOTTOM + rows * up))
    top = max(float(panel.image.max()) for panel in panels)
    floor = 10.0**-_DECADES * top
    half = 0.5 * (axis[1] - axis[0])
    ends = (axis[0] - half, axis[-1] + half)
    places = []
    for number, panel in enumerate(panels):
        row, column = divmod(number, columns)
        lowest = number + columns >= len(panels)
        place = in_inches(figure, _LEFT + column * across, _BOTTOM + (rows - 1 - row) * up, square, square)
        picture = place.imshow(
            np.maximum(panel.image, floor), norm=LogNorm(floor, top), origin="lower", extent=(*ends, *ends)
        )
        place.plot(panel.track[:, 0], panel.track[:, 1], color=_TRACK, linewidth=0.8)
        place.plot(*panel.track[-1:].T, "o", color=_TRACK, markersize=2.0)
        place.set(xlim=ends, ylim=ends)
        place.set_title(panel.title, fontsize=8)
        place.tick_params(labelbottom=lowest, labelleft=not column)
        place.set(xlabel="x (λ/D)" if lowest else "", ylabel="" if column else "y (λ/D)")
        places.append(place)
    corner = [columns - 1 + columns * row for row in (0, rows - 1)]
    beside = places[corner[-1]] if corner[-1] < len(places) else places[corner[0]]
    colorbar(figure, beside, picture, "irradiance; 1 = perfect peak", top=places[corner[0]])
    return figure


@rc_context(STYLE)
def line_of_sight(time_ms: Array, tracks: Mapping[str, Array], unit: str) -> Figure:
    """Draw x and y of lines of sight (instants, 2) over time (Fig. 4.43)."""
    figure, panels = stacked()
    for place, axes in enumerate(panels):
        for number, (name, track) in enumerate(tracks.items()):
            axes.plot(time_ms, track[:, place], label=name, **curve_style(number))
        axes.set_ylabel(f"line of sight {'xy'[place]} ({unit})")
    axes.set_xlabel("time (ms)")
    _legend_above(figure, axes)
    return figure


@rc_context(STYLE)
def wavefront_error(time_ms: Array, histories: Mapping[str, Array]) -> Figure:
    """Draw the rms of the wavefront over time (Fig. 4.44)."""
    figure, axes = one_panel()
    for number, (name, values) in enumerate(histories.items()):
        axes.plot(time_ms, values, label=name, **curve_style(number))
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("time (ms)")
    axes.set_ylabel("wavefront error rms, j ≥ 4 (nm)")
    _legend_above(figure, axes)
    return figure


def _legend_above(figure: Figure, axes: Axes) -> None:
    """Name the curves outside: histories fill their panels."""
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", fontsize=7.5, ncols=3)
