"""Sensors that follow what they read with dynamics of their own, against ODE solvers and closed forms."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from wavequake.control.sampled.channel import (
    Timing,
    acceleration,
    first_order,
    in_series,
    sampled_channel,
    second_order,
)
from wavequake.control.sampled.filters import integrator
from wavequake.control.sampled.readings import BLOCK, means
from wavequake.control.sampled.regulator import shared_filter
from wavequake.control.sampled.run import Actuator, Loop, run, schedule

T = 0.002
SENSORS = {
    "electronics": first_order(70.0),
    "acceleration": acceleration(180.0, 0.6),
    "both": in_series(acceleration(180.0, 0.6), first_order(300.0)),
}


def read_by_ode(sensor, drive, edges, begins, ends):
    """Integrate states and reading piece by piece; `drive` is smooth between edges and at rest before."""
    n = len(sensor)
    at = np.unique(np.concatenate([edges, begins, ends]))
    state = np.append(sensor.at_rest * drive(0.0), 0.0)
    whole = {0.0: 0.0}
    for first, last in pairwise(at):

        def slope(t, y):
            u = drive(t)
            return [*(sensor.a @ y[:n] + sensor.b * u), sensor.c @ y[:n] + sensor.d * u]

        state = solve_ivp(slope, (first, last), state, rtol=1e-11, atol=1e-13, method="DOP853").y[:, -1]
        whole[last] = state[-1]
    return np.array([(whole[b] - whole[a]) / (b - a) for a, b in zip(begins, ends, strict=True)])


@pytest.mark.parametrize("name", SENSORS)
def test_means_of_what_a_sensor_gives_of_straight_lines_are_those_of_an_ode_solver(name):
    time = np.array([0.0, 0.7, 1.9, 2.0, 5.3, 8.0]) * T
    values = np.array([1.0, 1.4, -0.6, 0.3, 0.9, -1.2])
    ends = np.arange(1, 9) * T
    begins = ends - 0.6 * T
    found = means(time, np.column_stack([values, -2 * values]), begins, ends, SENSORS[name])
    wanted = read_by_ode(SENSORS[name], lambda t: np.interp(t, time, values), time, begins, ends)
    scale = np.abs(wanted).max()
    np.testing.assert_allclose(found[:, 0], wanted, rtol=0, atol=1e-8 * scale)
    np.testing.assert_allclose(found[:, 1], -2 * wanted, rtol=0, atol=1e-8 * scale)


def test_an_accelerometer_shows_the_second_derivative_of_what_is_slow():
    """Of a sine of 3 Hz: -w^2 of its mean, to (3/400)^2 and the chords of the sine."""
    w, rate = 2 * np.pi * 3.0, 1 / T
    time = np.arange(0, 1.0 + 1e-9, 1 / (20 * rate))
    ends = np.arange(1, 501) * T
    found = means(time, np.sin(w * time)[:, None], ends - T, ends, acceleration(400.0, 0.7))[100:, 0]
    late = 1.4 / (2 * np.pi * 400.0)  # 2 zeta / w0, by which a proof mass lags
    mean = (np.cos(w * (ends - T - late)) - np.cos(w * (ends - late))) / (w * T)
    np.testing.assert_allclose(found, -(w**2) * mean[100:], rtol=0, atol=2e-3 * w**2)
    assert acceleration(400.0, 0.7).static_gain == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("hertz", [30.0, 60.0, 120.0])
def test_frames_that_begin_an_ulp_before_the_last_one_ended_read_what_they_should(hertz):
    """Also where blocks of frames meet: what stands still is read as it is."""
    ends = np.arange(1, 1000) / hertz
    begins = ends - 1 / hertz
    assert (begins[BLOCK::BLOCK] < ends[BLOCK - 1 : -1 : BLOCK]).any()
    found = means(np.array([0.0, ends[-1]]), np.ones((2, 1)), begins, ends, first_order(7.0))
    np.testing.assert_allclose(found, 1.0, rtol=0, atol=1e-9)


def test_a_fast_sensor_reads_plain_means():
    rng = np.random.default_rng(5)
    time, values = np.linspace(0, 8 * T, 9), rng.standard_normal((9, 3))
    ends = np.arange(1, 9) * T
    plain = means(time, values, ends - T, ends)
    for hertz in (1e4, 1e6):  # what it lags by is what it changes by, times its time constant
        far = np.ptp(values) / (2 * np.pi * hertz * T)
        off = np.abs(means(time, values, ends - T, ends, first_order(hertz)) - plain).max()
        assert 0.1 * far < off < far


@pytest.mark.parametrize("name", SENSORS)
def test_a_loop_through_a_slow_sensor_is_that_of_an_ode_solver(name):
    """A resonant actuator, a filter of the reading, half a frame of averaging, 0.4 frames of latency."""
    sensor, dynamics, late = SENSORS[name], second_order(140.0, 0.2), 0.4 * T
    gain = 0.3 if sensor.static_gain > 0.5 else 2e-7
    frames, rng = 20, np.random.default_rng(8)
    ends, seen = np.arange(1, frames + 1) * T, rng.standard_normal(frames)
    looks = np.linspace(0, frames * T, 41)[1:]
    actuator = Actuator(dynamics, np.full(2, np.inf), np.inf, np.array([np.nan, 0.3]))
    timing = Timing(T, 0.5 * T, 1, late)
    regulator = shared_filter(np.array([[1.0], [0.0]]), integrator(gain))
    sees = np.array([[1.0, 0.5]])
    loop = Loop(timing, regulator, actuator, sees, sensor=sensor)
    found = run([loop], schedule([timing], looks), [seen[:, None, None]], len(looks)).positions

    joint, n = in_series(dynamics, sensor), len(dynamics) + len(sensor)
    state, command, held, now, waiting, position = np.zeros(n + 1), 0.0, 0.0, 0.0, [], []
    edges = sorted({round(one, 13) for one in (*looks, *(ends - 0.5 * T), *ends, *(ends + late))})
    for edge in (one for one in edges if one <= looks[-1] + 1e-12):

        def slope(_, y, held=held):
            q = dynamics.c @ y[: len(dynamics)]
            own = y[len(dynamics) : n]
            return [
                *(dynamics.a @ y[: len(dynamics)] + dynamics.b * held),
                *(sensor.a @ own + sensor.b * q),
                sensor.c @ own + sensor.d * q,
            ]

        if edge - now > 1e-12:
            state = solve_ivp(slope, (now, edge), state, rtol=1e-11, atol=1e-14, method="DOP853").y[:, -1]
            now = edge
        if np.abs(looks - edge).min() < 1e-12:
            position.append(dynamics.c @ state[: len(dynamics)])
        if np.abs(ends - 0.5 * T - edge).min() < 1e-12:
            state[n] = 0.0
        if np.abs(ends - edge).min() < 1e-12:
            stuck = 0.5 * 0.3 * sensor.static_gain
            command -= gain * (seen[round(edge / T) - 1] + state[n] / (0.5 * T) + stuck)
            waiting.append(command)
        if np.abs(ends + late - edge).min() < 1e-12:
            held = waiting.pop(0)
    np.testing.assert_allclose(found[:, 0, 0], position, rtol=0, atol=1e-8 * np.abs(position).max())
    np.testing.assert_allclose(found[:, 1, 0], 0.3)
    # By periods it is the actuator with the sensor behind it.
    assert len(sampled_channel(joint, timing).a) == n + 2
