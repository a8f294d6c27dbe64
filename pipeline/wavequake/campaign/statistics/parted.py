"""The variance of a result, parted into what models of it share and what is left within each."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FEWEST = 10
_RESAMPLED, _FEWEST_RESAMPLED = 2000, 200
_MOST_NUMBERS = 10_000_000


@dataclass(frozen=True)
class Parted:
    """Law of total variance: Var y = E Var(y | model) + Var E(y | model).

    Attributes
    ----------
    excitation, model : float
        The two parts, unbiased; that of the model may be negative where it is small.
    share : float
        Of the model, between 0 and 1.
    low, high : float
        Its 95 % interval (bootstrap of models).
    models : int
    """

    excitation: float
    model: float
    share: float
    low: float
    high: float
    models: int


def parted(values: Array, models: NDArray[np.int64]) -> Parted | None:
    """Part the variance of values (n,), of which those of equal `models` (n,) share one.

    Analysis of variance with one random effect (Searle, Casella and McCulloch 1992, section 3.6): mean
    squares between and within models. None where fewer than ten models have two cases or more.
    """
    _, which, counts = np.unique(models, return_inverse=True, return_counts=True)
    several = counts >= 2
    if several.sum() < FEWEST:
        return None
    kept = several[which]
    _, which = np.unique(which[kept], return_inverse=True)
    values, sizes = values[kept], counts[several].astype(np.float64)
    sums = np.bincount(which, values).astype(np.float64)
    squares = np.bincount(which, (values - (sums / sizes)[which]) ** 2).astype(np.float64)
    each = np.stack([np.ones_like(sizes), sizes, sums, squares, sizes**2, sums**2 / sizes])
    excitation, model = _parts(each.sum(axis=1))
    random = np.random.default_rng(len(values))
    weights = (
        np.bincount(random.integers(0, len(sizes), len(sizes)), minlength=len(sizes))
        for _ in range(min(_RESAMPLED, max(_FEWEST_RESAMPLED, _MOST_NUMBERS // len(sizes))))
    )
    shares = [_share(*_parts(each @ weight)) for weight in weights]
    low, high = np.quantile(shares, [0.025, 0.975])
    return Parted(excitation, model, _share(excitation, model), float(low), float(high), len(sizes))


def _parts(sums: Array) -> tuple[float, float]:
    """Return the variances within and between models.

    From sums over models (6,): of 1, cases, sums, sums of squares about means, squares of cases, and squares
    of sums over cases.
    """
    groups, total, whole, squares, sizes, means = sums.tolist()
    within = squares / (total - groups)
    between = (means - whole**2 / total) / (groups - 1.0)
    return within, (between - within) * (groups - 1.0) / (total - sizes / total)


def _share(excitation: float, model: float) -> float:
    whole = excitation + model
    return min(max(model / whole, 0.0), 1.0) if whole > 0.0 else 0.0
