"""A line of sight that runs on between the instants that are imaged: exposures are streaks, not dots."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Places of the line of sight in an exposure, at least.
_PLACES = 1024
# Places of the line of sight so near an instant's, in lambda/D, are that instant's: the error of a
# transform is at most 2 pi times that.
_ONE_PLACE = 0.01


def times_between(time: Array, duration: float) -> Array:
    """Return the times (n, m) in s at which the line of sight is followed back from each instant (n,)."""
    each = -(-_PLACES // len(time))
    return np.asarray(time[:, None] - np.arange(each) / each * (duration / len(time)))


def around_rows(time: Array, chosen: NDArray[np.intp], sight: Array) -> Array:
    """Return the line of sight about each of the chosen instants, (n, m, 2); the first place is its own.

    Of what is given at instants `time` (T,), such as a history from a file: the line of sight (T, 2) is taken
    to be linear between them, and followed half the way to the chosen instants before and after.
    """
    at = time[chosen]
    middle = 0.5 * (at[1:] + at[:-1])
    first, last = np.concatenate([at[:1], middle]), np.concatenate([middle, at[-1:]])
    each = -(-_PLACES // len(at))
    share = (np.arange(each) + 0.5) / each
    ways = np.concatenate([at[:, None], first[:, None] + share * (last - first)[:, None]], axis=1)
    return np.stack([np.interp(ways, time, sight[:, axis]) for axis in (0, 1)], axis=-1)


def leaves_dots(away: Array) -> bool:
    """Return whether places (..., 2) in lambda/D, from those of their instants, are more than one place."""
    return bool(np.abs(away).max(initial=0.0) > _ONE_PLACE)
