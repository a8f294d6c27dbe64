"""Draw the sections of an optical system to scale: surfaces and glass by name, the stop, rays by field.

Lenses that are small in the whole are drawn once more by themselves, and a system that is a thin line once
more with its heights stretched.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

from wavequake.drawing.layout import Layout, Part, layouts, stretching
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
_SMALL = 0.25  # of the drawing: lenses that are smaller get one of their own
_FILLS = 0.9  # of a drawing's height: what is higher has its name on it
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


@dataclass(frozen=True, eq=False)
class _Panel:
    """A part of a figure: a layout within a box (2, 2), mm, heights that many times as large."""

    layout: Layout
    box: Array
    title: str = ""
    stretched: float = 1.0
    unnamed: Array | None = None

    def height(self, across: float) -> float:
        """Return the height of the panel, inches, that is so wide."""
        wide, high = np.ptp(self.box, axis=0)
        return float(np.clip(across * self.stretched * high / wide, _LOW, _HIGH))


def _panels(layout: Layout) -> Iterator[_Panel]:
    """Yield the panels of a layout: the whole, and what is too small in it."""
    whole = box_of(layout)
    if (lenses := _lenses(layout)) is not None and np.ptp(lenses, axis=0).max() < _SMALL * np.ptp(
        whole[:, 0]
    ):
        yield _Panel(layout, whole, unnamed=lenses)
        yield _Panel(layout, lenses, "The lenses, framed above, to scale")
        return
    yield _Panel(layout, whole)
    light = [ray for _, ray in layout.rays] + [
        one for part in layout.parts if part.kind == "glass" for one in part.lines
    ]
    low, high = _bounds(light)
    if (times := stretching(float((high - low)[1] / np.ptp(whole[:, 0])))) > 1.0:
        border = 0.25 * (high - low)[1]
        box = np.array([[whole[0, 0], low[1] - border], [whole[1, 0], high[1] + border]])
        yield _Panel(layout, box, f"The same, heights stretched {times:g} times", times)


def _lenses(layout: Layout) -> Array | None:
    """Return a box about all glass, and the image plane where that is near; None where there is no glass."""
    parts = [part for part in layout.parts if part.kind == "glass"]
    if not parts:
        return None
    low, high = _bounds([line for part in parts for line in part.lines])
    size = float((high - low).max())
    for part in layout.parts:
        near, far = _bounds(part.lines)
        if part.kind == "image" and max(np.max(low - near), np.max(far - high)) < 0.5 * size:
            low, high = np.minimum(low, near), np.maximum(high, far)
    border = 0.1 * float((high - low).max())
    return np.stack([low - border, high + border])


def _bounds(lines: Sequence[Array]) -> tuple[Array, Array]:
    points = np.concatenate(lines)
    return points.min(axis=0), points.max(axis=0)


def _figure(system: OpticalSystem, found: Sequence[Layout], width: float) -> Drawing:
    across = width - 0.15 - _LEFT
    panels = [panel for layout in found for panel in _panels(layout)]
    heights = [panel.height(across) for panel in panels]
    above, below = 0.55, 0.85 + 0.2 * (1 + (len(system.fields) - 1) // 4)
    between = [0.55 if not panel.title else 0.8 for panel in panels[1:]]
    figure = Drawing(figsize=(width, sum(heights) + above + below + sum(between)))
    total, top = figure.get_figheight(), figure.get_figheight() - above
    for panel, height, gap in zip(panels, heights, [*between, 0.0], strict=True):
        axes = figure.add_axes((_LEFT / width, (top - height) / total, across / width, height / total))
        box = widened(panel.box, across / height, panel.stretched)
        draw_section(axes, panel.layout, box, panel.stretched, panel.unnamed)
        axes.set_title(panel.title)
        top -= height + gap
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


def widened(box: Array, ratio: float, stretched: float = 1.0) -> Array:
    """Return a box about the same middle whose width is `ratio` times its height, which is stretched."""
    width, height = np.ptp(box, axis=0)
    ratio = ratio * stretched
    half = np.array([max(width, ratio * height), max(height, width / ratio)]) / 2.0
    return np.asarray(box.mean(axis=0) + np.stack([-half, half]))


def draw_section(
    axes: Axes,
    layout: Layout,
    box: Array | None = None,
    stretched: float = 1.0,
    unnamed: Array | None = None,
) -> None:
    """Draw a layout on axes, which get its scale.

    Of the layout is shown what is in a box (2, 2), mm, heights so many times as large; glass in the box
    `unnamed` gets a frame instead of names.
    """
    low, high = box_of(layout) if box is None else box
    meters = float((high - low).max()) > _METERS
    unit, scale = ("m", 1e-3) if meters else ("mm", 1.0)
    axes.set_xlim(scale * low[0], scale * high[0])
    axes.set_ylim(scale * low[1], scale * high[1])
    axes.set_aspect(stretched)
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
    if unnamed is None:
        _label(axes, layout.parts, scale)
        return
    corner, size = scale * unnamed[0], scale * np.ptp(unnamed, axis=0)
    axes.add_patch(Rectangle(corner, *size, facecolor="none", edgecolor="#888888", lw=0.8, ls=":", zorder=5))
    _label(axes, [part for part in layout.parts if part.kind != "glass"], scale)


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
        seen = [Bbox(axes.transData.transform(scale * np.stack(_bounds([line])))) for line in part.lines]
        there = [cut for one in seen if (cut := Bbox.intersection(one, frame)) is not None]
        if not there:
            continue
        box = Bbox.union(there)
        fills = box.height > _FILLS * frame.height
        name = as_name(part.name)
        text = axes.text(0, 0, name, fontsize=8.5, color=_DARK, ha="center", va="center", zorder=6)
        text.set_bbox(HALO)
        size = text.get_window_extent()
        for right, up in _AROUND:
            middle = (
                (box.x0 + box.x1) / 2 + right * ((box.width + size.width) / 2 + 4),
                (box.y0 + box.y1) / 2 + np.sign(up) * (box.height / 2 + (abs(up) - 0.5) * size.height + 3),
            )
            if fills:  # there is no room but on it
                middle = (middle[0], frame.y1 - (0.5 + abs(up)) * size.height)
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
