"""How far numbers are from what they converge to, from the same numbers computed ever finer."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

Array = NDArray[np.float64]

_LEAST, _MOST = 0.25, 8.0  # orders of convergence that are believed
_EQUAL = 1e-13  # share of the values by which equal ones may differ


@dataclass(frozen=True)
class Refined:
    """The error of numbers by one origin.

    Attributes
    ----------
    error : float
        Rms over the cases of the numbers minus what they converge to, in their unit.
    order : float
        With which power of the counts it falls; NaN where two steps do not say.
    settled : bool
        Whether the steps converge; if not, the error is the largest difference of two of them.
    """

    error: float
    order: float
    settled: bool


def refinement_error(counts: Sequence[float], values: Array, base: int = 0) -> Refined:
    """Return the error of the numbers at ``counts[base]``.

    Parameters
    ----------
    counts : sequence of float, length k
        How fine each step is, increasing (rays, terms); the last of two steps counts as exact, and so does
        an infinite one.
    values : ndarray, shape (k, n)
        The numbers of n cases at each step.
    base : int

    Notes
    -----
    Three steps give the order p of C / count^p, by the rms over the cases of their differences; what is left
    of it after the last step is added to each case (Richardson 1911; Roache 1998).
    """
    if len(counts) < 3 or np.isinf(counts[-1]):
        return Refined(_rms(values[base] - values[-1]), np.nan, True)
    first, second = _rms(values[0] - values[1]), _rms(values[1] - values[2])
    noise = _EQUAL * _rms(values)
    if second <= noise:
        return Refined(_rms(values[base] - values[2]), np.nan, True)
    order = _order(counts, first / second)
    if order is None:
        spread = max(_rms(one - other) for one in values for other in values)
        return Refined(spread, np.nan, False)
    powers = np.asarray(counts, dtype=np.float64)[:3] ** -order
    left = (values[1] - values[2]) / (powers[1] - powers[2]) * powers[2]
    return Refined(_rms(values[base] - values[2] + left), order, True)


def _order(counts: Sequence[float], ratio: float) -> float | None:
    """Return p for which C / count^p has differences of this ratio; None if it does not converge."""
    logs = np.log(np.asarray(counts, dtype=np.float64)[:3] / counts[0])

    def lacks(order: float) -> float:
        one, two, three = np.exp(-order * logs)
        return float(np.log((one - two) / (two - three)) - np.log(ratio))

    if lacks(_LEAST) > 0.0:
        return None
    return _MOST if lacks(_MOST) < 0.0 else float(brentq(lacks, _LEAST, _MOST))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
