"""Probabilities by weighted draws, and what a costly model changes of the probability of a cheap one.

The cheap model is the control variate of the costly one: only cases that one of them sees above the limit and
the other does not count (Giles 2008), so that few costly cases prove much.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta, norm

from wavequake.campaign.rare.quadratic import Tilt
from wavequake.campaign.statistics.quantiles import CONFIDENCE

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_BLOCK = 2**24  # random numbers that are in memory together
_WIDE = float(norm.isf((1.0 - CONFIDENCE) / 2.0))


@dataclass(frozen=True)
class RareProbability:
    """How often a limit is exceeded, with its 95 % confidence interval.

    Attributes
    ----------
    value, low, high : float
    evaluations : int
        Of the limit function, all included.
    levels : tuple of float
        Values of the limit function in whose steps the limit is reached; the last one is the limit.
    """

    value: float
    low: float
    high: float
    evaluations: int
    levels: tuple[float, ...]


@dataclass(frozen=True)
class Correction:
    """What costly cases change of a probability: ``value``, added to it, with its 95 % interval.

    ``cases`` were computed with both models, of which ``unknown`` failed with the costly one; ``more`` exceed
    the limit with the costly model alone, ``fewer`` with the cheap one alone.
    """

    value: float
    low: float
    high: float
    cases: int
    more: int
    fewer: int
    unknown: int


def estimated(tilt: Tilt, limit: float, seed: int, draws: int) -> RareProbability:
    """Return how often a form exceeds a limit, from weighted draws of a tilted distribution."""
    random, rank = np.random.default_rng([seed, 2]), len(tilt.means)
    parts = []
    at_once = max(_BLOCK // max(rank, 1), 1)
    for first in range(0, draws, at_once):
        unit = random.standard_normal((min(at_once, draws - first), rank))
        values = tilt.form.along(tilt.means + tilt.widths * unit)
        parts.append(np.where(values > limit, tilt.weights(values), 0.0))
    return weighted(np.concatenate(parts), limit)


def weighted(weights: Array, limit: float) -> RareProbability:
    """Return the probability of which independent draws' weights (n,), 0 of those below, are estimates."""
    mean = float(weights.mean())
    margin = _WIDE * float(weights.std(ddof=1)) / len(weights) ** 0.5
    return RareProbability(mean, max(mean - margin, 0.0), mean + margin, len(weights), (limit,))


def correction(weights: Array, at_limit: float, cheap: Flags, costly: Flags, known: Flags) -> Correction:
    """Return what the costly model changes of the probability.

    Parameters
    ----------
    weights : ndarray, shape (n,)
        Of independent draws: density of the cases over that of the draws.
    at_limit : float
        Weight of a draw at the limit.
    cheap, costly : ndarray, shape (n,)
        Whether the models exceed the limit.
    known : ndarray, shape (n,)
        Whether the costly model gave a number. One that gave none counts as what is worse.

    Notes
    -----
    The interval holds both that of the mean by its scatter, which needs many cases that differ, and that of
    the number of cases that differ (Clopper & Pearson 1934), which holds where there is none.
    """
    count = len(weights)
    more, fewer = known & costly & ~cheap, known & cheap & ~costly
    differs = weights * (more.astype(np.float64) - fewer)
    value = float(differs.mean())
    scatter = _WIDE * float(differs.std(ddof=1)) / count**0.5
    ends = []
    for flags in (more, fewer):
        each = max(at_limit, float(weights[flags].mean())) if flags.any() else at_limit
        ends.append([each * share for share in _shares(int(flags.sum()), count)])
    low = min(value - scatter, ends[0][0] - ends[1][1])
    high = max(value + scatter, ends[0][1] - ends[1][0])
    lost = weights * ~known
    return Correction(
        value,
        low - float(np.sum(lost * cheap)) / count,
        high + float(np.sum(lost * ~cheap)) / count,
        count,
        int(more.sum()),
        int(fewer.sum()),
        int(count - known.sum()),
    )


def _shares(hits: int, count: int) -> tuple[float, float]:
    tail = (1.0 - CONFIDENCE) / 2.0
    low = float(beta.ppf(tail, hits, count - hits + 1)) if hits else 0.0
    return low, float(beta.isf(tail, hits + 1, count - hits)) if hits < count else 1.0
