"""What the folded transform takes as pupils: numbers cell by cell, of lit cells alone, or smooth phases."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]


@dataclass(frozen=True)
class Rim:
    """Light that is not centered in its cell, so that it has a phase of its own.

    Attributes
    ----------
    cells : ndarray of int, shape (R,)
        Index in the flat grid; a cell may come several times.
    light : ndarray, shape (R,)
        Amplitudes.
    """

    cells: NDArray[np.intp]
    light: Real


@dataclass(frozen=True)
class SmoothPhase:
    """Phases (rad) of pupils as polynomials.

    Attributes
    ----------
    coefficients : ndarray, shape (batch, K, K)
        Of the Chebyshev polynomials T_l(y) T_k(x); x and y run from -1 to 1 between the edges of the grid.
    rim : ndarray, shape (batch, R)
        At the light of a `Rim`.
    """

    coefficients: Real
    rim: Real


@dataclass(frozen=True)
class LitPhase:
    """Phases (rad) of pupils where light falls, which in each half of a row are one piece.

    Attributes
    ----------
    values : ndarray, shape (batch, m)
        Row after row.
    starts : ndarray of int32, shape (n, 2)
        Of the left and the right half of each row: what is added to a column gives the place in `values`.
    """

    values: Real
    starts: NDArray[np.int32]


Pupils = NDArray[Any] | LitPhase | SmoothPhase


def count_of(pupils: Pupils) -> int:
    """Return how many pupils there are."""
    if isinstance(pupils, LitPhase):
        return len(pupils.values)
    return len(pupils.coefficients) if isinstance(pupils, SmoothPhase) else len(pupils)


def part_of(pupils: Pupils, part: slice) -> Pupils:
    """Return some of the pupils."""
    if isinstance(pupils, SmoothPhase):
        return SmoothPhase(pupils.coefficients[part], pupils.rim[part])
    if isinstance(pupils, LitPhase):
        return LitPhase(pupils.values[part], pupils.starts)
    return pupils[part]


def rim_places(rim: Rim, samples: int) -> tuple[NDArray[np.intp], NDArray[np.int32], Real]:
    """Return the order of a rim's light, its places, and what it adds to the parts of folded rows."""
    row, column = np.divmod(rim.cells, samples)
    below, left = row < samples // 2, column < samples // 2
    rows = np.where(below, samples - 1 - row, row) - samples // 2
    columns = np.where(left, samples - 1 - column, column) - samples // 2
    # The middle of an odd number of cells is its own mirror image: it comes twice, or not at all.
    middle_x, middle_y = (samples % 2 * (place == samples // 2) for place in (column, row))
    even_x, even_y = 1.0 + middle_x, 1.0 + middle_y
    odd_x, odd_y = (1.0 - middle_x) * np.where(left, -1, 1), (1.0 - middle_y) * np.where(below, -1, 1)
    shares = rim.light * np.array([even_x * even_y, even_x * odd_y, odd_x * even_y, odd_x * odd_y])
    order = np.lexsort((columns, rows))
    starts = np.searchsorted(rows[order], np.arange((samples + 1) // 2 + 1))
    places = np.concatenate([starts, columns[order]]).astype(np.int32)
    return order, places, np.ascontiguousarray(shares.T[order])


def lit_columns(amplitude: NDArray[np.float64], rim: Rim) -> NDArray[np.int32]:
    """Return the first lit column right of the middle, and one past the last, of the upper half's rows."""
    samples = len(amplitude)
    lit = amplitude != 0.0
    lit.flat[rim.cells] = True
    lit = lit | lit[::-1]
    lit = (lit | lit[:, ::-1])[samples // 2 :, samples // 2 :]
    first, last = lit.argmax(axis=1), lit.shape[1] - lit[:, ::-1].argmax(axis=1)
    return np.stack([first, np.where(lit.any(axis=1), last, first)], axis=1).astype(np.int32)
