"""Figures of exposures: panels with the track of the line of sight, and histories over time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wavequake.drawing.color_scales import color_scale
from wavequake.drawing.ticks import in_inches
from wavequake.report.figures import HEIGHT, STYLE, WIDTH, curve_style, one_panel, stacked

Array = NDArray[np.float64]

# Decades below the peak that a picture shows.
_DECADES = 4
_TRACK = "#ff4d4d"
# Inches beside, below and between panels, of which the scale of colors is to the right.
_LEFT, _RIGHT, _BOTTOM, _TITLE, _GAP = 0.65, 0.85, 0.5, 0.3, 0.2


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
    columns = 2 if len(panels) > 1 else 1
    rows = -(-len(panels) // columns)
    side = min(HEIGHT - 0.8, (WIDTH - _LEFT - _RIGHT - _GAP * (columns - 1)) / columns)
    pitch = side + _TITLE
    high = _BOTTOM + rows * pitch
    figure = Figure(figsize=(WIDTH, high))
    top = max(float(panel.image.max()) for panel in panels)
    half = 0.5 * (axis[1] - axis[0])
    extent = (axis[0] - half, axis[-1] + half, axis[0] - half, axis[-1] + half)
    floor = 10.0**-_DECADES * top
    norm = LogNorm(floor, top)
    for number, panel in enumerate(panels):
        row, column = divmod(number, columns)
        place = in_inches(
            figure, _LEFT + column * (side + _GAP), _BOTTOM + (rows - 1 - row) * pitch, side, side
        )
        place.imshow(np.maximum(panel.image, floor), norm=norm, origin="lower", extent=extent)
        place.plot(panel.track[:, 0], panel.track[:, 1], color=_TRACK, linewidth=0.8)
        place.plot(*panel.track[-1:].T, "o", color=_TRACK, markersize=2.0)
        place.set_xlim(*extent[:2])
        place.set_ylim(*extent[2:])
        place.set_title(panel.title, fontsize=8)
        lowest, leftmost = number + columns >= len(panels), column == 0
        place.tick_params(labelbottom=lowest, labelleft=leftmost)
        place.set(xlabel="x (λ/D)" if lowest else "", ylabel="y (λ/D)" if leftmost else "")
    right = _LEFT + columns * (side + _GAP) - _GAP + 0.1
    scale = right / WIDTH, _BOTTOM / high, 0.13 / WIDTH, (rows * pitch - _TITLE) / high
    color_scale(figure, scale, ScalarMappable(norm), "irradiance; 1 = perfect peak")
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
