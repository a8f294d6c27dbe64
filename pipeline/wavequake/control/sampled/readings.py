"""What sensors read, over their frames, of a disturbance that goes in straight lines between instants.

Frames come in blocks, so that memory does not grow with the number of them.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol

import numpy as np
from scipy.linalg import expm

from wavequake.control.linear import Array
from wavequake.control.sampled.channel import RIGID, SAME, Dynamics

# Frames of a block.
BLOCK = 256


class Frames(Protocol):
    """Readings by frames, (frames, m, cases), each asked for once, in their order; an array is one."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Frames, readings and cases."""

    def __getitem__(self, frame: int, /) -> Array:
        """Return the readings (m, cases) of a frame."""


class Streamed:
    """Readings of cases beside each other, each given by blocks (`BLOCK` or fewer, m); None: zeros."""

    def __init__(self, frames: int, readings: int, cases: Sequence[Iterator[Array] | None]) -> None:
        self.shape = frames, readings, len(cases)
        self._cases, self._last = cases, 0
        self._block = np.zeros((0, readings, len(cases)))

    def __getitem__(self, frame: int) -> Array:
        """Return the readings (m, cases) of a frame of this block or the next one."""
        while frame >= self._last:
            frames, readings, cases = self.shape
            self._block = np.zeros((min(BLOCK, frames - self._last), readings, cases))
            for column, blocks in enumerate(self._cases):
                if blocks is not None:
                    self._block[..., column] = next(blocks)
            self._last += len(self._block)
        return np.asarray(self._block[frame - self._last])


def means(time: Array, seen: Array, begins: Array, ends: Array, sensor: Dynamics = RIGID) -> Array:
    """Return means (f, m), over spans of time, of what a sensor gives of straight lines through values.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Rising, s.
    seen : ndarray, shape (n, m)
        What is read at these instants; before the first one it stood still for ever.
    begins, ends : ndarray, shape (f,)
        Of the spans, rising and one after the other, between the first and the last instant.
    sensor : Dynamics
        How each reading follows what is read; exact (Van Loan 1978).
    """
    return np.concatenate([np.zeros((0, seen.shape[1])), *mean_blocks(time, seen, begins, ends, sensor)])


def mean_blocks(
    time: Array, seen: Array, begins: Array, ends: Array, sensor: Dynamics = RIGID
) -> Iterator[Array]:
    """Yield the same by blocks of `BLOCK` spans."""
    if len(sensor):
        yield from _followed(time, seen, begins, ends, sensor)
        return
    of = _straight(time, seen)
    for first in range(0, len(ends), BLOCK):
        begin, end = begins[first : first + BLOCK], ends[first : first + BLOCK]
        yield np.asarray((of(end) - of(begin)) / (end - begin)[:, None])


def _straight(time: Array, seen: Array) -> Callable[[Array], Array]:
    """Return the integral of straight lines as a function of its end."""
    steps = np.diff(time)[:, None]
    whole = np.concatenate(
        [np.zeros((1, seen.shape[1])), np.cumsum(0.5 * steps * (seen[1:] + seen[:-1]), axis=0)]
    )
    slopes = np.diff(seen, axis=0) / steps

    def until(at: Array) -> Array:
        place = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(steps) - 1)
        past = (at - time[place])[:, None]
        return np.asarray(whole[place] + past * seen[place] + 0.5 * past**2 * slopes[place])

    return until


def _followed(time: Array, seen: Array, begins: Array, ends: Array, sensor: Dynamics) -> Iterator[Array]:
    """Yield mean readings by blocks of spans: the integral of what the sensor gives, from edge to edge."""
    n, slopes = len(sensor), np.diff(seen, axis=0) / np.diff(time)[:, None]
    at = np.unique(np.concatenate([time, begins, ends]))
    place = np.clip(np.searchsorted(time, 0.5 * (at[1:] + at[:-1]), side="right") - 1, 0, len(slopes) - 1)
    # States, what is read, its slope, and the integral of what is given.
    rates = np.zeros((n + 3, n + 3))
    rates[:n, :n], rates[:n, n], rates[n, n + 1] = sensor.a, sensor.b, 1.0
    rates[n + 2, :n], rates[n + 2, n] = sensor.c, sensor.d
    steps: dict[int, Array] = {}
    state = np.vstack([np.outer(sensor.at_rest, seen[0]), np.zeros((3, seen.shape[1]))])
    opens, closes, now = np.searchsorted(at, begins), np.searchsorted(at, ends), 0
    for first in range(0, len(ends), BLOCK):
        mine = slice(first, first + BLOCK)
        start, last = now, closes[mine][-1]
        whole = np.zeros((last - start + 1, seen.shape[1]))
        whole[0] = state[n + 2]
        for now in range(start, last):
            line, begin, length = place[now], at[now], at[now + 1] - at[now]
            state[n], state[n + 1] = seen[line] + (begin - time[line]) * slopes[line], slopes[line]
            key = round(length / (SAME * (at[-1] - at[0])))
            if key not in steps:
                steps[key] = expm(rates * length)
            state = steps[key] @ state
            whole[now + 1 - start] = state[n + 2]
        now = last
        # A span may begin an ulp before the last one ended, which the block before holds.
        passed = whole[closes[mine] - start] - whole[np.maximum(opens[mine] - start, 0)]
        yield np.asarray(passed / (ends[mine] - begins[mine])[:, None])
