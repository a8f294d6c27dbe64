"""Quantiles with confidence intervals: distribution-free of independent draws, else of replicated sets."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from math import isinf

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

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
    lower = int(np.count_nonzero(scipy.special.bdtr(k, draws, probability) <= tail))
    upper = int(np.count_nonzero(scipy.special.bdtrc(k, draws, probability) > tail)) + 1
    return lower, upper


def quantile(
    values: NDArray[np.float64],
    probability: float,
    draws: int | None = None,
    sets: NDArray[np.int64] | None = None,
) -> Quantile:
    """Return a sample quantile with its 95 % confidence interval.

    Of independent draws it is distribution-free. Where the draws are points of a few sets that are stratified
    (Latin hypercubes, Sobol points), only the sets are independent: then the scatter between the sets' shares
    below the quantile gives the error of the share, and the interval ends at the quantiles of the share plus
    and minus its error (Woodruff 1952).

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
    sets : ndarray of int, shape (draws,), optional
        The set that each draw belongs to, in the order of the values.

    Returns
    -------
    Quantile
        The value interpolates linearly between order statistics, within the interval; all NaN if there are
        no values.

    References
    ----------
    Woodruff 1952, Confidence intervals for medians and other position measures, JASA 47:635.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=None)
    if not ordered.size:
        return Quantile(np.nan, np.nan, np.nan)
    value = interpolated(ordered, ordered.size, probability)
    if sets is None:
        low, high = bounds(ordered.size, ordered.size if draws is None else draws, probability)
    else:
        half = float(share_error(np.asarray(values), sets, np.array([value]))[0])
        low, high = bounds_of_share(ordered.size, probability, half)
    return bounded(
        value,
        -np.inf if low is None else float(ordered[low]),
        np.inf if high is None else float(ordered[high]),
    )


def bounded(value: float, low: float, high: float) -> Quantile:
    """Return a quantile whose value is in its interval: few values may all be surely below it, or above."""
    return Quantile(min(max(value, low), high), low, high)


def bounds(count: int, draws: int, probability: float) -> tuple[int | None, int | None]:
    """Return the places of the interval's ends among `count` sorted values of independent draws, from 0."""
    share = count / draws
    lower, upper = quantile_ranks(draws, probability)
    low = int(np.floor((lower - 1) * share)) if lower >= 1 else None
    return low, int(np.ceil(upper * share)) - 1 if upper <= draws else None


def bounds_of_share(count: int, probability: float, half: float) -> tuple[int | None, int | None]:
    """Return the places of the interval's ends where a share of `count` sorted values is known to +- half."""
    half = max(half, 1.0 / count)  # nothing is known better than to one value
    below, above = count * (probability - half), count * (probability + half)
    return int(np.ceil(below)) - 1 if below > 0.0 else None, int(np.floor(above)) if above < count else None


def share_error(
    values: NDArray[np.float64],
    sets: NDArray[np.int64],
    levels: NDArray[np.float64],
    confidence: float = CONFIDENCE,
) -> NDArray[np.float64]:
    """Return half the confidence interval (Student) of the shares of values up to some levels.

    From the scatter between sets, which are independent while their draws are not.

    Parameters
    ----------
    values : ndarray, any shape
    sets : ndarray of int, shape (draws,)
        The set of each draw; it stands for ``values.size / draws`` values in a row.
    levels : ndarray, shape (n,)

    Returns
    -------
    ndarray, shape (n,)
        Infinite where there are fewer than two sets.
    """
    each = np.repeat(sets, values.size // len(sets))
    parts = [np.sort(np.reshape(values, -1)[each == one]) for one in np.unique(each)]
    if len(parts) < 2:
        return np.full(len(levels), np.inf)
    counts = np.array([np.searchsorted(part, levels, side="right") for part in parts])
    return error_of_shares(counts, np.array([part.size for part in parts]), confidence)


def error_of_shares(
    counts: NDArray[np.int64], sizes: NDArray[np.int64], confidence: float = CONFIDENCE
) -> NDArray[np.float64]:
    """Return what :func:`share_error` does, of counts (sets, n) up to levels; there are two sets or more."""
    sizes = sizes[:, None]
    # Sets may differ in size by failed cases: the error of a ratio of two sums, to first order.
    apart = counts - counts.sum(axis=0) * (sizes / sizes.sum())
    error = apart.std(axis=0, ddof=1) * np.sqrt(len(counts)) / sizes.sum()
    return np.asarray(scipy.special.stdtrit(len(counts) - 1, 0.5 + confidence / 2.0) * error)


def neighbors(count: int, probability: float) -> tuple[int, int]:
    """Return the places among `count` sorted values between which a quantile lies, from 0."""
    position = (count - 1) * probability
    return int(np.floor(position)), int(np.ceil(position))


def interpolated(ordered: NDArray[np.float64] | Mapping[int, float], count: int, probability: float) -> float:
    """Return a quantile of `count` sorted values, of which at least its neighbors are given by place.

    It is NaN between -inf and inf.
    """
    share = (count - 1) * probability % 1.0
    # Python's floats: NumPy's warn where infinities cancel.
    below, above = (float(ordered[place]) for place in neighbors(count, probability))
    if below == above:  # two infinite ones must not give inf - inf
        return below
    if isinf(above - below):  # one is infinite, or their difference overflows
        return (1.0 - share) * below + share * above
    return below + share * (above - below)
