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
