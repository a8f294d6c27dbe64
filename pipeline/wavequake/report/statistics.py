"""Quantiles and distributions that carry their uncertainty, and jitter, of a population of independent cases.

Nothing here assumes a distribution. Cases are independent draws; the instants of one case are not, so what
pools instants counts each case as one draw, which can only make an interval too wide. Where cases are points
of sets that are stratified, `sets` says to which each belongs, and only the sets are independent draws.
"""

from dataclasses import dataclass

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake.campaign.statistics.quantiles import (
    CONFIDENCE,
    Quantile,
    quantile,
    quantile_ranks,
    share_error,
)

__all__ = [
    "FEWEST",
    "Distribution",
    "Jitter",
    "Quantile",
    "case_rms",
    "distribution",
    "jitter_of_cases",
    "quantile",
    "quantile_ranks",
]

# Cases below which there is no 5 % of them.
FEWEST = 20


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
        Of `radial`, from the scatter between cases; NaN for fewer than three cases.

    All are NaN of a single case that stands still.
    """

    axis: NDArray[np.float64]
    radial: float
    standard_error: float


def distribution(
    values: NDArray[np.float64],
    draws: int | None = None,
    points: int = 200,
    sets: NDArray[np.int64] | None = None,
) -> Distribution:
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
    sets : ndarray of int, optional
        As in :func:`quantile`; then the band is that of the scatter between sets.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64), axis=None)
    draws = ordered.size if draws is None else draws
    ranks = np.unique(np.linspace(1, ordered.size, min(points, ordered.size)).round().astype(np.int64))
    probability = ranks / max(ordered.size, 1)
    if sets is not None:
        at = ordered[ranks - 1]
        half = share_error(np.asarray(values), sets, at)
        low, high = np.clip(probability - half, 0.0, 1.0), np.clip(probability + half, 0.0, 1.0)
        return Distribution(at, probability, low, high)
    successes = probability * draws
    tail = (1.0 - CONFIDENCE) / 2.0
    # Both ends of the beta function's parameters are excluded: no success has low = 0, no failure has high =
    # 1.
    failures = np.maximum(draws - successes, 1e-300)
    low = scipy.special.betaincinv(successes, draws - successes + 1.0, tail)
    high = np.where(successes < draws, scipy.special.betaincinv(successes + 1.0, failures, 1.0 - tail), 1.0)
    return Distribution(ordered[ranks - 1], probability, low, high)


def case_rms(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rms over the instants of each case: (case, time) -> (case,); no cases give no rms."""
    if not values.size:
        return np.empty(len(values))
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=1)))


def jitter_of_cases(
    means: NDArray[np.float64], variances: NDArray[np.float64], sets: NDArray[np.int64] | None = None
) -> Jitter:
    """Return the rms of the line of sight over cases and instants about one mean per axis.

    The mean that is removed is that of the whole population, over its cases *and* instants: what all of them
    share is a pointing offset, while what differs from case to case stays in the jitter, as does everything
    slower than a case. The variance is that of further cases, unbiased: of still ones that with N - 1.

    Parameters
    ----------
    means, variances : ndarray, shape (case, 2)
        Over the instants, as many in each case.
    sets : ndarray of int, shape (case,), optional
        The stratified set that each case belongs to.
    """
    if not means.size:
        return Jitter(np.full(2, np.nan), np.nan, np.nan)
    squares = variances + np.square(means - means.mean(axis=0))
    which = np.arange(len(means)) if sets is None else np.unique(sets, return_inverse=True)[1]
    count = np.bincount(which)
    if count.size == 1 and not squares.any():  # one still case says nothing of others
        return Jitter(np.full(2, np.nan), np.nan, np.nan)
    spread = squares.mean(axis=0)
    if count.size > 1:  # what is drawn has another mean than what is found of so few
        of_mean = np.stack([np.bincount(which, values) / count for values in means.T], axis=1)
        spread = spread + of_mean.var(axis=0, ddof=1) / count.size
    axis = np.sqrt(spread)
    radial = float(np.hypot(*axis))
    # First order: the error of sqrt(mean) is that of the mean over twice the root. Cases are the independent
    # draws.
    per_case = np.bincount(which, squares.sum(axis=1)) / count
    if per_case.size < 2 or len(means) < 3:  # two cases are equally far from their mean
        return Jitter(axis, radial, np.nan)
    error = per_case.std(ddof=1) / np.sqrt(per_case.size)
    return Jitter(axis, radial, float(error / (2.0 * radial)) if radial > 0 else 0.0)
