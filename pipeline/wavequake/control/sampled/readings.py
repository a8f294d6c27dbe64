"""What sensors read, over their frames, of a disturbance that goes in straight lines between instants."""

from collections.abc import Callable

import numpy as np
from scipy.linalg import expm

from wavequake.control.linear import Array
from wavequake.control.sampled.channel import RIGID, SAME, Dynamics


def means(time: Array, seen: Array, begins: Array, ends: Array, sensor: Dynamics = RIGID) -> Array:
    """Return means (f, m), over spans of time, of what a sensor gives of straight lines through values.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Rising, s.
    seen : ndarray, shape (n, m)
        What is read at these instants; before the first one it stood still for ever.
    begins, ends : ndarray, shape (f,)
        Of the spans, between the first and the last instant.
    sensor : Dynamics
        How each reading follows what is read; exact (Van Loan 1978).
    """
    edges = np.concatenate([begins, ends])
    of = _followed(time, seen, edges, sensor) if len(sensor) else _straight(time, seen)
    return np.asarray((of(ends) - of(begins)) / (ends - begins)[:, None])


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


def _followed(time: Array, seen: Array, edges: Array, sensor: Dynamics) -> Callable[[Array], Array]:
    """Return the integral of a sensor's readings as a function of its end, which is one of the edges."""
    n, slopes = len(sensor), np.diff(seen, axis=0) / np.diff(time)[:, None]
    at = np.unique(np.concatenate([time, edges]))
    place = np.clip(np.searchsorted(time, 0.5 * (at[1:] + at[:-1]), side="right") - 1, 0, len(slopes) - 1)
    # States, what is read, its slope, and the integral of what is given.
    rates = np.zeros((n + 3, n + 3))
    rates[:n, :n], rates[:n, n], rates[n, n + 1] = sensor.a, sensor.b, 1.0
    rates[n + 2, :n], rates[n + 2, n] = sensor.c, sensor.d
    steps: dict[int, Array] = {}
    whole = np.zeros((len(at), seen.shape[1]))
    state = np.vstack([np.outer(sensor.at_rest, seen[0]), np.zeros((3, seen.shape[1]))])
    for k, (begin, length) in enumerate(zip(at, np.diff(at), strict=False)):
        line = place[k]
        state[n], state[n + 1] = seen[line] + (begin - time[line]) * slopes[line], slopes[line]
        key = round(length / (SAME * (at[-1] - at[0])))
        if key not in steps:
            steps[key] = expm(rates * length)
        state = steps[key] @ state
        whole[k + 1] = state[n + 2]
    return lambda ends: whole[np.searchsorted(at, ends)]
