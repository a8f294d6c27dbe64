"""A segmented mirror from above: every segment where it stands, with its name, and the pupil's annulus."""

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.patches import Circle
from numpy.typing import NDArray

from wavequake.drawing.layout import layouts
from wavequake.drawing.light import field_names
from wavequake.drawing.section import box_of, draw_section, widened
from wavequake.drawing.style import STYLE, Drawing
from wavequake.optics.segments.layout import is_monolithic
from wavequake.optics.segments.parent import parent_system
from wavequake.optics.segments.telescope import SegmentedTelescope
from wavequake.optics.systems.system import OpticalSystem

Array = NDArray[np.float64]

_FILL, _EDGE, _PUPIL = "#e8eef4", "#55718c", "#D55E00"
_CLEAR = 0.42  # of a segment's width: how wide a name of so many letters may be written
_LARGEST, _SMALLEST = 9.0, 3.5  # points


def aperture_figure(telescope: SegmentedTelescope, width: float = 7.0) -> Drawing:
    """Return a telescope's primary mirror as light sees it, x to the right and y up, with the names.

    Parameters
    ----------
    telescope : SegmentedTelescope
    width : float
        Of the figure, inches.
    """
    with rc_context(STYLE):
        figure = Drawing(figsize=(width, width + 0.2))
        axes = figure.add_axes((0.1, 0.09, 0.86, 0.83))
        draw_aperture(axes, telescope)
        count = len(telescope.segments)
        what = "one mirror" if is_monolithic(telescope.segments) else f"{count} segments by name"
        axes.set_title(f"{telescope.name}: primary mirror from above, {what}")
    return figure


def telescope_figure(
    telescope: SegmentedTelescope, system: OpticalSystem | None = None, width: float = 11.0
) -> Drawing:
    """Return a telescope's primary mirror from above and, beside it, its section with rays.

    Parameters
    ----------
    telescope : SegmentedTelescope
    system : OpticalSystem, optional
        The telescope with a mirror of one piece, and the fields to draw; by default its axis.
    width : float
        Of the figure, inches.

    Raises
    ------
    UserError
        As `wavequake.drawing.layout.layouts`.
    """
    system = system or parent_system(telescope)
    layout = layouts(system)[0]
    with rc_context(STYLE):
        side = (width - 1.6) / 2.0
        height = side + 1.05
        figure = Drawing(figsize=(width, height))
        above = figure.add_axes((0.6 / width, 0.55 / height, side / width, side / height))
        beside = figure.add_axes(((side + 1.45) / width, 0.55 / height, side / width, side / height))
        draw_aperture(above, telescope)
        count = len(telescope.segments)
        what = "" if is_monolithic(telescope.segments) else f", {count} segments"
        above.set_title(f"{telescope.name}: primary mirror from above{what}")
        draw_section(beside, layout, widened(box_of(layout), 1.0))
        names = field_names(system)
        shown = ", ".join(names[field] for field in sorted({field for field, _ in layout.rays}))
        beside.set_title(f"Section with rays of the field {shown}")
    return figure


def draw_aperture(axes: Axes, telescope: SegmentedTelescope) -> None:
    """Draw the segments of a telescope on axes, in m."""
    segments, outer = telescope.segments, telescope.pupil_outer / 1e3
    corners = segments.corners / 1e3
    reach = max(outer, float(np.hypot(corners[..., 0], corners[..., 1]).max(initial=0.0)))
    for radius in (outer, telescope.pupil_inner / 1e3):
        axes.add_patch(
            Circle((0, 0), radius, facecolor="none", edgecolor=_PUPIL, lw=0.9, ls=(0, (4, 2)), zorder=3)
        )
    if is_monolithic(segments):
        axes.add_patch(Circle((0, 0), outer, facecolor=_FILL, edgecolor=_EDGE, lw=0.9))
        axes.add_patch(
            Circle((0, 0), telescope.pupil_inner / 1e3, facecolor="white", edgecolor=_EDGE, lw=0.9)
        )
    else:
        polygons = PolyCollection(list(corners), facecolors=_FILL, edgecolors=_EDGE, linewidths=0.5)
        axes.add_collection(polygons)
        _write_names(axes, corners, segments.names, 1.04 * reach)
    axes.set(xlim=(-1.04 * reach, 1.04 * reach), ylim=(-1.04 * reach, 1.04 * reach), aspect="equal")
    axes.set_xlabel("x (m); dashed: pupil")
    axes.set_ylabel("y (m)")


def _write_names(axes: Axes, corners: Array, names: tuple[str, ...], reach: float) -> None:
    """Write each name into its segment, as large as the smallest segment lets the longest name be."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    room = float((high - low).min()) / (2.0 * reach)  # of the width of the axes
    points = room * axes.get_window_extent().width * 72.0 / axes.figure.get_dpi()
    size = min(_LARGEST, points * 2.0 * _CLEAR / max(1, max(map(len, names))) * 1.6)
    if size < _SMALLEST:
        return
    for name, (x, y) in zip(names, (low + high) / 2.0, strict=True):
        axes.text(x, y, name, fontsize=size, ha="center", va="center", color="#222222", zorder=4)
