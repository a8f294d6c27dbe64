"""Loops between instants: closed forms of actuators, delays and gains, ODE solvers, python-control."""

import numpy as np
import pytest
from sampled_loops import LINES, T, scalar, timing
from scipy.integrate import solve_ivp

from wavequake.control.frames import controllers, residual
from wavequake.control.frames.disturbance import sampled
from wavequake.control.frames.margins import frame_margins
from wavequake.control.linear import LinearModel
from wavequake.control.python_control import to_control
from wavequake.control.sampled.channel import (
    RIGID,
    first_order,
    sampled_channel,
    second_order,
    step_over,
)
from wavequake.control.sampled.filters import crossover_gain, integrator, lqg
from wavequake.control.sampled.regulator import Regulator, model_of, shared_filter, whole
from wavequake.control.sampled.stability import (
    SampledLoop,
    controller_model,
    curve,
    plant_model,
    sampled_margins,
    worst_pole,
)

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


@pytest.mark.parametrize("latency", [0, 1, 2, 3])
def test_margins_read_off_a_curve_are_the_closed_forms_within_what_its_steps_show(latency):
    """Without latency the margin lies at half the rate, where no curve is drawn."""
    n, gain, hertz = latency + 1, 0.1, np.geomspace(0.25, 250.0, 200)
    found = curve(scalar(gain, latency), hertz)
    assert gain * found.gain_up == pytest.approx(2 * np.sin(np.pi / (2 * (2 * n - 1))), rel=2e-4)
    assert found.phase == pytest.approx(np.pi / 2 - (2 * n - 1) * np.arcsin(gain / 2), rel=2e-4)


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
    found = curve(scalar(0.3, 1), hertz)
    rejection, passed = found.rejection, found.passed
    inside = hertz < 250.0
    wanted = residual.loop_gain(controllers.integrator(0.3, 2), T, hertz[inside])
    for gain in found.gain.T:  # the only eigenvalue has both margins
        np.testing.assert_allclose(gain[inside], wanted, rtol=1e-9)
        assert np.isnan(gain[~inside]).all()
    squares = residual.sensitivity(controllers.integrator(0.3, 2), T, hertz[inside])
    np.testing.assert_allclose(rejection[inside] ** 2, squares[0], rtol=1e-9)
    np.testing.assert_allclose(passed[inside] ** 2, squares[1], rtol=1e-9)


def test_curves_are_those_of_the_directions_that_have_the_margins():
    """Of two directions the faster one is unstable first; far from there the slower one is nearer to -1."""
    late, early = 1.2, 0.3
    hertz = np.append(np.geomspace(0.1, 249.0, 400), 250.0)
    sees = np.diag([late, early])
    found = curve(SampledLoop(timing(1), RIGID, sees, shared_filter(np.eye(2), integrator(0.5))), hertz)
    one = curve(scalar(0.5 * late, 1), hertz)
    assert found.gain_up == pytest.approx(one.gain_up, rel=1e-9)
    assert found.phase == pytest.approx(one.phase, rel=1e-9)
    np.testing.assert_allclose(found.gain, one.gain, rtol=1e-9)
    # The nearest to -1 is the other direction somewhere: a curve of these would jump.
    loci = one.gain[:, 0] * np.array([[1.0], [early / late]])
    assert len(set(np.abs(1 + loci).argmin(axis=0))) == 2


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


def test_a_bandwidth_is_where_the_loop_gain_is_one():
    gain = crossover_gain(40.0, T)
    found = sampled_margins(scalar(gain))
    assert found.last_omega == pytest.approx(2 * np.pi * 40.0, rel=0.01)
