"""Ticks that are drawn at once stand where those of matplotlib do, and say the same."""

import re
from io import StringIO
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from wavequake.drawing.style import STYLE, show_names, stacked, svg_text
from wavequake.drawing.ticks import draw_ticks_at_once, in_inches

_SVG = "{http://www.w3.org/2000/svg}"


def drawn(quick, limits, right=False, log=False, grid=False, inches=False):
    """Return a figure with one set of axes as SVG: our ticks, or matplotlib's."""
    with rc_context(STYLE):
        figure = Figure(figsize=(4, 3))
        if quick and inches:
            axes = in_inches(figure, 0.8, 0.75, 2.4, 1.8)
        else:
            axes = figure.add_axes((0.2, 0.25, 0.6, 0.6))
        axes.set(xlim=limits[0], ylim=limits[1], xlabel="time (s)", ylabel="height (m)")
        if right:
            axes.yaxis.tick_right()
            axes.yaxis.set_label_position("right")
        else:
            axes.yaxis.set_label_coords(-0.2, 0.5)
        if log:
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(lambda value, place: f"{value:g}")
            axes.yaxis.set_minor_formatter(NullFormatter())
        if grid:
            axes.grid(color="#dddddd", lw=0.6)
        if quick and not inches:
            draw_ticks_at_once(axes)
        return ElementTree.fromstring(svg_text(figure))


def words(svg):
    """Return all texts with where they are held, sorted."""
    found = []
    for text in svg.iter(f"{_SVG}text"):
        if text.get("x") is not None:
            place = float(text.get("x")), float(text.get("y"))
        else:
            place = tuple(
                map(float, re.findall(r"translate\(([-\d.]+) ([-\d.]+)\)", text.get("transform"))[0])
            )
        (align,) = re.findall(r"text-anchor: (\w+)", text.get("style")) or ["none"]
        found.append((text.text, align, *place))
    return sorted(found)


def segments(svg):
    """Return the ends of all straight lines of two points, markers in place."""
    marks = {path.get("id"): path.get("d") for path in svg.iter(f"{_SVG}path") if path.get("id")}

    def numbers(line):
        return [tuple(map(float, pair)) for pair in re.findall(r"[ML] ([-\d.]+) ([-\d.]+)", line)]

    ends = []
    for used in svg.iter(f"{_SVG}use"):
        name = used.get("{http://www.w3.org/1999/xlink}href").lstrip("#")
        shift = np.array([float(used.get("x")), float(used.get("y"))])
        ends += [np.array(pair) + shift for pair in zip(*[iter(numbers(marks[name]))] * 2, strict=True)]
    for path in svg.iter(f"{_SVG}path"):
        line = path.get("d", "")
        points = numbers(line)
        if not path.get("id") and "Z" not in line.upper() and len(points) % 2 == 0:
            ends += [np.array(pair) for pair in zip(points[::2], points[1::2], strict=True)]
    return np.array(sorted(sorted(map(tuple, one)) for one in np.round(ends, 2).tolist()))


@pytest.mark.parametrize(
    ("limits", "options"),
    [
        (((-15.3, 15.3), (-15.3, 15.3)), {}),
        (((0.0, 1.0), (3.0, 7.5)), {"right": True}),
        (((0.0, 0.5), (0.0, 2e-6)), {}),
        (((0.0, 3e7), (0.0, 1.0)), {"grid": True}),
        (((5.0, -5.0), (1e-5, 1.0)), {"log": True}),
        (((0.0, 3e7), (0.0, 1.0)), {"grid": True, "inches": True}),
        (((5.0, -5.0), (1e-5, 1.0)), {"log": True, "inches": True}),
    ],
)
def test_ticks_stand_where_matplotlib_puts_them_and_say_the_same(limits, options):
    ours, theirs = (drawn(quick, limits, **options) for quick in (True, False))
    said, expected = words(ours), words(theirs)
    assert [one[0] for one in said] == [one[0] for one in expected]
    aligned = [(one, other) for one, other in zip(said, expected, strict=True) if other[1] != "none"]
    assert all(one[1] == other[1] for one, other in aligned)
    np.testing.assert_allclose([one[2:] for one in said], [one[2:] for one in expected], rtol=0, atol=1.1)
    np.testing.assert_allclose(segments(ours), segments(theirs), rtol=0, atol=0.02)


def test_a_figure_is_laid_out_as_matplotlib_saves_it():
    """The same bytes; matplotlib draws all of the figure once more, for nothing but its layout."""

    def made():
        figure, (above, below) = stacked()
        above.semilogy([1.0, 2.0, 3.0], [1e-3, 1.0, 1e7], label="curve")
        below.set(xlabel="time (s)", ylabel="a long name of what is shown (nm)", title="below")
        figure.colorbar(below.imshow([[0.0, 1.0], [2.0, 3.0]]), ax=below, label="scale")
        figure.legend(loc="outside upper center")
        show_names(figure)
        return figure

    saved = StringIO()
    with rc_context(STYLE):
        found, other = svg_text(made()), made()
        other.savefig(saved, format="svg", dpi=150, metadata={"Date": None})
    assert found == saved.getvalue()
