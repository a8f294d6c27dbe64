"""Draw the sections of an optical system to scale: surfaces and glass by name, the stop, rays by field."""

from collections.abc import Sequence

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

from wavequake.drawing.layout import Layout, Part, layouts
from wavequake.drawing.light import field_names
from wavequake.drawing.style import COLORS, LINES, STYLE, Drawing, as_name
from wavequake.optics.systems.system import OpticalSystem

Array = NDArray[np.float64]

_GLASS, _GLASS_EDGE, _MIRROR, _FACE, _DARK = "#cfe3f3", "#6d9cc0", "#c9c9c9", "#333333", "#222222"
_METERS = 5000.0  # mm, from which on lengths are in m
_LOW, _HIGH = 1.5, 7.0  # inches: a panel's height
_LEFT = 0.85  # inches: room for the numbers of an axis in mm, and its name
_BORDER = 0.06
_FIRST = ("mirror", "stop", "image", "object", "glass", "surface")  # whose names are written first
HALO = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.6}
_AROUND = ((0, 1), (0, -1), (1, 0), (-1, 0), (0, 2), (0, -2), (1, 1), (-1, 1), (1, -1), (-1, -1))


def section_figure(system: OpticalSystem, width: float = 9.0, rays: int = 7) -> Drawing:
    """Return the section of a system with rays of all fields, to scale.

    Parameters
    ----------
    system : OpticalSystem
    width : float
        Of the figure, inches.
    rays : int
        Of each field.

    Raises
    ------
    UserError
        If the system is out of range or no light reaches its stop.
    """
    found = layouts(system, rays)
    with rc_context(STYLE):
        return _figure(system, found, width)


def _figure(system: OpticalSystem, found: Sequence[Layout], width: float) -> Drawing:
    across = width - 0.15 - _LEFT
    boxes = [box_of(layout) for layout in found]
    heights = [float(np.clip(across * np.ptp(box[:, 1]) / np.ptp(box[:, 0]), _LOW, _HIGH)) for box in boxes]
    boxes = [widened(box, across / height) for box, height in zip(boxes, heights, strict=True)]
    above, below = 0.55, 0.85 + 0.2 * (1 + (len(system.fields) - 1) // 4)
    figure = Drawing(figsize=(width, sum(heights) + above + below + 0.55 * (len(found) - 1)))
    total, top = figure.get_figheight(), figure.get_figheight() - above
    for layout, box, height in zip(found, boxes, heights, strict=True):
        axes = figure.add_axes((_LEFT / width, (top - height) / total, across / width, height / total))
        draw_section(axes, layout, box)
        top -= height + 0.55
    names = field_names(system)
    shown = sorted({field for layout in found for field, _ in layout.rays})
    figure.legend(
        handles=[Line2D([], [], color=COLORS[k % 7], ls=LINES[k % 4], label=names[k]) for k in shown],
        title="Rays of the field" + ("s" if len(shown) > 1 else ""),
        title_fontsize=8.5,
        loc="lower center",
        ncols=min(4, len(shown)),
        borderaxespad=0.2,
    )
    seen = " and ".join(_plane(layout) for layout in found)
    figure.suptitle(
        f"{system.name}: section with {seen}, to scale", x=_LEFT / width, ha="left", fontsize=10.5
    )
    return figure


def _plane(layout: Layout) -> str:
    return f"the {_axis(layout)}-z plane"


def _axis(layout: Layout) -> str:
    """Return what the second axis of a drawing is called."""
    x, y, _ = layout.across
    if not (x and y):
        return "x" if x else "y"
    return f"({x:.2g}, {y:.2g})"


def box_of(layout: Layout) -> Array:
    """Return the lowest and highest points (2, 2) of everything, with a border."""
    points = np.concatenate(
        [*(line for part in layout.parts for line in part.lines), *(r for _, r in layout.rays)]
    )
    low, high = points.min(axis=0), points.max(axis=0)
    border = _BORDER * float((high - low).max())
    return np.stack([low - border, high + border])


def widened(box: Array, ratio: float) -> Array:
    """Return a box about the same middle whose width is `ratio` times its height."""
    width, height = np.ptp(box, axis=0)
    half = np.array([max(width, ratio * height), max(height, width / ratio)]) / 2.0
    return np.asarray(box.mean(axis=0) + np.stack([-half, half]))


def draw_section(axes: Axes, layout: Layout, box: Array | None = None) -> None:
    """Draw a layout on axes, which get its scale."""
    low, high = box_of(layout) if box is None else box
    meters = float((high - low).max()) > _METERS
    unit, scale = ("m", 1e-3) if meters else ("mm", 1.0)
    axes.set_xlim(scale * low[0], scale * high[0])
    axes.set_ylim(scale * low[1], scale * high[1])
    axes.set_aspect("equal")
    axes.set_xlabel(f"z ({unit})")
    axes.set_ylabel(f"{_axis(layout)} ({unit})")
    fields = len({field for field, _ in layout.rays})
    for field, points in layout.rays:
        z, x = scale * points.T
        axes.plot(
            z, x, color=COLORS[field % 7], ls=LINES[field % 4], lw=0.7, alpha=0.9 if fields < 4 else 0.7
        )
    for part in layout.parts:
        _draw_part(axes, part, scale)
    _label(axes, layout.parts, scale)


def _draw_part(axes: Axes, part: Part, scale: float) -> None:
    for line in part.lines:
        z, x = scale * line.T
        if part.kind == "glass":
            axes.fill(z, x, facecolor=_GLASS, edgecolor=_GLASS_EDGE, lw=0.8, alpha=0.75, zorder=1)
        elif part.kind == "mirror":
            half = len(line) // 2
            axes.fill(z, x, facecolor=_MIRROR, edgecolor="none", zorder=3)
            axes.plot(z[:half], x[:half], color=_FACE, lw=1.4, zorder=4, solid_capstyle="butt")
        elif part.kind == "stop":
            axes.plot(z, x, color=_DARK, lw=2.2, zorder=5, solid_capstyle="butt")
        else:
            style = {"image": ("-", 1.6), "object": ("-", 1.6), "surface": (":", 0.9)}[part.kind]
            axes.plot(z, x, color=_DARK, ls=style[0], lw=style[1], zorder=4)


def _label(axes: Axes, parts: Sequence[Part], scale: float) -> None:
    """Write the names beside the parts; one that finds no free place is left out."""
    axes.apply_aspect()
    frame, taken = axes.get_window_extent(), list[Bbox]()
    named = sorted((part for part in parts if part.name), key=lambda part: _FIRST.index(part.kind))
    for part in named:
        points = axes.transData.transform(scale * np.concatenate(part.lines))
        box = Bbox([points.min(axis=0), points.max(axis=0)])
        name = as_name(part.name)
        text = axes.text(0, 0, name, fontsize=8.5, color=_DARK, ha="center", va="center", zorder=6)
        text.set_bbox(HALO)
        size = text.get_window_extent()
        for right, up in _AROUND:
            middle = (
                (box.x0 + box.x1) / 2 + right * ((box.width + size.width) / 2 + 4),
                (box.y0 + box.y1) / 2 + np.sign(up) * (box.height / 2 + (abs(up) - 0.5) * size.height + 3),
            )
            place = Bbox.from_bounds(
                middle[0] - size.width / 2, middle[1] - size.height / 2, size.width, size.height
            )
            inside = (
                frame.x0 <= place.x0
                and place.x1 <= frame.x1
                and frame.y0 <= place.y0
                and place.y1 <= frame.y1
            )
            if inside and not any(place.overlaps(other) for other in taken):
                x, y = axes.transData.inverted().transform(middle)
                text.set_position((float(x), float(y)))
                taken.append(place)
                break
        else:
            text.remove()
