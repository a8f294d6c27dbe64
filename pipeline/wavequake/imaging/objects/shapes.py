"""Objects to image: slits, gratings, bars and a resolution chart, as transmissions between 0 and 1.

A pixel on an edge holds the share of it that is open. Lengths are in any unit, usually that of the image in
wavelengths / diameter; [rows // 2, columns // 2] is the origin and axis 0 is y.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavequake.errors import UserError

Real = NDArray[np.float64]

# Three bars as long as five are wide, as far apart as wide: an element of the USAF 1951 chart.
_BARS, _LENGTH = 3, 5.0
_MOST_SLITS = 10_000


def point(pixels: int) -> Real:
    """Return a pinhole, one pixel at the origin of a square grid."""
    _check_grid((pixels, pixels), 1.0)
    picture = np.zeros((pixels, pixels))
    picture[pixels // 2, pixels // 2] = 1.0
    return picture


def rectangles(shape: tuple[int, int], pitch: float, edges: ArrayLike) -> Real:
    """Return open rectangles, which should not overlap.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    pitch : float
        Distance of the pixels.
    edges : array_like, shape (k, 4)
        Left, right, lower and upper edge of each: x from and to, y from and to.

    Raises
    ------
    UserError
        If the grid is impossible, or an edge is NaN or out of order.
    """
    _check_grid(shape, pitch)
    box = np.asarray(edges, dtype=np.float64)
    if box.size % 4:
        raise UserError(f"rectangles need four edges each, not {box.size} in all")
    box = box.reshape(-1, 4)
    if np.isnan(box).any() or (box[:, 0] > box[:, 1]).any() or (box[:, 2] > box[:, 3]).any():
        raise UserError(
            "a rectangle needs its left edge before the right one and the lower before the upper one"
        )
    rows, columns = shape
    y, x = (
        _covered(length, pitch, box[:, first], box[:, first + 1])
        for length, first in ((rows, 2), (columns, 0))
    )
    return np.asarray(np.minimum(y.T @ x, 1.0))


def slit(shape: tuple[int, int], pitch: float, width: float) -> Real:
    """Return a slit along y, through all rows."""
    return double_slit(shape, pitch, width, 0.0)


def double_slit(shape: tuple[int, int], pitch: float, width: float, distance: float) -> Real:
    """Return two slits along y, their middles `distance` apart; one if that is 0."""
    if not (np.isfinite([width, distance]).all() and width > 0.0 and distance >= 0.0):
        raise UserError(
            f"a slit needs a width above 0 and a distance of at least 0, not {width} and {distance}"
        )
    if 0.0 < distance < width:
        raise UserError(f"slits of width {width:g} overlap at a distance of {distance:g}")
    middles = [0.0] if distance == 0.0 else [-0.5 * distance, 0.5 * distance]
    every = np.inf
    return rectangles(shape, pitch, [[m - 0.5 * width, m + 0.5 * width, -every, every] for m in middles])


def grating(shape: tuple[int, int], pitch: float, period: float, open_share: float = 0.5) -> Real:
    """Return a grating of slits along y, one of which is centered on the origin.

    A frame of a whole number of periods repeats without a seam.
    """
    if not (np.isfinite(period) and period > 0.0 and 0.0 < open_share < 1.0):
        raise UserError(
            f"a grating needs a period above 0 and an open share between 0 and 1, not {period}, {open_share}"
        )
    if shape[1] * pitch > _MOST_SLITS * period:
        raise UserError(
            f"a grating of period {period:g} has more than {_MOST_SLITS} slits in a picture "
            f"{shape[1] * pitch:g} wide; make the period longer"
        )
    reach = int(np.ceil(shape[1] * pitch / period)) + 1
    middles = period * np.arange(-reach, reach + 1)
    half = 0.5 * open_share * period
    edges = [[m - half, m + half, -np.inf, np.inf] for m in middles]
    return rectangles(shape, pitch, edges)


def resolution_chart(shape: tuple[int, int], pitch: float, widths: ArrayLike) -> Real:
    """Return elements of three bars, upright beside lying, side by side by width as on the USAF 1951 chart.

    Parameters
    ----------
    shape, pitch
        As for `rectangles`.
    widths : array_like, shape (k,)
        Widths of the bars, which are as far apart as wide and five times as long.

    Raises
    ------
    UserError
        If a width is not above 0, or the chart does not fit into the picture.
    """
    wide = np.asarray(widths, dtype=np.float64).ravel()
    if not wide.size or not (np.isfinite(wide) & (wide > 0.0)).all():
        raise UserError("the bars of a resolution chart need widths above 0")
    gap = 2.0 * wide.max()
    places = np.concatenate([[0.0], np.cumsum(_LENGTH * wide + gap)])
    total = float(places[-1] - gap)
    height = 2.0 * _LENGTH * wide.max() + gap
    if total > shape[1] * pitch or height > shape[0] * pitch:
        raise UserError(
            f"the chart is {total:g} x {height:g} large, the picture {shape[1] * pitch:g} x "
            f"{shape[0] * pitch:g}: make bars narrower or fewer, or the picture larger"
        )
    edges = []
    for left, width in zip(places[:-1] - 0.5 * total, wide, strict=True):
        for bar in range(_BARS):
            start = 2.0 * bar * width
            along, across = (left + start, left + start + width), (0.5 * gap, 0.5 * gap + _LENGTH * width)
            edges.append([*along, *across])
            edges.append([left, left + _LENGTH * width, -0.5 * gap - start - width, -0.5 * gap - start])
    return rectangles(shape, pitch, edges)


def _check_grid(shape: tuple[int, int], pitch: float) -> None:
    if min(shape) < 1:
        raise UserError(f"a picture needs at least one row and column, not {shape[0]} x {shape[1]}")
    if not (np.isfinite(pitch) and pitch > 0.0):
        raise UserError(f"the distance of pixels must be above 0, not {pitch}")


def _covered(length: int, pitch: float, first: Real, last: Real) -> Real:
    """Share (k, length) of each pixel of an axis that lies between `first` and `last` (k,)."""
    low = ((np.arange(length) - length // 2) - 0.5) * pitch
    inside = np.minimum(last[:, None], low + pitch) - np.maximum(first[:, None], low)
    return np.asarray(np.clip(inside / pitch, 0.0, 1.0))
