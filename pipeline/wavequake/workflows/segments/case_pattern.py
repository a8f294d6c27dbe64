"""Which population and realization each case is, by its number alone."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def slots(shares: Sequence[int], cases: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the index of the population and the realization of each case.

    Cases repeat a pattern in which population p has ``shares[p]`` rows, so that adding cases changes no
    earlier one, and the n-th case of every population is realization n: comparisons between populations are
    paired.
    """
    rows = np.asarray(shares, dtype=np.int64)
    pattern = np.repeat(np.arange(len(rows)), rows)
    first = np.cumsum(rows) - rows
    round_, place = np.divmod(cases, len(pattern))
    population = pattern[place]
    return population, round_ * rows[population] + place - first[population]
