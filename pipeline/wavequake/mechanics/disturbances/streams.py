"""Where the random numbers of a draw come from: generators, or the coordinates of a point of the unit cube.

Disturbances draw from either in the same way. A sampling plan that spreads its points evenly over the cube
(Latin hypercube, Sobol) thus replaces the generators of a case without the disturbances knowing.
"""

from collections.abc import Callable
from math import prod
from typing import Protocol

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

Array = NDArray[np.float64]
Size = int | tuple[int, ...]


class Random(Protocol):
    """What disturbances use of ``numpy.random.Generator``."""

    def random(self, size: Size, /) -> Array:
        """Return numbers that are uniform between 0 and 1."""

    def standard_normal(self, size: Size, /) -> Array:
        """Return numbers of the normal distribution of mean 0 and variance 1."""

    def uniform(self, low: float | Array, high: float | Array, size: Size | None = None, /) -> Array:
        """Return numbers that are uniform between `low` and `high`."""


# Gives what draws instead of a stream's own generator, by the stream's name; None leaves it its own.
Streams = Callable[[str], Random | None]


def own_streams(name: str) -> None:
    """Leave every stream its own generator."""


class Coordinates:
    """Takes the coordinates of a point one after the other; normal numbers by the inverse distribution.

    Parameters
    ----------
    point : ndarray, shape (n,), optional
        Between 0 and 1, both excluded. Without it every coordinate is 0.6, and there is no end of them.

    Attributes
    ----------
    taken : int
        Number of coordinates used so far.
    """

    def __init__(self, point: Array | None = None) -> None:
        self._point = point
        self.taken = 0

    def random(self, size: Size, /) -> Array:
        """Return the next coordinates."""
        shape = (size,) if isinstance(size, int | np.integer) else size
        first, self.taken = self.taken, self.taken + prod(shape)
        if self._point is None:
            return np.full(shape, 0.6)
        return self._point[first : self.taken].reshape(shape)

    def standard_normal(self, size: Size, /) -> Array:
        """Return the quantiles of the normal distribution at the next coordinates."""
        return np.asarray(scipy.special.ndtri(self.random(size)), dtype=np.float64)

    def uniform(self, low: float | Array, high: float | Array, size: Size | None = None, /) -> Array:
        """Return the next coordinates between `low` and `high`."""
        shape = np.broadcast_shapes(np.shape(low), np.shape(high)) if size is None else size
        return np.asarray(low + (np.subtract(high, low)) * self.random(shape), dtype=np.float64)


class Normals(Coordinates):
    """Takes standard normal numbers one after the other; uniform ones by the distribution function.

    Parameters
    ----------
    numbers : ndarray, shape (n,)
    """

    def __init__(self, numbers: Array) -> None:
        super().__init__(scipy.special.ndtr(numbers))
        self._numbers = numbers

    def standard_normal(self, size: Size, /) -> Array:
        """Return the next numbers as they are."""
        shape = (size,) if isinstance(size, int | np.integer) else size
        first, self.taken = self.taken, self.taken + prod(shape)
        return self._numbers[first : self.taken].reshape(shape)
