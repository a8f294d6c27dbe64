"""Means and quantiles of costly numbers, sharpened by a cheap model of them: control variates.

The cheap model is known of the costly cases and of many more. What it misses is a smooth function and a
remainder, which costly cases give; where the remainder is small the many cases count, and where the model
says nothing the costly ones alone do.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from wavequake.campaign.statistics.quantiles import CONFIDENCE, Quantile, quantile

Array = NDArray[np.float64]

_RESAMPLES = 200
_BLOCK = 2**21  # numbers that are in memory together
_HELPS = 0.5  # share of the variance that the model must explain to be used for quantiles
FEWEST = 20


@dataclass(frozen=True)
class Sharpened:
    """A mean or a quantile: by the costly cases alone, and with the cheap model.

    ``worth`` is how many costly cases would be needed for as narrow an interval without the model.
    """

    alone: Quantile
    value: Quantile
    worth: float


def sharpened_mean(costly: Array, cheap: Array, more: Array) -> Sharpened:
    """Return the mean of a costly number by regression on a cheap one.

    Parameters
    ----------
    costly, cheap : ndarray, shape (n,)
        Both numbers of n independent cases.
    more : ndarray, shape (m,)
        The cheap one of m other cases.

    References
    ----------
    Glynn & Szechtman 2002, in Monte Carlo and Quasi-Monte Carlo Methods 2000; nested samples as in
    Peherstorfer, Willcox & Gunzburger 2016, SIAM J. Sci. Comput. 38:A3163.
    """
    count, others = len(costly), len(more)
    wide = float(stdtrit(count - 1, 0.5 + CONFIDENCE / 2.0))
    mean, error = float(costly.mean()), float(costly.std(ddof=1)) / count**0.5
    slope = _slope(costly, cheap) * others / (count + others)
    rest = costly - slope * cheap
    value = float(rest.mean() + slope * more.mean())
    sharp = float(np.hypot(rest.std(ddof=2) / count**0.5, slope * more.std(ddof=1) / others**0.5))
    alone = Quantile(mean, mean - wide * error, mean + wide * error)
    found = Quantile(value, value - wide * sharp, value + wide * sharp)
    return Sharpened(alone, found, count * (error / max(sharp, 1e-300)) ** 2 if error else float(count))


def sharpened_quantile(
    costly: Array, cheap: Array, more: Array, probability: float, seed: int = 0
) -> Sharpened:
    """Return a quantile of a costly number over cases, as :func:`sharpened_mean` does a mean.

    The costly number is taken as a parabola of the cheap one and a remainder that does not depend on it; all
    cheap cases with the remainders in turn are the population. The interval is that of resampled costly and
    cheap cases, and holds what a straight line would give in place of the parabola. Where the line explains
    less than half of the variance the costly cases stand alone.
    """
    alone, count = quantile(costly, probability), len(costly)
    if _explained(costly, cheap) < _HELPS:
        return Sharpened(alone, alone, float(count))
    random = np.random.default_rng(seed)
    every = np.concatenate([cheap, more])
    turn = random.permutation(len(every)) % count
    center, scale = float(cheap.mean()), float(cheap.std())
    x, all_x = (cheap - center) / scale, (every - center) / scale

    def levels(places: NDArray[np.int64], population: NDArray[np.int64], degree: int) -> Array:
        """Return the quantile (r,) of r resampled sets of costly and of cheap cases, (r, n) and (r, N)."""
        one, other = costly[places], x[places]
        powers = np.stack([other**power for power in range(degree + 1)], axis=-1)
        normal = np.swapaxes(powers, 1, 2) @ powers + 1e-12 * count * np.eye(degree + 1)
        weights = np.linalg.solve(normal, np.swapaxes(powers, 1, 2) @ one[..., None])
        rest = (one - (powers @ weights)[..., 0]) * np.sqrt(count / (count - degree - 1))
        found, chosen = rest.take(turn, axis=1), all_x.take(population)
        for power in range(degree + 1):
            found += weights[:, power] * chosen**power
        return np.asarray(np.quantile(found, probability, axis=1, overwrite_input=True))

    whole, all_of_them = np.arange(count)[None], np.arange(len(every))[None]
    value, line = (float(levels(whole, all_of_them, degree)[0]) for degree in (2, 1))
    at_once = max(_BLOCK // len(every), 1)
    found = [
        levels(
            random.integers(count, size=(size, count)),
            random.integers(len(every), size=(size, len(every))),
            2,
        )
        for size in (min(at_once, _RESAMPLES - first) for first in range(0, _RESAMPLES, at_once))
    ]
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(np.concatenate(found), [tail, 100.0 - tail])
    # As much wider as Student's distribution of so few costly cases is.
    wide = float(stdtrit(count - 3, 0.975) / stdtrit(1e9, 0.975))
    low, high = value - wide * (value - float(low)), value + wide * (float(high) - value)
    sharp = Quantile(value, min(low, line), max(high, line))
    width = (alone.high - alone.low) / max(sharp.high - sharp.low, 1e-300)
    return Sharpened(alone, sharp, count * width**2)


def _slope(costly: Array, cheap: Array) -> float:
    apart = cheap - cheap.mean()
    square = float(apart @ apart)
    return float(apart @ costly) / square if square > 0.0 else 0.0


def _explained(costly: Array, cheap: Array) -> float:
    """Return the share of the variance that a straight line explains."""
    rest = costly - _slope(costly, cheap) * cheap
    variance = float(costly.var())
    return 1.0 - float(rest.var()) / variance if variance > 0.0 else 0.0
