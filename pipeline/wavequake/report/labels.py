"""Hundreds of short labels in a figure, drawn ten times as fast as texts that are laid out one by one."""

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backend_bases import RendererBase
from matplotlib.font_manager import FontProperties
from matplotlib.text import Text
from numpy.typing import NDArray

from wavequake.words import printable

_HALF_DIGIT = 0.365  # of the size: half the height of the digits of DejaVu Sans


class Labels(Artist):
    """Words of one size, centered at points of the data, each of its own color.

    Parameters
    ----------
    words : sequence of str
    points : ndarray, shape (n, 2)
    colors : sequence of str
    size : float
        In points.
    """

    zorder = Text.zorder  # above faces

    def __init__(
        self, words: Sequence[str], points: NDArray[np.float64], colors: Sequence[str], size: float
    ) -> None:
        super().__init__()
        self.words, self.points = tuple(map(printable, words)), points
        self.colors, self.size = tuple(colors), size

    def draw(self, renderer: RendererBase) -> None:
        """Draw each word about its point; the width of one is the sum of those of its letters."""
        if not self.get_visible() or self.axes is None:
            return
        font = FontProperties(size=self.size)
        wide = {
            letter: renderer.get_text_width_height_descent(letter, font, False)[0]
            for letter in set("".join(self.words))
        }
        drop = _HALF_DIGIT * float(np.asarray(renderer.points_to_pixels(self.size)))
        _, height = renderer.get_canvas_width_height()
        anchor = Text(ha="center")  # tells files of text, as SVG, that words are centered
        gc = renderer.new_gc()
        for word, (x, y), color in zip(
            self.words, self.axes.transData.transform(self.points).tolist(), self.colors, strict=True
        ):
            anchor.set_position((x, y))
            gc.set_foreground(color)
            left, base = x - 0.5 * sum(wide[letter] for letter in word), y - drop
            below = height - base if renderer.flipy() else base
            renderer.draw_text(gc, left, below, word, font, 0.0, mtext=anchor)
        gc.restore()
