"""Hundreds of short words in a figure, drawn ten times as fast as texts that are laid out one by one."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backend_bases import RendererBase
from matplotlib.colors import to_hex
from matplotlib.font_manager import FontProperties
from matplotlib.text import Text
from matplotlib.textpath import text_to_path
from numpy.typing import NDArray

from wavequake.words import printable

HALF_DIGIT = 0.365  # of the size: half the height of the digits of DejaVu Sans
Align = Literal["left", "center", "right"]
_ANCHORS: dict[Align, str] = {"left": "start", "center": "middle", "right": "end"}  # of SVG
_FAMILY = "DejaVu Sans"
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
    _, height = renderer.get_canvas_width_height()
    if (writer := getattr(renderer, "writer", None)) is not None:
        style = (
            f"font-size: {size:.6g}px; font-family: '{_FAMILY}', sans-serif; text-anchor: {_ANCHORS[align]}"
        )
        for word, (x, y), color in zip(words, points.tolist(), colors, strict=True):
            place = {"x": f"{x:.4f}", "y": f"{height - y:.4f}"}
            writer.element("text", word, {"style": f"{style}; fill: {_hexadecimal(color)}", **place})
        return max((sum(_width(letter, size) for letter in word) for word in words), default=0.0)
    font = FontProperties(size=size)
    wide = {
        letter: renderer.get_text_width_height_descent(letter, font, False)[0]
        for letter in set("".join(words))
    }
    widths = [sum(wide[letter] for letter in word) for word in words]
    gc = renderer.new_gc()
    for word, width, (x, y), color in zip(words, widths, points.tolist(), colors, strict=True):
        gc.set_foreground(color)
        left = x - _SHARES[align] * width
        renderer.draw_text(gc, left, height - y if renderer.flipy() else y, word, font, 0.0)
    gc.restore()
    return float(max(widths, default=0.0))


@lru_cache(maxsize=1000)
def _width(letter: str, size: float) -> float:
    """Return the width of a letter in an SVG, in points, each of which is a pixel of its own."""
    font = FontProperties(family=_FAMILY, size=size)
    return float(text_to_path.get_text_width_height_descent(letter, font, False)[0])


@lru_cache(maxsize=100)
def _hexadecimal(color: Any) -> str:
    return to_hex(color)
