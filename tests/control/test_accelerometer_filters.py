"""LQG and LQR of sensors that show accelerations: the best of their family, by covariances."""

import numpy as np
from scipy.linalg import expm, solve_discrete_lyapunov

from wavequake.control.frames.disturbance import joined, line
from wavequake.control.sampled.channel import (
    Dynamics,
    Timing,
    acceleration,
    first_order,
    in_series,
    sampled_channel,
    second_order,
)
from wavequake.control.sampled.filters import lqg, lqr

T = 0.002
WHEN = Timing(T, T, 1, 0.5 * T)
LINES = joined([line(14.0, 0.3, 3.0), line(31.0, 0.5, 1.0)])
SERVO = second_order(150.0, 0.7)
SENSOR = acceleration(400.0, 0.7)


def left(model, shows, noise, parts=64):
    """Return the rms over a period of what is left, and of the disturbance, from the covariance of all.

    Disturbance and sensor step by parts of a period, the noise of each part by Simpson's rule.
    """
    n, m = len(LINES.a), len(shows)
    rates = np.zeros((n + m + 2, n + m + 2))
    rates[:n, :n], rates[n : n + m, :n] = LINES.a, np.outer(shows.b, LINES.c)
    rates[n : n + m, n : n + m] = shows.a
    rates[n + m, :n], rates[n + m, n : n + m] = shows.d * LINES.c, shows.c
    rates[n + m + 1, :n] = LINES.c
    g = np.vstack([LINES.g, np.zeros((m + 2, LINES.g.shape[1]))])
    size, h = n + m, T / parts
    one, half = expm(rates * h), expm(rates * h / 2)
    noise_of_part = (
        sum(w * (e @ g) @ (e @ g).T for w, e in ((1, np.eye(size + 2)), (4, half), (1, one))) * h / 6
    )
    step, covariance = np.eye(size + 2), np.zeros((size + 2, size + 2))
    for _ in range(parts):
        step, covariance = one @ step, one @ covariance @ one.T + noise_of_part
    scale = np.diag([*np.ones(size), 1 / T, 1 / T])
    step, covariance = (scale @ step)[:, :size], scale @ covariance @ scale
    # All together: disturbance with sensor, channel, controller; then what is left on average.
    whole = in_series(SERVO, shows)
    plant = sampled_channel(whole, WHEN)
    position = Dynamics(whole.a, whole.b, np.concatenate([SERVO.c, np.zeros(m)]), 0.0)
    moved = sampled_channel(position, WHEN).c
    p, c = len(plant.a), len(model.a)
    reading = np.hstack([step[size : size + 1], plant.c, np.zeros((1, c))])
    a = np.zeros((size + p + c, size + p + c))
    a[:size, :size] = step[:size]
    a[size : size + p, size : size + p] = plant.a
    a[size : size + p, size + p :] = plant.b @ model.c
    a[size + p :, size + p :] = model.a
    a[size : size + p] += plant.b @ model.d @ reading
    a[size + p :] += model.b @ reading
    into = np.zeros((size + p + c, size + 2))  # noise of states, of the reading
    into[:size, :size] = np.eye(size)
    into[size : size + p, size] = (plant.b @ model.d)[:, 0]
    into[size + p :, size] = model.b[:, 0]
    driven = covariance + np.diag([*np.zeros(size), noise**2, 0.0])
    states = solve_discrete_lyapunov(a, into @ driven @ into.T)
    row = np.hstack([step[size + 1], moved[0], np.zeros(c)])
    return np.sqrt(row @ states @ row + covariance[-1, -1]), np.sqrt(10.0)


def test_a_filter_of_an_accelerometer_is_the_best_there_is():
    """Any other filter of the family leaves more: noise, delay or resonance believed wrong."""
    size = (2 * np.pi * 14.0) ** 2
    for design in (lqg, lambda known, noise, *more: lqr(known, noise, 1e-4, *more)):
        best = left(design(LINES, 0.1 * size, SERVO, WHEN, SENSOR), SENSOR, 0.1 * size)[0]
        assert best < 0.25 * left(design(LINES, 1e6 * size, SERVO, WHEN, SENSOR), SENSOR, 0.1 * size)[0]
        others = (
            design(LINES, 0.2 * size, SERVO, WHEN, SENSOR),
            design(LINES, 0.05 * size, SERVO, WHEN, SENSOR),
            design(LINES, 0.1 * size, SERVO, WHEN, acceleration(250.0, 0.7)),
            design(LINES, 0.1 * size, SERVO, Timing(T, T, 1, 0.9 * T), SENSOR),
        )
        for other in others:
            assert left(other, SENSOR, 0.1 * size)[0] > best
        # A worse sensor leaves more, and a plain one of noise 0.1 about as much as it of 0.1 (88 rad/s)^2.
        assert left(design(LINES, 0.4 * size, SERVO, WHEN, SENSOR), SENSOR, 0.4 * size)[0] > 1.2 * best


def test_a_fast_sensor_is_a_plain_one():
    """Electronics of 1 MHz change nothing; those of 40 Hz do, and are known to the filter."""
    plain, fast = lqg(LINES, 0.1, SERVO, WHEN), lqg(LINES, 0.1, SERVO, WHEN, first_order(1e6))
    z = np.exp(2j * np.pi * np.array([3.0, 14.0, 50.0, 200.0]) * T)
    values = [
        [one.c @ np.linalg.solve(at * np.eye(len(one.a)) - one.a, one.b) + one.d for at in z]
        for one in (plain, fast)
    ]
    np.testing.assert_allclose(values[1], values[0], rtol=5e-3)
    slow = first_order(40.0)
    knows, not_told = (
        lqr(LINES, 0.1, 1e-4, SERVO, WHEN, slow),
        lqr(LINES, 0.1, 1e-4, in_series(SERVO, slow), WHEN),
    )
    found = [left(one, slow, 0.1)[0] for one in (knows, not_told)]
    assert found[0] < 0.7 * found[1]
