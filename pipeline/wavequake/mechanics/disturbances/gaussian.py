"""Motions of a disturbance as sums of Gaussian numbers, found by drawing with one of them at a time."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.streams import Coordinates, Normals, Streams

Array = NDArray[np.float64]

# Draws from streams at instants (n,) and returns motions (n, m), whatever their columns are.
Rows = Callable[[Streams, Array], Array]

_MOST_NUMBERS = 5_000  # that move something: matrices of their squares
_MOST_ENTRIES = 2**26  # of all motions: 0.5 GB
_LINEAR = 1e-6  # share by which a sum of numbers may miss what is drawn


class NotGaussianError(UserError):
    """The motions of a disturbance are no sums of Gaussian numbers, or of too many to look at each."""


@dataclass(frozen=True)
class GaussianMotions:
    """Motions of a disturbance as sums of Gaussian numbers.

    Attributes
    ----------
    streams : tuple of (str, int)
        Names of the streams, and how many numbers each gives.
    moving : ndarray, shape (d,)
        Which of the numbers move something.
    rest : ndarray, shape (n, m)
        Motion over n instants where all numbers are zero.
    columns : ndarray, shape (d, n, m)
        What each number adds.
    """

    streams: tuple[tuple[str, int], ...]
    moving: NDArray[np.int64]
    rest: Array
    columns: Array

    def of(self, numbers: Array) -> Streams:
        """Return what the streams of a case with `numbers` (d,) draw from."""
        return _streams(self.streams, self.moving, numbers)


def gaussian_motions(name: str, rows: Rows, time: Array) -> GaussianMotions:
    """Return the motions of the disturbance `name`, which `rows` draws at the instants `time` (n,), as sums.

    Raises
    ------
    NotGaussianError
        If they are no such sums, or of too many numbers.
    UserError
        If nothing moves.
    """
    counters: dict[str, Coordinates] = {}
    rows(lambda stream: counters.setdefault(stream, Coordinates()), time)
    streams = tuple((stream, counter.taken) for stream, counter in counters.items())
    total = sum(count for _, count in streams)
    everything = np.arange(total)
    trial = np.random.default_rng(0).standard_normal(total)
    wanted = rows(_streams(streams, everything, trial), time)
    if (wanted == wanted[0]).all():  # constant over the instants
        time, wanted = time[:1], wanted[:1]
    rest = rows(_streams(streams, everything, np.zeros(total)), time)
    scale = np.abs(wanted).max(axis=0)

    def require_sum(missed: Array) -> None:
        if not (np.abs(missed) <= _LINEAR * np.where(scale > 0.0, scale, 1.0)).all():
            raise NotGaussianError(
                f"The motions of the disturbance {name!r} are no sums of Gaussian numbers (uniform "
                "amplitudes, or random frequencies and phases), which rare events need; `wavequake tail` "
                "takes any disturbance."
            )

    # What is no sum shows it here, before it is drawn with each of its numbers, which may be thousands.
    require_sum(rows(_streams(streams, everything, -trial), time) - rest + wanted - rest)
    if total * wanted.size > _MOST_ENTRIES:
        raise _too_many(name, total, len(time))
    columns = np.empty((total, *rest.shape))
    for number, column in enumerate(columns):
        column[...] = rows(_streams(streams, everything[number : number + 1], np.ones(1)), time) - rest
    require_sum(rest + np.tensordot(trial, columns, 1) - wanted)
    moving = np.flatnonzero(columns.any(axis=(1, 2)))
    if not len(moving):
        raise UserError(f"The disturbance {name!r} moves nothing: there are no rare events of it.")
    if len(moving) > _MOST_NUMBERS:
        raise _too_many(name, len(moving), len(time))
    return GaussianMotions(streams, moving, rest, columns[moving])


def _too_many(name: str, numbers: int, instants: int) -> NotGaussianError:
    return NotGaussianError(
        f"A case of {name!r} draws {numbers} numbers for {instants} instants, too many for rare events; take "
        "fewer instants, or `wavequake tail`."
    )


def _streams(streams: tuple[tuple[str, int], ...], moving: NDArray[np.int64], numbers: Array) -> Streams:
    """Return streams that give some numbers where something moves, and zeros elsewhere."""
    whole = np.zeros(sum(count for _, count in streams))
    whole[moving] = numbers
    ends = np.cumsum([count for _, count in streams])[:-1]
    parts = {name: Normals(part) for (name, _), part in zip(streams, np.split(whole, ends), strict=True)}
    return parts.__getitem__
