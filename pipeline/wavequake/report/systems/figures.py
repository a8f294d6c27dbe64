"""Figures of a system-disturbance store: spots, distributions and maps over the field."""

from collections.abc import Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from wavequake.drawing.style import hover
from wavequake.report.figures import COLORS, HEIGHT, STYLE, WIDTH, one_panel
from wavequake.report.table import number

Array = NDArray[np.float64]

_MOST_PANELS = 9


@rc_context(STYLE)
def field_map(points: Array, values: Array, unit: str, label: str) -> Figure:
    """Draw a value at every field point (F, 2)."""
    figure, axes = one_panel()
    middle, reach = float(values.mean()), float(np.ptp(values)) / 2.0
    reach = max(reach, 0.01 * abs(middle)) or 1.0  # what is equal everywhere has one color
    ends = Normalize(middle - reach, middle + reach)
    marks = axes.scatter(
        points[:, 0], points[:, 1], c=values, s=160, cmap="viridis", norm=ends, edgecolors="#444444"
    )
    marks.set_gid(
        hover(
            [
                f"({x:g}, {y:g}) {unit}: {number(float(one))}"
                for (x, y), one in zip(points, values, strict=True)
            ]
        )
    )
    for (x, y), value in zip(points, values, strict=True):
        axes.annotate(number(float(value)), (x, y), xytext=(9, 0), textcoords="offset points", va="center")
    figure.colorbar(marks, ax=axes, label=label)
    axes.margins(0.3)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"field x ({unit})")
    axes.set_ylabel(f"field y ({unit})")
    return figure


@rc_context(STYLE)
def spot_diagrams(
    panels: Sequence[Sequence[Array]],
    fields: Sequence[str],
    wavelengths: Sequence[str],
    airy: float,
    title: str,
) -> Figure:
    """Draw the image points (N, 2) in um of every field and wavelength, and the Airy disc at rest.

    All panels have one scale; of many fields the first nine are drawn.
    """
    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    shown = list(zip(panels, fields, strict=True))[:_MOST_PANELS]
    columns = int(np.ceil(np.sqrt(len(shown))))
    rows = -(-len(shown) // columns)
    reach = max(float(np.nanmax(np.abs(spot), initial=airy)) for spots, _ in shown for spot in spots)
    for index, (spots, name) in enumerate(shown):
        axes = figure.add_subplot(rows, columns, index + 1)
        _spots(axes, spots, wavelengths, airy, 1.08 * reach)
        axes.set_title(name, fontsize=8.5)
        if index + columns >= len(shown):
            axes.set_xlabel("x (µm)", fontsize=9)
        if index % columns == 0:
            axes.set_ylabel("y (µm)", fontsize=9)
    figure.legend(
        *axes.get_legend_handles_labels(), loc="outside lower right", ncols=4, fontsize=7, markerscale=4
    )
    figure.suptitle(f"{title}; about the chief ray at rest, circle: Airy disc", fontsize=9)
    return figure


def _spots(axes: Axes, spots: Sequence[Array], wavelengths: Sequence[str], airy: float, reach: float) -> None:
    for index, (spot, wavelength) in enumerate(zip(spots, wavelengths, strict=True)):
        arrived = spot[np.isfinite(spot).all(axis=1)]
        color = COLORS[index % len(COLORS)]
        axes.plot(
            *arrived.T, ".", markersize=1.4, color=color, label=wavelength, rasterized=True
        )  # thousands of points are smaller as an image
    axes.add_patch(Circle((0.0, 0.0), airy, fill=False, linewidth=0.8, edgecolor="#222222"))
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_aspect("equal")
