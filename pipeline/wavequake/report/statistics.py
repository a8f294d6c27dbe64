"""Quantiles and distributions that carry their uncertainty, and jitter, of a population of independent cases.

Nothing here assumes a distribution. Cases are independent draws; the instants of one case are not, so what
pools instants counts each case as one draw, which can only make an interval too wide.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr, bdtrc, betaincinv

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Quantile:
    """A sample quantile and its confidence interval; a bound that too few draws do not give is infinite."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Distribution:
    """An empirical distribution: P(X <= values) = probability, each within low..high with 95 % confidence."""

    values: NDArray[np.float64]
    probability: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


@dataclass(frozen=True)
class Jitter:
    """Standard deviation of the line of sight about the mean of its population.

    Attributes
    ----------
    axis : ndarray, shape (2,)
        Along x and y, in the unit of the line of sight.
    radial : float
        sqrt(x^2 + y^2) of `axis`.
    standard_error : float
        Of `radial`, from the scatter between cases; NaN for fewer than two cases.
    """

    axis: NDArray[np.float64]
    radial: float
    standard_error: float


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


def distribution(values: NDArray[np.float64], draws: int | None = None, points: int = 200) -> Distribution:
    """Return the empirical distribution function with a pointwise 95 % band (Clopper & Pearson 1934).

    Parameters
    ----------
    values : ndarray, any shape
        Samples without NaN.
    draws : int, optional
        Number of independent draws, as in :func:`quantile`. The share of successes among pooled instants is a
        mean of `draws` independent shares in [0, 1] and varies less than a binomial one of `draws` trials
        (Hoeffding 1963).
    points : int
        At most so many steps are kept, evenly in rank; the first and the last always are.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=None)
    draws = ordered.size if draws is None else draws
    ranks = np.unique(np.linspace(1, ordered.size, min(points, ordered.size)).round().astype(np.int64))
    probability = ranks / max(ordered.size, 1)
    successes = probability * draws
    tail = (1.0 - CONFIDENCE) / 2.0
    # Both ends of the beta function's parameters are excluded: no success has low = 0, no failure has high =
    # 1.
    failures = np.maximum(draws - successes, 1e-300)
    low = betaincinv(successes, draws - successes + 1.0, tail)
    high = np.where(successes < draws, betaincinv(successes + 1.0, failures, 1.0 - tail), 1.0)
    return Distribution(ordered[ranks - 1], probability, low, high)


def case_rms(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rms over the instants of each case: (case, time) -> (case,); no cases give no rms."""
    if not values.size:
        return np.empty(len(values))
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=1)))


def jitter(los: NDArray[np.float64]) -> Jitter:
    """Return the rms of the line of sight over cases and instants about one mean per axis.

    The mean that is removed is that of the whole population, over its cases *and* instants: what all of them
    share is a pointing offset, while what differs from case to case stays in the jitter, as does everything
    slower than a case.

    Parameters
    ----------
    los : ndarray, shape (case, time, 2)
    """
    if not los.size:
        return Jitter(np.full(2, np.nan), np.nan, np.nan)
    squares = np.square(los - los.mean(axis=(0, 1)))
    axis = np.sqrt(squares.mean(axis=(0, 1)))
    radial = float(np.hypot(*axis))
    # First order: the error of sqrt(mean) is that of the mean over twice the root. Cases are the independent
    # draws.
    per_case = squares.sum(axis=2).mean(axis=1)
    if per_case.size < 2:
        return Jitter(axis, radial, np.nan)
    error = per_case.std(ddof=1) / np.sqrt(per_case.size)
    return Jitter(axis, radial, float(error / (2.0 * radial)) if radial > 0 else 0.0)
