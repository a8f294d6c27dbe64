"""Oscillators that noise drives, sampled exactly: what telemetry is made of in tests."""

import os

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter


def records(few, many):
    """Return how many records are looked at: few of them in `make test`, many in `make soak`."""
    return many if os.environ.get("MANY_RECORDS") else few


def oscillator_series(random, count, step, natural_hz, damping):
    """Draw an oscillator of unit variance by the exact step of its two states, decoupled."""
    omega = 2 * np.pi * natural_hz
    turn = expm(np.array([[0.0, 1.0], [-(omega**2), -2 * damping * omega]]) * step)
    states = np.diag([1.0, omega**2])
    noise = random.standard_normal((count, 2)) @ np.linalg.cholesky(states - turn @ states @ turn.T).T
    noise[0] = random.standard_normal(2) * [1.0, omega]
    values, vectors = np.linalg.eig(turn)
    driven = np.linalg.solve(vectors, noise.T.astype(complex))
    return sum(lfilter([1.0], [1.0, -values[k]], driven[k]) * vectors[0, k] for k in range(2)).real


def signals(random, count, step, lines, noise=1.0):
    """Draw signals (count, c) of lines (frequency, damping, rms of each signal) in white noise."""
    shapes = [np.asarray(shape, dtype=float) for *_, shape in lines]
    total = noise * random.standard_normal((count, len(shapes[0])))
    for (natural, damping, _), shape in zip(lines, shapes, strict=True):
        total += np.outer(oscillator_series(random, count, step, natural, damping), shape)
    return total
