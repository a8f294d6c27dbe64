"""Polygons, axes without ticks and matplotlib without help, against matplotlib as it is."""

import re
import subprocess
import sys

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from wavequake.drawing.faces import Faces
from wavequake.drawing.style import svg_text
from wavequake.drawing.ticks import BareAxes

CORNERS = np.random.default_rng(5).uniform(0.1, 0.9, (7, 6, 2))
COLORS = np.random.default_rng(6).uniform(0.0, 1.0, (7, 4)) * [1, 1, 1, 0] + [0, 0, 0, 1]


def drawn(collection: PolyCollection) -> tuple[np.ndarray, list[str], list[str]]:
    """Return corners, faces and edges in an SVG."""
    figure = Figure(figsize=(4, 3))
    figure.add_axes((0.1, 0.1, 0.8, 0.8)).add_collection(collection)
    text = svg_text(figure)
    paths = [one for one in re.findall(r"<path[^>]*>", text) if 'style="fill: #' in one and "0.25" in one]
    corners = [np.array(re.findall(r"[ML] ([\d.]+) ([\d.]+)", one), dtype=float) for one in paths]
    faces, edges = ([re.findall(rf"{key}: (#\w+)", one)[0] for one in paths] for key in ("fill", "stroke"))
    return np.array([one[:6] for one in corners]), faces, edges


def test_polygons_are_those_of_matplotlib():
    """To a hundredth of a point, in its colors."""
    ours = drawn(Faces(CORNERS, COLORS, "#555555", 0.25))
    theirs = drawn(PolyCollection(list(CORNERS), facecolors=COLORS, edgecolors="#555555", linewidths=0.25))
    assert ours[0].shape == (7, 6, 2)
    np.testing.assert_allclose(ours[0], theirs[0], rtol=0, atol=0.006)
    assert ours[1:] == theirs[1:]


def test_one_color_is_that_of_all():
    """As that of the segments of a telescope at rest."""
    assert drawn(Faces(CORNERS, "#e8eef4", "#55718c", 0.25))[1] == 7 * ["#e8eef4"]


def test_axes_make_ticks_when_they_are_asked_for():
    """As they would be, had they been there when it was said."""
    figure = Figure()
    bare, usual = figure.add_subplot(1, 2, 1, axes_class=BareAxes), figure.add_subplot(1, 2, 2)
    for axes in (bare, usual):
        axes.tick_params(labelsize=3.0, length=7.0, labelbottom=False)
    assert "majorTicks" not in vars(bare.xaxis)
    found = [
        [
            (tick.label1.get_size(), tick.tick1line.get_markersize(), tick.label1.get_visible())
            for axis in (axes.xaxis, axes.yaxis)
            for tick in axis.get_major_ticks()
        ]
        for axes in (bare, usual)
    ]
    assert found[0] == found[1]
    bare.tick_params(labelsize=4.0)
    assert {tick.label1.get_size() for tick in bare.xaxis.get_major_ticks()} == {4.0}


def test_without_help_all_can_be_set():
    """Matplotlib loads, has no text on `set`, and obeys it."""
    code = (
        "from wavequake.drawing.unexplained import leave_help_out; leave_help_out();"
        "from matplotlib.figure import Figure; axes = Figure().add_subplot();"
        "axes.set(xlabel='x', ylim=(1, 3)); assert axes.get_ylim() == (1, 3) and axes.get_xlabel() == 'x';"
        "assert 'Supported properties' not in (type(axes).set.__doc__ or '')"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
