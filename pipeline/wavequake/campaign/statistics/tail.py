"""How often a limit is exceeded, and how large rare values are, beyond the cases that were computed.

Peaks over a threshold: what exceeds a high threshold follows the generalized Pareto distribution for almost
every distribution (Pickands 1975). Intervals come from the profile of the likelihood, in which the number of
exceedances is binomial.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize
from scipy.special import betaincinv, boxcox

from wavequake.campaign.statistics.quantiles import CONFIDENCE, Quantile, quantile
from wavequake.errors import UserError
from wavequake.words import counted

Array = NDArray[np.float64]

FEWEST = 50
_SHARE, _LARGEST_SHARE = 0.05, 0.25  # of the cases that are taken as the tail
_TESTED, _SAMPLES = 1000, 39  # exceedances that a test looks at, and samples that it compares them with
_SMALLEST = 1e-30  # probability that counts as none
_STEEPEST = -1.0  # shapes below it have no largest likelihood
_IRREGULAR = -0.5  # shapes below it do not follow the theory of large samples (Smith 1985)


@dataclass(frozen=True)
class Tail:
    """The upper tail of n independent draws.

    Attributes
    ----------
    values : ndarray, shape (n,)
        All draws in ascending order.
    threshold : float
    excesses : ndarray, shape (k,)
        By which k draws exceed the threshold.
    shape, scale : float
        Of the generalized Pareto distribution; negative shapes have a largest value.
    """

    values: Array
    threshold: float
    excesses: Array
    shape: float
    scale: float

    @property
    def rate(self) -> float:
        """Share of the draws above the threshold."""
        return len(self.excesses) / len(self.values)


def fit_tail(values: Array, threshold: float | None = None) -> Tail:
    """Fit the tail of independent draws by maximum likelihood.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Finite.
    threshold : float, optional
        By default what the largest twentieth of the draws exceeds, or the largest 50 if those are more,
        but not more than a quarter.

    Raises
    ------
    UserError
        If a draw is not finite, fewer than 50 exceed the threshold, or those are all equal.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    if not np.isfinite(ordered).all():
        raise UserError(
            f"{np.count_nonzero(~np.isfinite(ordered))} of {ordered.size} values are not finite, and a tail "
            "is fitted to finite ones."
        )
    if threshold is None:
        count = max(int(_SHARE * ordered.size), FEWEST)
        if count > _LARGEST_SHARE * ordered.size:
            raise UserError(
                f"{counted(ordered.size, 'case')} {'is' if ordered.size == 1 else 'are'} too few for a tail: "
                f"take at least {int(np.ceil(FEWEST / _LARGEST_SHARE))}."
            )
        threshold = float(ordered[-count - 1])
    excesses = ordered[ordered > threshold] - threshold
    if len(excesses) < FEWEST:
        raise UserError(
            f"Only {len(excesses)} of {ordered.size} cases exceed {threshold:.6g}, and a tail needs at least "
            f"{FEWEST}; take more cases or a lower threshold."
        )
    if np.ptp(excesses) <= 1e-9 * excesses[-1]:
        raise UserError(f"All {len(excesses)} values above {threshold:.6g} are equal: there is no tail.")
    return Tail(ordered, threshold, excesses, *_fitted(excesses))


def rare_value(tail: Tail, probability: float) -> Quantile:
    """Return what is exceeded with a small probability, with its 95 % confidence interval.

    Below the threshold it is the sample quantile.
    """
    if probability >= tail.rate:
        return quantile(tail.values, 1.0 - probability)
    value = tail.threshold + tail.scale * float(boxcox(tail.rate / probability, tail.shape))
    step = max(value - tail.threshold, tail.scale)

    def lacks(excess: float) -> float:
        return _lack(tail, excess, np.log(probability))

    low = _crossing(lacks, value - tail.threshold, -step, floor=1e-9 * step)
    high = _crossing(lacks, value - tail.threshold, step)
    return Quantile(value, tail.threshold + low, tail.threshold + high)


def exceedance(tail: Tail, limit: float) -> Quantile:
    """Return the probability that a limit is exceeded, with its 95 % confidence interval.

    Below the threshold it is the share of the draws (Clopper & Pearson 1934).
    """
    excess = limit - tail.threshold
    if excess <= 0.0:
        count, above = len(tail.values), int(np.count_nonzero(tail.values > limit))
        low, high = _binomial(above, count)
        return Quantile(above / count, low, high)
    smallest = np.log(_SMALLEST)
    base = 1.0 + tail.shape * excess / tail.scale
    survival = 0.0 if base <= 0.0 else np.exp(-_log_ratio(base, tail.shape, excess / tail.scale))
    value = tail.rate * float(survival)
    start = max(np.log(value), smallest) if value > 0.0 else smallest

    def lacks(log_probability: float) -> float:
        return _lack(tail, excess, log_probability)

    low = _crossing(lacks, start, -1.0, floor=smallest) if start > smallest else smallest
    high = _crossing(lacks, start, 1.0, ceiling=0.0)
    return Quantile(value, 0.0 if low <= smallest else float(np.exp(low)), float(np.exp(high)))


def steadiness(tail: Tail, probability: float) -> Quantile | None:
    """Return :func:`rare_value` by the upper half of the exceedances alone; None if they are too few."""
    half = len(tail.excesses) // 2
    if half < FEWEST or probability >= tail.rate / 2.0:
        return None
    return rare_value(fit_tail(tail.values, float(tail.values[-half - 1])), probability)


def fits(tail: Tail) -> bool:
    """Return whether the exceedances may well be draws of the fitted law.

    It is false of one in forty that are: where the statistic of Anderson and Darling is larger than those of
    39 samples of the fitted law, each with a fit of its own.
    """
    random = np.random.default_rng(0)
    excesses = tail.excesses
    if len(excesses) > _TESTED:
        excesses = np.sort(random.choice(excesses, _TESTED, replace=False))
    mine = _misfit(excesses)
    law = scipy.stats.genpareto(tail.shape, scale=tail.scale)
    return any(_misfit(np.sort(law.rvs(len(excesses), random_state=random))) >= mine for _ in range(_SAMPLES))


def _misfit(excesses: Array) -> float:
    """Return the statistic of Anderson and Darling (1954) of ascending excesses about their own fit."""
    shape, scale = _fitted(excesses)
    law = scipy.stats.genpareto(shape, scale=scale)
    below, above = (np.maximum(part, -700.0) for part in (law.logcdf(excesses), law.logsf(excesses)[::-1]))
    count = len(excesses)
    return -count - float(np.sum((2.0 * np.arange(count) + 1.0) * (below + above))) / count


def _fitted(excesses: Array) -> tuple[float, float]:
    """Return shape and scale of largest likelihood."""
    shape, log_scale = _largest(
        lambda x: _likelihood(excesses, x[0], np.exp(x[1])), [0.1, np.log(excesses.mean())], 1e-9
    )[0]
    return float(shape), float(np.exp(log_scale))


def _likelihood(excesses: Array, shape: float, scale: float) -> float:
    """Return the logarithm of the likelihood of the generalized Pareto distribution."""
    if shape < _STEEPEST or not 0.0 < scale < np.inf:
        return -np.inf
    relative = excesses / scale
    base = 1.0 + shape * relative
    if base[-1] <= 0.0:
        return -np.inf
    return float(-len(excesses) * np.log(scale) - (1.0 + shape) * np.sum(_log_ratio(base, shape, relative)))


def _log_ratio(base: Array | float, shape: float, relative: Array | float) -> Array:
    """Return log(1 + shape z) / shape, which is z where the shape is nothing."""
    return np.asarray(relative if abs(shape) < 1e-8 else np.log(base) / shape)


def _lack(tail: Tail, excess: float, log_probability: float) -> float:
    """Return what the likelihood lacks of its 95 % bound if `excess` is exceeded with a probability.

    The largest likelihood of all tails with that property, over shapes and rates of exceedance; 0 is the
    bound, positive values are outside.
    """
    count, above = len(tail.values), len(tail.excesses)

    def joint(shape: float, log_rate: float, scale: float) -> float:
        if log_rate >= 0.0:
            return -np.inf
        binomial = above * log_rate + (count - above) * np.log1p(-np.exp(log_rate))
        return float(binomial) + _likelihood(tail.excesses, shape, scale)

    def constrained(x: Array | list[float]) -> float:
        ratio = x[1] - log_probability
        if ratio <= 0.0 or abs(x[0] * ratio) > 600.0:
            return -np.inf
        return joint(x[0], x[1], excess / float(boxcox(np.exp(ratio), x[0])))

    log_rate = np.log(tail.rate)
    best = joint(tail.shape, log_rate, tail.scale)
    # The shape of the free fit may be impossible; then longer tails are tried.
    possible = (shape for shape in (tail.shape, 0.0, 0.3) if constrained([shape, log_rate]) > -np.inf)
    shape = next(possible, None)
    found = -np.inf if shape is None else _largest(constrained, [shape, log_rate])[1]
    freedom = 2 if tail.shape < _IRREGULAR else 1  # then twice the lack is less regular: a wider bound
    return best - found - float(scipy.stats.chi2.ppf(CONFIDENCE, freedom)) / 2.0


def _largest(
    function: Callable[[Array], float], start: list[float], tolerance: float = 1e-3
) -> tuple[Array, float]:
    """Return where a function is largest, and its value there."""

    def negative(x: Array) -> float:
        value = function(x)
        return -value if np.isfinite(value) else 1e300

    found = minimize(negative, start, method="Nelder-Mead", options={"xatol": tolerance, "fatol": tolerance})
    return np.asarray(found.x), -float(found.fun)


def _crossing(
    function: Callable[[float], float],
    start: float,
    step: float,
    floor: float = -np.inf,
    ceiling: float = np.inf,
) -> float:
    """Return where a function that is negative at the start becomes positive, at most floor or ceiling."""
    inside, outside = start, start + step
    for _ in range(60):
        outside = min(max(outside, floor), ceiling)
        if function(outside) > 0.0:
            return _root(function, inside, outside) if function(inside) < 0.0 else inside
        if outside in (floor, ceiling):
            return outside
        inside, outside = outside, outside + 2.0 * (outside - start)
    return float(np.sign(step) * np.inf)


def _root(function: Callable[[float], float], one: float, other: float) -> float:
    found: float = brentq(function, one, other, rtol=1e-4)
    return found


def _binomial(successes: int, count: int) -> tuple[float, float]:
    tail = (1.0 - CONFIDENCE) / 2.0
    low = float(betaincinv(successes, count - successes + 1.0, tail)) if successes else 0.0
    high = float(betaincinv(successes + 1.0, count - successes, 1.0 - tail)) if successes < count else 1.0
    return low, high
