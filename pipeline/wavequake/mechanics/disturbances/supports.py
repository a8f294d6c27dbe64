"""Supports of segments that are not known exactly: other frequencies and damping of their modes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.mechanics.disturbances.motion import generator

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Supports:
    """One model of all supports, by the random numbers that it is drawn with.

    Attributes
    ----------
    frequency, damping : float
        Standard deviations of the logarithms.
    apart : bool
        Whether every segment's support is off by itself, or all alike.
    key : (int, str, int)
        Seed, name and number of the random numbers.
    """

    frequency: float
    damping: float
    apart: bool
    key: tuple[int, str, int]

    def factors(self, segments: int, modes: int) -> tuple[Array, Array]:
        """Return the factors on frequencies and on damping ratios, each (S, M), or (1, M) if all are alike.

        The k-th mode takes the k-th numbers, so that disturbances of more modes share those of fewer.
        """
        count = segments if self.apart else 1
        normal = generator(*self.key).standard_normal((modes, 2, count))
        return np.exp(self.frequency * normal[:, 0].T), np.exp(self.damping * normal[:, 1].T)
