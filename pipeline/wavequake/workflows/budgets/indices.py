"""How much each of several independent factors contributes to a number: estimates from paired evaluations.

All estimates are functions of means over cases, so that the bootstrap over cases is one matrix product.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CONFIDENCE = 0.95
_RESAMPLES = 1000
_BLOCKS = 500  # of neighboring cases, where there are more


@dataclass(frozen=True)
class Estimate:
    """Values (k,) and their 95 % confidence intervals; NaN where there is nothing to divide."""

    value: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class VarianceShares:
    """Shares of the variance: by each factor alone, and with all its interactions (Sobol indices)."""

    first: Estimate
    total: Estimate


def removed_shares(whole: Array, without: Array, seed: int = 0) -> Estimate:
    """Return by what share of the mean square a number falls when each factor is switched off.

    Parameters
    ----------
    whole : ndarray, shape (n,)
        The number in n independent cases.
    without : ndarray, shape (n, k)
        In the same cases, each without one factor.
    """

    def shares(means: Array) -> Array:
        return _divided(means[..., :1] - means[..., 1:], means[..., :1])

    return bootstrapped(np.column_stack([whole, without]) ** 2, shares, seed)


def variance_shares(one: Array, other: Array, swapped: Array, seed: int = 0) -> VarianceShares:
    """Return first-order and total Sobol indices by pick-freeze.

    The indices are the correlation of the swapped cases with B, and one minus that with A. By chance, A and B
    are correlated, too, which their joint regression on both takes out: so indices near 0 and 1 are precise.

    Parameters
    ----------
    one, other : ndarray, shape (n,)
        The number in n independent cases A, and in n others, B.
    swapped : ndarray, shape (n, k)
        In cases A of which one factor is that of B.

    References
    ----------
    Sobol 2001, Math. Comput. Simul. 55:271; Saltelli et al. 2010, Comput. Phys. Commun. 181:259.
    """
    center = np.mean([one, other])  # of no effect but on rounding
    one, other, swapped = one - center, other - center, swapped - center
    count = swapped.shape[1]
    moments = np.column_stack(
        [
            *(one, other, one**2, other**2, one * other),
            *(swapped, swapped**2, one[:, None] * swapped, other[:, None] * swapped),
        ]
    )

    def both(means: Array) -> Array:
        a, b, aa, bb, ab = (means[..., k : k + 1] for k in range(5))
        c, cc, ac, bc = np.split(means[..., 5:], 4, axis=-1)
        size_a, size_b, size_c = (
            np.sqrt(np.maximum(square - mean**2, 0.0)) for mean, square in ((a, aa), (b, bb), (c, cc))
        )
        with_a = _divided(ac - a * c, size_a * size_c)
        with_b = _divided(bc - b * c, size_b * size_c)
        by_chance = _divided(ab - a * b, size_a * size_b)
        alone = 1.0 - by_chance**2
        first = _divided(with_b - with_a * by_chance, alone)
        total = 1.0 - _divided(with_a - with_b * by_chance, alone)
        return np.concatenate([first, total], axis=-1)

    found = bootstrapped(moments, both, seed)
    first, total = (
        Estimate(found.value[part], found.low[part], found.high[part])
        for part in (slice(0, count), slice(count, None))
    )
    return VarianceShares(first, total)


def _divided(numerator: Array, denominator: Array) -> Array:
    denominator = np.broadcast_to(denominator, numerator.shape)
    nothing = np.full(numerator.shape, np.nan)
    return np.asarray(np.divide(numerator, denominator, out=nothing, where=denominator > 0.0))


def bootstrapped(columns: Array, statistic: Callable[[Array], Array], seed: int = 0) -> Estimate:
    """Return a statistic of the means of columns (n, c), with its percentile interval over cases."""
    mean, blocks = columns.mean(axis=0), min(len(columns), _BLOCKS)
    edges = np.arange(blocks) * len(columns) // blocks
    parts = np.add.reduceat(columns, edges, axis=0) * (blocks / len(columns))
    weights = np.random.default_rng(seed).multinomial(blocks, np.full(blocks, 1.0 / blocks), _RESAMPLES)
    resampled = statistic(weights @ parts / blocks)
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(resampled, [tail, 100.0 - tail], axis=0)
    return Estimate(statistic(mean), low, high)
