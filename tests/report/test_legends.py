"""Names of curves do not lie on them."""

import numpy as np
import pytest

from wavequake.report.exposures.figures import line_of_sight, wavefront_error

TIME = np.linspace(0.0, 100.0, 50)
NAMES = ("off", "rigid-perfect", "elastic-perfect", "rigid/0.5", "elastic-lqg/1.5")


@pytest.mark.parametrize(
    "figure",
    [
        lambda: line_of_sight(
            TIME, {name: np.random.default_rng(1).random((50, 2)) for name in NAMES}, "mas"
        ),
        lambda: wavefront_error(TIME, {name: np.random.default_rng(1).random(50) for name in NAMES}),
    ],
)
def test_legends_of_histories_are_outside(figure):
    drawn = figure()
    drawn.draw_without_rendering()
    (legend,) = [*drawn.legends, *(one.legend_ for one in drawn.axes if one.legend_)]
    box = legend.get_window_extent()
    assert [text.get_text() for text in legend.get_texts()] == list(NAMES)
    assert not any(box.overlaps(axes.get_window_extent()) for axes in drawn.axes)
    assert drawn.bbox.x0 <= box.x0
    assert box.x1 <= drawn.bbox.x1
