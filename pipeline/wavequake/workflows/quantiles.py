"""Quantiles of independent draws with distribution-free confidence intervals."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr, bdtrc

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Quantile:
    """A sample quantile and its confidence interval; a bound that too few draws do not give is infinite."""

    value: float
    low: float
    high: float


@lru_cache(maxsize=64)
def quantile_ranks(draws: int, probability: float, confidence: float = CONFIDENCE) -> tuple[int, int]:
    """Return the ranks of the order statistics that hold a quantile with at least the given confidence.

    The number of draws below the quantile is binomial, whatever the distribution, so the ranks are exact;
    each tail holds at most half of the error. Rank 1 is the smallest draw; rank 0 and rank ``draws + 1`` mean
    that there is no such bound.

    References
    ----------
    David & Nagaraja 2003, Order Statistics, 3rd ed., section 7.1.
    """
    tail = (1.0 - confidence) / 2.0
    k = np.arange(draws)
    lower = int(np.count_nonzero(bdtr(k, draws, probability) <= tail))
    upper = int(np.count_nonzero(bdtrc(k, draws, probability) > tail)) + 1
    return lower, upper


def quantile(values: NDArray[np.float64], probability: float, draws: int | None = None) -> Quantile:
    """Return a sample quantile with its distribution-free 95 % confidence interval.

    Parameters
    ----------
    values : ndarray, any shape
        Samples; +inf is allowed (a radius beyond the frame), NaN is not.
    probability : float
        Between 0 and 1.
    draws : int, optional
        Number of independent draws if it is smaller than the number of values: the cases whose instants are
        pooled here. Each draw then stands for ``values.size / draws`` values in a row, as if all instants of
        a case were equal.

    Returns
    -------
    Quantile
        The value interpolates linearly between order statistics; all NaN if there are no values.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=None)
    if not ordered.size:
        return Quantile(np.nan, np.nan, np.nan)
    draws = ordered.size if draws is None else draws
    share = ordered.size / draws
    lower, upper = quantile_ranks(draws, probability)
    low = ordered[int(np.floor((lower - 1) * share))] if lower >= 1 else -np.inf
    high = ordered[int(np.ceil(upper * share)) - 1] if upper <= draws else np.inf
    return Quantile(_interpolated(ordered, probability), float(low), float(high))


def _interpolated(ordered: NDArray[np.float64], probability: float) -> float:
    position = (ordered.size - 1) * probability
    below, above = ordered[int(np.floor(position))], ordered[int(np.ceil(position))]
    # Equal neighbors first: two infinite ones must not give inf - inf.
    return float(below if below == above else below + (position % 1.0) * (above - below))
