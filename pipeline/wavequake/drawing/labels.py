"""Hundreds of short words in a figure, drawn ten times as fast as texts that are laid out one by one."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backend_bases import RendererBase
from matplotlib.font_manager import FontProperties
from matplotlib.text import Text
from numpy.typing import NDArray

from wavequake.words import printable

HALF_DIGIT = 0.365  # of the size: half the height of the digits of DejaVu Sans
Align = Literal["left", "center", "right"]
_SHARES: dict[Align, float] = {"left": 0.0, "center": 0.5, "right": 1.0}


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
        self.words, self.points = tuple(words), points
        self.colors, self.size = tuple(colors), size

    def draw(self, renderer: RendererBase) -> None:
        """Draw each word about its point."""
        if not self.get_visible() or self.axes is None:
            return
        points = self.axes.transData.transform(self.points)
        points[:, 1] -= HALF_DIGIT * float(np.asarray(renderer.points_to_pixels(self.size)))
        write(renderer, self.words, points, self.colors, self.size)


def write(
    renderer: RendererBase,
    words: Sequence[str],
    points: NDArray[np.float64],
    colors: Sequence[str],
    size: float,
    align: Align = "center",
) -> float:
    """Write words with their base lines at `points` (n, 2), pixels; return the width of the widest, pixels.

    Pixels count from the lower left corner; the width of a word is the sum of those of its letters.
    """
    words = tuple(map(printable, words))
    font = FontProperties(size=size)
    wide = {
        letter: renderer.get_text_width_height_descent(letter, font, False)[0]
        for letter in set("".join(words))
    }
    _, height = renderer.get_canvas_width_height()
    widths = [sum(wide[letter] for letter in word) for word in words]
    anchor = Text(ha=align)  # tells files of text, as SVG, where words are held
    gc = renderer.new_gc()
    for word, width, (x, y), color in zip(words, widths, points.tolist(), colors, strict=True):
        anchor.set_position((x, y))
        gc.set_foreground(color)
        left = x - _SHARES[align] * width
        renderer.draw_text(gc, left, height - y if renderer.flipy() else y, word, font, 0.0, mtext=anchor)
    gc.restore()
    return float(max(widths, default=0.0))
