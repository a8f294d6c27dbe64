"""Ticks of an axis and their numbers, drawn at once: matplotlib makes five artists of each."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis, YAxis
from matplotlib.backend_bases import RendererBase
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.path import Path
from matplotlib.ticker import AutoLocator, FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import IdentityTransform
from numpy.typing import NDArray

from wavequake.drawing.labels import HALF_DIGIT, Align, write

Array = NDArray[np.float64]
_Pixels = Callable[[Array, float], Array]

_LONG, _SHORT, _GAP = 3.5, 2.0, 3.5  # points
_MARGIN = 4.0  # points, between numbers and label
_ASCENT, _LINE = 0.76, 1.0  # of the size, of DejaVu Sans
_ALIGN: dict[str, Align] = {"left": "right", "right": "left"}
_WIDTHS = 0.7, 0.6  # points
_FEW = 0.7, 2.0  # decades: fewer than the first have even ticks, more than the second powers of ten alone


class _Unmade(Axis):
    """An axis that makes no tick of matplotlib's before one is asked for: they take half the time of axes."""

    @contextmanager
    def _without_ticks(self) -> Iterator[None]:
        """Let nothing be done to ticks that are not made: when they are, they are made by what was said."""
        absent = [name for name in ("majorTicks", "minorTicks") if name not in vars(self)]
        for name in absent:
            setattr(self, name, [])
        yield
        for name in absent:
            if not vars(self).get(name, True):
                delattr(self, name)

    def set_tick_params(self, which: Any = "major", reset: bool = False, **parameters: Any) -> None:
        """Say how ticks look."""
        with self._without_ticks():
            super().set_tick_params(which, reset, **parameters)

    def set_clip_path(self, path: Any, transform: Any = None) -> None:
        """Say where ticks are drawn."""
        with self._without_ticks():
            super().set_clip_path(path, transform)


class _UnmadeX(_Unmade, XAxis):
    """The x axis."""

    def get_ticks_position(self) -> Any:
        """Return where the ticks are."""
        return "top" if self.get_tick_params()["top"] else "bottom"


class _UnmadeY(_Unmade, YAxis):
    """The y axis."""

    def get_ticks_position(self) -> Any:
        """Return where the ticks are."""
        return "right" if self.get_tick_params()["right"] else "left"


class BareAxes(Axes):
    """Axes that are quick to make where `Ticks` draw their ticks."""

    def _init_axis(self) -> None:
        self.xaxis, self.yaxis = _UnmadeX(self, clear=False), _UnmadeY(self, clear=False)
        for sides, axis in ((("bottom", "top"), self.xaxis), (("left", "right"), self.yaxis)):
            for side in sides:
                self.spines[side].register_axis(axis)

    def clear(self) -> None:
        """Begin anew; ticks, if there were any, would ask where the frame is, which places it."""
        super().clear()
        for spine in self.spines.values():
            spine.get_position()


def draw_ticks_at_once(axes: Axes) -> None:
    """Draw the ticks of both axes in one piece each, where and as matplotlib would; also grids.

    For numbers without formulas, and labels that have their coordinates.
    """
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_visible(False)
        axes.add_artist(Ticks(axis))


def in_inches(
    figure: Figure, left: float, bottom: float, width: float, height: float, label: float = 0.44
) -> Axes:
    """Add axes placed in inches, the y label `label` left of them: automatic layouts are slow.

    Their ticks are drawn at once.
    """
    across, up = figure.get_size_inches()
    place = left / across, bottom / up, width / across, height / up
    axes = figure.add_axes(place, axes_class=BareAxes)
    axes.yaxis.set_label_coords(-label / width, 0.5)
    draw_ticks_at_once(axes)
    return axes


def label_powers(axis: Axis) -> None:
    """Label a logarithmic axis at powers of ten."""
    axis.set_major_formatter(FuncFormatter(power_of_ten))
    axis.set_minor_formatter(NullFormatter())


def power_of_ten(value: float, place: int | None = None) -> str:
    """Return a power of ten in plain text: parsing formulas takes longer than all the rest of a figure."""
    exponent = f"{np.log10(value):.0f}" if value > 0 else ""
    return "10" + exponent.translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def number_powers(axis: Axis) -> None:
    """Write numbers at a logarithmic axis, whose limits stay, in plain text: powers of ten; or few others."""
    low, high = sorted(axis.get_view_interval())
    decades = float(np.log10(high / low))
    powers = LogLocator(subs=(1.0,) if decades > _FEW[1] else (1.0, 2.0, 5.0))
    axis.set_major_locator(AutoLocator() if decades < _FEW[0] else powers)
    axis.set_major_formatter(FuncFormatter(_power if decades > _FEW[1] else _few_digits))
    axis.set_minor_formatter(NullFormatter())


def _power(value: float, place: int | None = None) -> str:
    """Return a power of ten as such, and what else is on a logarithmic axis in few digits."""
    exponent = np.floor(np.log10(value) + 1e-9) if value > 0 else 0.0
    alone = abs(value / 10.0**exponent - 1.0) < 1e-6
    return power_of_ten(value) if alone else _few_digits(value)


def _few_digits(value: float, place: int | None = None) -> str:
    """Return a number in few digits, such as 100 between 80 and 120."""
    exponent = np.floor(np.log10(value) + 1e-9) if value > 0 else 0.0
    if -4 < exponent < 4:
        return f"{value:.4g}"
    times = value / 10.0**exponent
    power = power_of_ten(10.0**exponent)
    return power if abs(times - 1.0) < 1e-6 else f"{times:.4g}·{power}"


class Ticks(Artist):
    """The ticks, numbers, grid and label of an axis that is not visible itself."""

    zorder = Line2D.zorder + 0.01

    def __init__(self, axis: Axis) -> None:
        super().__init__()
        self.axis = axis

    def draw(self, renderer: RendererBase) -> None:
        """Draw what the axis has now."""
        axis, axes = self.axis, self.axes
        if not self.get_visible() or axes is None:
            return
        across = axis is axes.xaxis
        style = axis.get_tick_params()
        far = style["top" if across else "right"]
        size, color = float(axis.label.get_fontsize()), axes.spines["bottom"].get_edgecolor()
        unit = float(np.asarray(renderer.points_to_pixels(1.0)))
        low, high = axes.bbox.get_points()
        edge, outward = (high, 1.0) if far else (low, -1.0)

        def at(places: Array, out: float) -> Array:
            """Return pixels of places along the axis, so many points outside its edge."""
            along = np.stack([places, places], axis=1)
            pixels = np.asarray(axes.transData.transform(along), dtype=np.float64)
            pixels[:, int(across)] = edge[int(across)] + outward * out * unit
            return pixels

        major, minor = (
            _within(axis, places) for places in (axis.get_majorticklocs(), axis.get_minorticklocs())
        )
        if style["gridOn"]:
            end = (high if not far else low)[int(across)]
            beyond = abs(end - edge[int(across)]) / -unit
            _lines(renderer, at(major, 0.0), at(major, beyond), style["grid_color"], style["grid_lw"] * unit)
        for places, length, width in ((major, _LONG, _WIDTHS[0]), (minor, _SHORT, _WIDTHS[1])):
            _lines(renderer, at(places, 0.0), at(places, length), color, width * unit)
        side = ("top" if far else "bottom") if across else ("right" if far else "left")
        if style["label" + side]:
            self._write_numbers(renderer, side, at, major, size, color)
        axis.label.draw(renderer)

    def _write_numbers(
        self, renderer: RendererBase, side: str, at: _Pixels, major: Array, size: float, color: Any
    ) -> None:
        """Write the numbers, what they all are to be multiplied by, and place the label beyond them."""
        axis, unit = self.axis, float(np.asarray(renderer.points_to_pixels(1.0)))
        form = axis.get_major_formatter()
        words = form.format_ticks(major.tolist())
        points = at(major, _LONG + _GAP + (_ASCENT * size if side == "bottom" else 0.0))
        low, high = axis.axes.bbox.get_points()
        if side == "bottom":
            write(renderer, words, points, [color] * len(words), size)
            below = low[1] - (_LONG + _GAP + _LINE * size + _MARGIN) * unit
            axis.label.set(transform=IdentityTransform(), position=((low[0] + high[0]) / 2.0, below))
            held: Align = "right"
            corner = (high[0], below - _ASCENT * size * unit)
        else:
            points[:, 1] -= HALF_DIGIT * size * unit
            wide = write(renderer, words, points, [color] * len(words), size, _ALIGN[side])
            if side == "right":
                beyond = high[0] + (_LONG + _GAP + _MARGIN) * unit + wide
                axis.label.set(transform=IdentityTransform(), position=(beyond, (low[1] + high[1]) / 2.0))
            corner, held = (low[0], high[1] + _MARGIN * unit), "left"
        if times := form.get_offset():
            write(renderer, [times], np.array([corner]), [color], size, held)


def _within(axis: Axis, places: Any) -> Array:
    """Return the places that are in view; rounding may put the first or the last a little outside."""
    low, high = sorted(axis.get_transform().transform(axis.get_view_interval()))
    found: Array = np.asarray(places, dtype=np.float64)
    ways = axis.get_transform().transform(found)
    slack = 1e-9 * (high - low)
    inside: Array = found[(ways >= low - slack) & (ways <= high + slack)]
    return inside


def _lines(renderer: RendererBase, starts: Array, ends: Array, color: Any, width: float) -> None:
    gc = renderer.new_gc()
    gc.set_foreground(color)
    gc.set_linewidth(width)
    points = np.stack([starts, ends], axis=1).reshape(-1, 2)
    codes = np.tile([Path.MOVETO, Path.LINETO], len(starts))
    renderer.draw_path(gc, Path(points, codes), IdentityTransform())
    gc.restore()
