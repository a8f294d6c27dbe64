"""Runs of loops between instants: models by periods, ODE solvers, closed forms of noise, limits, bits."""

import numpy as np
import pytest
from sampled_loops import LINES, T, free, run_one, scalar, timing
from scipy.integrate import solve_ivp
from scipy.linalg import solve_discrete_lyapunov

from wavequake.control.linear import LinearModel, frequency_response, simulate
from wavequake.control.sampled.channel import (
    RIGID,
    Timing,
    first_order,
    sampled_channel,
    second_order,
    step_over,
)
from wavequake.control.sampled.filters import integrator, lqg
from wavequake.control.sampled.regulator import Stepped, model_of, shared_filter
from wavequake.control.sampled.run import Loop, frame_count, run, schedule
from wavequake.control.sampled.stability import (
    SampledLoop,
    plant_model,
)
from wavequake.errors import UserError

# In time.


@pytest.mark.parametrize("dynamics", [RIGID, first_order(90.0), second_order(120.0, 0.3)])
@pytest.mark.parametrize("latency", [0.0, 0.3, 1.0, 2.6])
def test_runs_are_those_of_the_loop_as_a_model_by_periods(dynamics, latency):
    """Steps from event to event against one matrix per period, with partial frames and two per command."""
    rng = np.random.default_rng(1)
    when = timing(latency, 0.6, 2)
    sees = np.eye(2) + 0.3 * rng.standard_normal((2, 2))
    regulator = shared_filter(np.linalg.inv(sees), integrator(0.1, leak=0.02, proportional=0.03))
    seen = rng.standard_normal((60, 2, 1))
    looks = np.linspace(0, 60 * T, 301)[1:]
    found = run_one(Loop(when, regulator, free(2, dynamics), sees), seen, looks)
    loop = SampledLoop(when, dynamics, sees, regulator)
    plant, own = plant_model(loop), model_of(regulator, when.period)
    # Commands from the disturbance alone: u = (1 - K G)^-1 K d, as one model.
    a = np.block([[plant.a + plant.b @ own.d @ plant.c, plant.b @ own.c], [own.b @ plant.c, own.a]])
    b = np.vstack([plant.b @ own.d, own.b])
    c, d = np.hstack([own.d @ plant.c, own.c]), own.d
    commands = simulate(LinearModel(a, b, c, d, when.period), seen[..., 0].reshape(30, 2, 2).mean(axis=1))
    # The positions between are those of an actuator that gets them late.
    n = len(dynamics)
    states, position, now, held = np.zeros((n, 2)), [], 0.0, np.zeros(2)
    acts = [(when.period * (k + 1) + when.latency, command) for k, command in enumerate(commands)]
    for at, command in sorted(
        [*acts, *((one, None) for one in looks)], key=lambda one: one[0] + 1e-7 * (one[1] is not None)
    ):
        step = step_over(dynamics, max(at - now, 0.0))
        states, now = step.phi @ states + step.gamma[:, None] * held, at
        if command is None:
            position.append(dynamics.c @ states if n else held)
        else:
            held = command
    np.testing.assert_allclose(
        found.positions[..., 0], np.array(position)[: len(looks)], rtol=1e-9, atol=1e-11
    )


def test_a_late_loop_is_that_of_an_ode_solver():
    """A sine, an integrator 0.37 frames late, a resonant actuator: solved piece by piece by DOP853."""
    dynamics, late, gain = second_order(140.0, 0.2), 0.37 * T, 0.25
    frames, w = 25, 2 * np.pi * 33.0
    ends = np.arange(1, frames + 1) * T
    seen = (np.cos(w * (ends - T)) - np.cos(w * ends)) / (w * T)
    looks = np.linspace(0, frames * T, 76)[1:]
    loop = Loop(timing(0.37), shared_filter(np.eye(1), integrator(gain)), free(1, dynamics), np.eye(1))
    found = run_one(loop, seen[:, None, None], looks).positions[:, 0, 0]

    state, command, held = np.zeros(3), 0.0, 0.0
    position = []
    edges = sorted({round(one, 13) for one in (*looks, *ends, *(ends + late))})
    now, waiting = 0.0, []
    for edge in (one for one in edges if one <= looks[-1] + 1e-12):
        if edge - now > 1e-12:

            def slope(_, y, held=held):
                return [*(dynamics.a @ y[:2] + dynamics.b * held), y[0]]

            state = solve_ivp(slope, (now, edge), state, rtol=1e-11, atol=1e-14, method="DOP853").y[:, -1]
            now = edge
        if np.abs(looks - edge).min() < 1e-12:
            position.append(state[0])
        if np.abs(ends - edge).min() < 1e-12:
            command -= gain * (seen[round(edge / T) - 1] + state[2] / T)
            state[2] = 0.0
            waiting.append(command)
        if np.abs(ends + late - edge).min() < 1e-12:
            held = waiting.pop(0)
    np.testing.assert_allclose(found, position, atol=1e-9)


@pytest.mark.parametrize(("n", "gain"), [(1, 0.5), (2, 0.3), (3, 0.2)])
def test_noise_is_passed_as_the_closed_forms_say(n, gain):
    """Variance of commands over that of the noise: g / (2 - g) and so on, of 400 000 frames."""
    g = gain
    wanted = {
        1: g / (2 - g),
        2: g * (1 + g) / ((1 - g) * (2 + g)),
        3: g * (1 + g - g * g) / ((2 - g) * (1 - g - g * g)),
    }[n]
    cases, frames = 200, 2000
    seen = np.random.default_rng(n).standard_normal((frames, 1, cases))
    looks = (np.arange(frames) + 0.99) * T
    loop = Loop(timing(n - 1), shared_filter(np.eye(1), integrator(g)), free(1), np.eye(1))
    power = (run_one(loop, seen, looks).positions[100:, 0] ** 2).mean(axis=0)
    assert abs(power.mean() - wanted) < 4 * power.std() / np.sqrt(cases)
    assert power.std() / np.sqrt(cases) < 0.01 * wanted


def test_more_looks_change_nothing_and_a_case_has_its_bits_alone():
    rng = np.random.default_rng(2)
    seen = rng.standard_normal((40, 3, 16))
    sees = np.eye(3) + 0.1 * rng.standard_normal((3, 3))
    loop = Loop(
        timing(0.45, 0.8), shared_filter(np.eye(3), integrator(0.3)), free(3, second_order(90.0, 0.5)), sees
    )
    looks = np.arange(1, 81) * (0.5 * T)
    whole_batch = run_one(loop, seen, looks)
    twice = run_one(loop, seen, np.arange(1, 161) * (0.25 * T))
    np.testing.assert_allclose(twice.positions[1::2], whole_batch.positions, rtol=0, atol=1e-13)
    alone = np.zeros_like(seen)
    alone[..., 5] = seen[..., 5]
    assert np.array_equal(run_one(loop, alone, looks).positions[..., 5], whole_batch.positions[..., 5])


def test_two_loops_of_different_rates_see_each_other():
    """A slow loop offloads a fast one: together they are the run of one sensor with both positions."""
    slow = Loop(
        Timing(4 * T, 4 * T, 1, 0.0), shared_filter(np.eye(1), integrator(0.2)), free(1), np.ones((1, 2))
    )
    fast = Loop(timing(), shared_filter(np.eye(1), integrator(0.4)), free(1), np.ones((1, 2)))
    frames = 400
    seen = [np.ones((frames, 1, 1)), np.ones((frames // 4, 1, 1))]
    looks = (np.arange(frames) + 0.5) * T
    found = run([fast, slow], schedule([fast.timing, slow.timing], looks), seen, frames)
    # By hand: both act right after their frames end.
    q, p, total, expected = 0.0, 0.0, 0.0, []
    for k in range(frames):
        expected.append((q, p))
        now = q
        total += 1.0 + q + p
        q -= 0.4 * (1.0 + now + p)
        if k % 4 == 3:
            p -= 0.2 * total / 4
            total = 0.0
    np.testing.assert_allclose(found.positions[:, :, 0], expected, atol=1e-12)


def test_limits_stuck_channels_and_steps_of_readings_do_what_they_say():
    looks = (np.arange(50) + 0.5) * T
    seen = np.full((50, 2, 1), 10.0)
    regulator = shared_filter(np.eye(2), integrator(0.5))
    limited = run_one(
        Loop(timing(), regulator, free(2, stroke=np.array([3.0, np.inf])), np.eye(2)), seen, looks
    )
    assert np.abs(limited.positions[:, 0]).max() == 3.0
    assert np.abs(limited.positions[-1, 1, 0] + 10.0) < 1e-9
    assert limited.limited[0] == 0.5
    slow = run_one(Loop(timing(), regulator, free(2, slew=0.25), np.eye(2)), seen, looks)
    assert np.abs(np.diff(slow.positions[:, 0, 0])).max() == pytest.approx(0.25)
    stuck = run_one(Loop(timing(), regulator, free(2, stuck=np.array([np.nan, 1.5])), np.eye(2)), seen, looks)
    assert (stuck.positions[:, 1] == 1.5).all()
    coarse = run_one(Loop(timing(), regulator, free(2), np.eye(2), quantum=4.0), seen, looks)
    # Readings are rounded to 4, so that what is left settles below half of it.
    assert 0.0 < 10.0 + coarse.positions[-1, 0, 0] <= 2.0


def test_a_function_is_a_controller_and_an_unstable_loop_diverges():
    def step(states, readings):
        states = states - 0.4 * readings
        return states, states

    looks, seen = (np.arange(300) + 0.5) * T, np.ones((300, 1, 16))
    own = run_one(Loop(timing(), Stepped(1, step), free(1), np.eye(1)), seen, looks)
    known = run_one(
        Loop(timing(), shared_filter(np.eye(1), integrator(0.4)), free(1), np.eye(1)), seen, looks
    )
    np.testing.assert_allclose(own.positions, known.positions, rtol=1e-13)
    wild = run_one(
        Loop(timing(1), shared_filter(np.eye(1), integrator(3.0)), free(1), np.eye(1)), seen, looks
    )
    assert wild.diverged.all()
    assert not own.diverged.any()


def test_frames_that_end_by_rounding_alone_count():
    assert frame_count(Timing(0.001, 0.001, 1, 0.0), 0.1) == 100
    assert frame_count(Timing(1 / 3, 1 / 3, 1, 0.0), 1.0) == 3


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: lqg(LINES, 0.0, RIGID, timing()), "needs a positive one"),
        (lambda: lqg(LINES, 1.0, RIGID, timing(integration=0.5)), "averages over whole frames"),
        (lambda: sampled_channel(RIGID, Timing(T, T, 1, -T)), "cannot be negative"),
    ],
)
def test_what_cannot_be_is_said(make, words):
    with pytest.raises(UserError) as caught:
        make()
    assert words in str(caught.value)


# Three ways to one number.


@pytest.mark.parametrize("latency", [0.0, 0.35, 1.6])
def test_what_noise_does_is_one_number_by_covariance_by_frequency_and_in_time(latency):
    """Variance of commands under white noise of the readings: Lyapunov, integral of |T|^2, 160 runs."""
    loop = scalar(0.3, latency, second_order(130.0, 0.4), leak=0.02)
    plant, own = plant_model(loop), model_of(loop.regulator, T)
    a = np.block([[plant.a + plant.b @ own.d @ plant.c, plant.b @ own.c], [own.b @ plant.c, own.a]])
    b, c = np.vstack([plant.b @ own.d, own.b]), np.hstack([own.d @ plant.c, own.c])
    states = solve_discrete_lyapunov(a, b @ b.T)
    exact = float((c @ states @ c.T + own.d @ own.d.T)[0, 0])

    hertz = (np.arange(4000) + 0.5) * 250.0 / 4000
    h, g = (frequency_response(one, 2 * np.pi * hertz)[:, 0, 0] for one in (own, plant))
    assert np.mean(np.abs(h / (1 - h * g)) ** 2) == pytest.approx(exact, rel=1e-9)

    # In time: frame means of the position, by 20 looks a frame.
    frames, cases = 1500, 160
    seen = np.random.default_rng(7).standard_normal((frames, 1, cases))
    run_in = Loop(loop.timing, loop.regulator, free(1, loop.dynamics), np.eye(1))
    looked = run_one(run_in, seen, np.arange(1, 20 * frames + 1) * (T / 20)).positions[:, 0]
    power = (looked.reshape(frames, 20, cases).mean(axis=1)[200:] ** 2).mean(axis=0)
    of_plant = states[: len(plant.a), : len(plant.a)]
    wanted = float((plant.c @ of_plant @ plant.c.T)[0, 0])
    assert abs(power.mean() - wanted) < 4 * power.std() / np.sqrt(cases)
    assert power.std() / np.sqrt(cases) < 0.01 * wanted
