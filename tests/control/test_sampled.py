"""Loops between instants: closed forms of gain, delay and noise, ODE solvers, python-control, and bits."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import solve_discrete_lyapunov

from wavequake.control.frames import controllers, residual
from wavequake.control.frames.disturbance import joined, line, sampled
from wavequake.control.frames.margins import frame_margins
from wavequake.control.linear import LinearModel, frequency_response, simulate
from wavequake.control.python_control import to_control
from wavequake.control.sampled.channel import (
    RIGID,
    Timing,
    first_order,
    sampled_channel,
    second_order,
    step_over,
)
from wavequake.control.sampled.filters import crossover_gain, integrator, lqg
from wavequake.control.sampled.regulator import Regulator, Stepped, model_of, shared_filter, whole
from wavequake.control.sampled.run import Actuator, Loop, frame_count, run, schedule
from wavequake.control.sampled.stability import (
    SampledLoop,
    controller_model,
    curve,
    plant_model,
    sampled_margins,
    worst_pole,
)
from wavequake.errors import UserError

T = 0.002
LINES = joined([line(12.0, 0.2, 3.0), line(30.0, 0.2, 2.0)])


def timing(latency=0.0, integration=1.0, frames=1):
    return Timing(T, integration * T, frames, latency * frames * T)


def free(count, dynamics=RIGID, **limits):
    kept = {"stroke": np.full(count, np.inf), "slew": np.inf, "stuck": np.full(count, np.nan)}
    return Actuator(dynamics, **(kept | limits))


def scalar(gain, latency=0.0, dynamics=RIGID, **keys):
    loop = shared_filter(np.eye(1), integrator(gain, **keys))
    return SampledLoop(timing(latency), dynamics, np.eye(1), loop)


def run_one(loop, seen, looks):
    """Run one loop on what its sensor sees, (frames, m, cases)."""
    return run([loop], schedule([loop.timing], looks), [seen], len(looks))


# Between events.


@pytest.mark.parametrize("dynamics", [first_order(80.0), second_order(150.0, 0.1), second_order(60.0, 1.0)])
def test_a_step_is_that_of_an_ode_solver_and_of_its_two_halves(dynamics):
    rng = np.random.default_rng(3)
    x, u, span = rng.standard_normal(len(dynamics)), 0.7, 0.0037
    found = step_over(dynamics, span)

    def slope(_, y):
        return [*(dynamics.a @ y[:-1] + dynamics.b * u), dynamics.c @ y[:-1]]

    wanted = solve_ivp(slope, (0, span), [*x, 0.0], rtol=1e-12, atol=1e-15, method="DOP853").y[:, -1]
    np.testing.assert_allclose(found.phi @ x + found.gamma * u, wanted[:-1], rtol=1e-9)
    assert found.row @ x + found.through * u == pytest.approx(wanted[-1], rel=1e-9)
    first, then = step_over(dynamics, 0.3 * span), step_over(dynamics, 0.7 * span)
    middle = first.phi @ x + first.gamma * u
    np.testing.assert_allclose(then.phi @ middle + then.gamma * u, wanted[:-1], rtol=1e-9)
    halves = first.row @ x + first.through * u + then.row @ middle + then.through * u
    assert halves == pytest.approx(wanted[-1], rel=1e-9)


def test_actuators_have_no_static_error():
    for dynamics in (first_order(50.0), second_order(200.0, 0.3)):
        assert -dynamics.c @ np.linalg.solve(dynamics.a, dynamics.b) == pytest.approx(1.0, abs=1e-12)


# Stability and margins.


@pytest.mark.parametrize("latency", [0, 1, 2, 3])
def test_whole_delays_have_the_closed_forms_of_an_integrator(latency):
    """Largest gain 2 sin(pi / (2 (2 n - 1))), phase pi / 2 - (2 n - 1) asin(g / 2), n = 1 + latency."""
    n, gain = latency + 1, 0.1
    found = sampled_margins(scalar(gain, latency))
    assert gain * found.gain_up == pytest.approx(2 * np.sin(np.pi / (2 * (2 * n - 1))), rel=1e-9)
    assert found.phase == pytest.approx(np.pi / 2 - (2 * n - 1) * np.arcsin(gain / 2), rel=1e-9)
    if n == 1:
        assert found.peak == pytest.approx(2 / (2 - gain), rel=1e-9)


@pytest.mark.parametrize("late", [0.1, 0.25, 0.4, 0.49, 0.75, 0.9])
def test_fractions_of_a_frame_have_the_closed_form(late):
    """g z^-1 (1 - d + d z^-1) / (1 - z^-1) is stable below min(1 / d, 2 / (1 - 2 d))."""
    limit = min(1 / late, 2 / (1 - 2 * late)) if late < 0.5 else 1 / late
    assert 0.1 * sampled_margins(scalar(0.1, late)).gain_up == pytest.approx(limit, rel=1e-8)
    assert worst_pole(scalar(0.999 * limit, late)).growth < 0 < worst_pole(scalar(1.001 * limit, late)).growth


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_lqg_of_a_pure_delay_is_the_predictor_by_frames(frames):
    known = sampled(LINES, T)
    wanted = controllers.predictor(known, 1.0, frames)
    model = lqg(LINES, 1.0, RIGID, timing(frames - 1))
    loop = SampledLoop(timing(frames - 1), RIGID, np.eye(1), shared_filter(np.eye(1), model))
    assert abs(worst_pole(loop).value) == pytest.approx(residual.spectral_radius(wanted), rel=1e-9)
    found, known_margins = sampled_margins(loop), frame_margins(wanted, T)
    for name in ("gain_up", "phase", "delay"):
        assert getattr(found, name) == pytest.approx(getattr(known_margins, name), rel=1e-8)
    # The transfer from readings to commands, over frequency.
    hertz = np.linspace(1.0, 249.0, 40)
    z = np.exp(2j * np.pi * hertz * T)[:, None, None]
    own = LinearModel(model.a, model.b, model.c, model.d, T)
    plant = sampled_channel(RIGID, timing(frames - 1))
    gains = [
        one.c @ np.linalg.solve(z * np.eye(len(one.a)) - one.a, one.b.astype(complex)) + one.d
        for one in (plant, own)
    ]
    np.testing.assert_allclose(
        -(gains[0] * gains[1]).ravel(), residual.loop_gain(wanted, T, hertz), rtol=1e-8, atol=1e-12
    )


def test_margins_are_those_of_python_control():
    control = pytest.importorskip("control", reason="needs python-control: pip install control")
    rng = np.random.default_rng(5)
    sees = np.eye(3) + 0.2 * rng.standard_normal((3, 3))
    regulator = shared_filter(np.eye(3), integrator(0.2, leak=0.01, proportional=0.05))
    loop = SampledLoop(timing(0.7, 0.6, 2), second_order(120.0, 0.4), sees, regulator)
    plant, own = to_control(plant_model(loop)), to_control(controller_model(loop))
    poles = control.feedback(plant, own).poles()
    assert np.abs(poles).max() == pytest.approx(abs(worst_pole(loop).value), rel=1e-9)
    found = sampled_margins(loop)
    for factor, stable in ((1 - 1e-5, True), (1 + 1e-5, False)):
        poles = control.feedback(factor * found.gain_up * plant, own).poles()
        assert (np.abs(poles).max() < 1) == stable
    turn = np.exp(1j * found.phase)
    omega = 2 * np.pi * np.linspace(0, 125.0, 40_001)[1:]  # to half the rate of commands
    gain = control.frequency_response(own * plant, omega).frdata.transpose(2, 0, 1)
    turned = min(np.abs(np.linalg.det(np.eye(3) + gain * one)).min() for one in (turn, np.conj(turn)))
    assert turned < 1e-3 < np.abs(np.linalg.det(np.eye(3) + gain)).min()
    sizes = np.linalg.norm(np.linalg.inv(np.eye(3) + gain), 2, axis=(1, 2))
    assert found.peak == pytest.approx(sizes.max(), rel=1e-4)


def test_curves_of_a_pure_delay_are_those_by_frames():
    hertz = np.geomspace(0.1, 300.0, 50)
    gain, rejection, passed = curve(scalar(0.3, 1), hertz)
    inside = hertz < 250.0
    wanted = residual.loop_gain(controllers.integrator(0.3, 2), T, hertz[inside])
    np.testing.assert_allclose(gain[inside], wanted, rtol=1e-9)
    squares = residual.sensitivity(controllers.integrator(0.3, 2), T, hertz[inside])
    np.testing.assert_allclose(rejection[inside] ** 2, squares[0], rtol=1e-9)
    np.testing.assert_allclose(passed[inside] ** 2, squares[1], rtol=1e-9)
    assert np.isnan(gain[~inside]).all()


def test_channels_that_share_a_filter_have_the_poles_of_the_whole_loop():
    rng = np.random.default_rng(8)
    sees, decoupling = rng.standard_normal((4, 3)), 0.3 * rng.standard_normal((3, 4))
    model = integrator(0.3, leak=0.02)
    shared = shared_filter(decoupling, model)
    each = Regulator(
        decoupling, *(np.repeat(one, 3, axis=0) for one in (shared.a, shared.b, shared.c, shared.d))
    )
    loops = [
        SampledLoop(timing(1.4), first_order(200.0), sees, one)
        for one in (shared, each, whole(model_of(shared, T)))
    ]
    found = [worst_pole(one) for one in loops]
    for one in found[1:]:
        assert one.value.real == pytest.approx(found[0].value.real, rel=1e-9)
        assert one.channels.argmax() == found[0].channels.argmax()


def test_what_a_regulator_cannot_move_is_no_loop():
    decoupling = np.diag([1.0, 0.0])
    loop = SampledLoop(timing(), RIGID, np.eye(2), shared_filter(decoupling, integrator(0.5)))
    assert worst_pole(loop).value == pytest.approx(0.5)


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


def test_a_bandwidth_is_where_the_loop_gain_is_one():
    gain = crossover_gain(40.0, T)
    found = sampled_margins(scalar(gain))
    assert found.last_omega == pytest.approx(2 * np.pi * 40.0, rel=0.01)


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
