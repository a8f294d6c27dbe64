"""The probability that any function of Gaussian numbers exceeds a limit, in steps that are not rare.

Subset simulation (Au & Beck 2001) with levels that a pilot chooses: with these held fixed every further run
is an estimate without bias (multilevel splitting; Cérou, Del Moral, Furon & Guyader 2012), and independent
runs give the interval. The Markov chain of preconditioned Crank-Nicolson steps (Papaioannou, Betz,
Zwirglmaier & Straub 2015) does not slow down with the number of dimensions.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from wavequake.campaign.rare.certificate import RareProbability
from wavequake.campaign.statistics.quantiles import CONFIDENCE
from wavequake.errors import UserError

Array = NDArray[np.float64]
LimitFunction = Callable[[Array], Array]

_SHARE = 0.2  # of the points that a level shall leave
_MOVES = 8  # of every point after each level
_ACCEPTED = 0.35  # share of moves that a step is tuned to
_MOST_LEVELS = 60  # 0.2^60 is 1e-42


def probability(
    function: LimitFunction,
    dimensions: int,
    limit: float,
    *,
    seed: int = 0,
    points: int = 1000,
    runs: int = 24,
) -> RareProbability:
    """Return the probability that `function` of independent standard normal numbers exceeds `limit`.

    Parameters
    ----------
    function : callable
        From points (n, dimensions) to values (n,); any units. It need not be smooth, and several regions may
        exceed the limit.
    dimensions : int
    limit : float
    seed : int
        The result depends on it and the arguments alone.
    points, runs : int
        Each of `runs` independent runs has so many points; all are in memory together.

    Raises
    ------
    UserError
        If the limit is not finite, no or all points exceed it, the function gives what is no number, or it
        rises no more before the limit.
    """
    if not np.isfinite(limit):
        raise UserError(f"The limit is {limit}; it must be a finite number.")
    if dimensions < 1 or points < 50 or runs < 8:
        raise UserError("A rare event takes at least 1 dimension, 50 points per run and 8 runs.")
    levels, steps = _pilot(function, dimensions, limit, np.random.default_rng([seed, 0]), points)
    random = np.random.default_rng([seed, 1])
    found = np.ones(runs)
    here = random.standard_normal((runs, points, dimensions))
    values = _values(function, here)
    evaluations = points * (runs + 1) * (1 + _MOVES * (len(levels) - 1))
    for place, level in enumerate(levels):
        above = values > level
        found *= above.mean(axis=1)
        if place == len(levels) - 1:
            break
        here, values = _resampled(here, values, above, random)
        for _ in range(_MOVES):
            here, values, _ = _moved(function, here, values, level, steps[place], random)
    mean, margin = found.mean(), float(student.ppf((1 + CONFIDENCE) / 2, runs - 1)) * found.std(ddof=1)
    margin /= np.sqrt(runs)
    return RareProbability(
        float(mean),
        max(float(mean - margin), 0.0),
        min(float(mean + margin), 1.0),
        evaluations,
        tuple(levels),
    )


def _pilot(
    function: LimitFunction, dimensions: int, limit: float, random: np.random.Generator, points: int
) -> tuple[list[float], list[float]]:
    """Return the levels up to the limit, and the size of the steps above each of them."""
    here = random.standard_normal((1, points, dimensions))
    values = _values(function, here)
    if (values > limit).all():
        raise UserError(
            f"All of {points} cases exceed the limit {limit:g}; the least value is {values.min():.6g}: "
            "give a higher limit."
        )
    levels, steps, step = list[float](), list[float](), 0.7
    while (values > limit).mean() < _SHARE:
        level = float(np.quantile(values, 1.0 - _SHARE))
        above = values > level
        if len(levels) == _MOST_LEVELS or not above.any() or (levels and level <= levels[-1]):
            raise UserError(
                f"No case exceeds the limit {limit:g}: the largest value that was found is "
                f"{values.max():.6g}; give a lower limit."
            )
        here, values = _resampled(here, values, above, random)
        for _ in range(_MOVES):
            here, values, accepted = _moved(function, here, values, level, step, random)
            step = min(step * float(np.exp(accepted - _ACCEPTED)), 1.0)
        levels.append(level)
        steps.append(step)
    return [*levels, limit], steps


def _values(function: LimitFunction, points: Array) -> Array:
    """Return the values (runs, n) of points (runs, n, d)."""
    values = np.asarray(function(points.reshape(-1, points.shape[2])), dtype=np.float64)
    if values.shape != (points.shape[0] * points.shape[1],) or np.isnan(values).any():
        raise UserError("The limit function must give one number for each point.")
    return values.reshape(points.shape[:2])


def _resampled(
    here: Array, values: Array, above: NDArray[np.bool_], random: np.random.Generator
) -> tuple[Array, Array]:
    """Return points that replace those of each run by its points above the level, in equal shares."""
    chosen = np.zeros(values.shape, dtype=np.int64)
    for run, mine in enumerate(above):
        if mine.any():  # otherwise the run is over: its estimate is zero
            chosen[run] = np.resize(random.permutation(np.flatnonzero(mine)), len(mine))
    return np.take_along_axis(here, chosen[..., None], axis=1), np.take_along_axis(values, chosen, axis=1)


def _moved(
    function: LimitFunction,
    here: Array,
    values: Array,
    level: float,
    step: float,
    random: np.random.Generator,
) -> tuple[Array, Array, float]:
    """Move points by one step of the chain that stays above the level; and the share of accepted moves."""
    there = np.sqrt(1.0 - step**2) * here + step * random.standard_normal(here.shape)
    found = _values(function, there)
    stays = found > level
    here = np.where(stays[..., None], there, here)
    return here, np.where(stays, found, values), float(stays.mean())
