"""Loops on a structure that answers what actuators do: other code, ODE solvers, python-control, low rank."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from wavequake.control.python_control import to_control
from wavequake.control.sampled.alike import apart
from wavequake.control.sampled.channel import Timing, acceleration, first_order, recoil, second_order
from wavequake.control.sampled.filters import integrator
from wavequake.control.sampled.flexible import FlexibleLoop, Structure, poles, reduced
from wavequake.control.sampled.flexible_left import flexible_margins
from wavequake.control.sampled.regulator import model_of, shared_filter, whole
from wavequake.control.sampled.run import Actuator, Loop, run, schedule
from wavequake.control.sampled.stability import (
    SampledLoop,
    controller_model,
    plant_model,
    sampled_margins,
    worst_pole,
)

T = 0.02
WHEN = Timing(T, T, 1, 0.7 * T)
SERVO = second_order(20.0, 0.5)


def mirror(gain=0.12, modes=30, seed=0):
    """Return one loop as two parts of the package have it."""
    shapes = np.linalg.qr(np.random.default_rng(seed).standard_normal((modes, 3)))[0]
    hertz, zeta, shares = np.array([6.0, 9.0, 17.0]), np.array([0.01, 0.02, 0.01]), np.array([0.05, 0.1, 0.3])
    gains = np.full(modes, gain)
    flexible = reduced(FlexibleLoop(WHEN, SERVO, gains, 0.0, Structure(hertz, zeta, shares, shapes)))
    loop = SampledLoop(
        WHEN,
        SERVO,
        np.eye(modes),
        shared_filter(np.eye(modes), integrator(gain)),
        tuple(recoil(*one) for one in zip(hertz, zeta, strict=True)),
        shares[:, None] * shapes.T,
        shapes,
    )
    return flexible, loop


@pytest.mark.parametrize("gain", [0.05, 0.12, 0.4])
def test_a_loop_on_a_structure_has_the_poles_and_margins_of_the_segments_loop(gain):
    flexible, loop = mirror(gain)
    values = poles(flexible)
    assert abs(worst_pole(loop).value) == pytest.approx(np.abs(values).max(), rel=1e-9)
    if np.abs(values).max() >= 1:
        assert gain == 0.4
        return
    wanted, found = flexible_margins(flexible), sampled_margins(loop)
    for name in ("peak", "gain_up", "phase", "delay", "last_omega"):
        assert getattr(found, name) == pytest.approx(getattr(wanted, name), rel=1e-4), name


@pytest.mark.parametrize("place", [0, 3, 15])
def test_a_stuck_channel_is_as_good_as_none(place):
    """Its integrator, which reads what the structure does there, is seen by nothing."""
    loop, free = mirror(0.05)[1], np.arange(30) != place
    stuck = replace(loop, sees=loop.sees * free, drives=loop.drives * free)
    without = replace(
        loop,
        sees=loop.sees[free][:, free],
        drives=loop.drives[:, free],
        shown=loop.shown[free],
        regulator=shared_filter(np.eye(29), integrator(0.05)),
    )
    assert abs(worst_pole(stuck).value) == pytest.approx(abs(worst_pole(without).value), abs=1e-12)
    assert worst_pole(stuck).growth < 0.0
    wanted, found = sampled_margins(without), sampled_margins(stuck)
    for name in ("peak", "gain_up", "phase", "delay", "last_omega"):
        assert getattr(found, name) == pytest.approx(getattr(wanted, name), rel=1e-9), name


@pytest.mark.parametrize("seed", [0, 1, 3, 7])
def test_integrators_that_nothing_needs_leave_the_gain_margin(seed):
    """Four commands of three readings: one direction stands still, at a pole of size 1 but for rounding."""
    sees = np.random.default_rng(seed).standard_normal((3, 4))
    shared = shared_filter(np.linalg.pinv(sees), integrator(0.25))
    loop = SampledLoop(WHEN, SERVO, sees, shared)
    own = replace(loop, regulator=whole(model_of(shared, T)))
    assert sampled_margins(own).gain_up == pytest.approx(sampled_margins(loop).gain_up, rel=1e-6)


def test_what_is_alike_is_left_out_exactly():
    """Poles and margins by a few directions against all channels one by one."""
    random = np.random.default_rng(3)
    loop = mirror(modes=40)[1]
    rank = 0.1 * random.standard_normal((40, 2)) @ random.standard_normal((2, 40))
    skewed = replace(loop, sees=np.eye(40) + rank)
    # Three of the channels are never commanded: their integrators are no loops.
    left = random.standard_normal((40, 37))
    unused = left @ np.linalg.pinv(left)
    for one, kept in ((loop, 3), (skewed, 7)):
        parts = apart(one.sees, one.shown, one.drives)
        assert parts.value == 1.0
        assert len(parts.inner) == kept
        back = (
            parts.value * np.eye(40)
            + parts.basis @ (parts.inner - parts.value * np.eye(kept)) @ parts.basis.T
        )
        np.testing.assert_allclose(back, one.sees, atol=1e-12)
        together = replace(one, regulator=whole(model_by_channels(one)))
        assert worst_pole(one).value.real == pytest.approx(worst_pole(together).value.real, rel=1e-8)
        gain = 0.999 * sampled_margins(one).gain_up
        assert abs(worst_pole(together, gain).value) < 1 < abs(worst_pole(together, gain / 0.998).value)
    few = replace(loop, regulator=shared_filter(unused, integrator(0.12)))
    assert abs(worst_pole(few).value) < 1 - 1e-6
    assert sampled_margins(few).gain_up > 1


def model_by_channels(loop):
    found = controller_model(loop)
    return replace(found, c=-found.c, d=-found.d)


def test_a_matrix_of_which_nothing_is_alike_stays_whole():
    sees = np.random.default_rng(1).standard_normal((30, 30))
    assert apart(sees, np.zeros((30, 0)), np.zeros((0, 30))).value is None


def test_poles_and_gain_margin_on_a_structure_are_those_of_python_control():
    control = pytest.importorskip("control", reason="needs python-control: pip install control")
    _, loop = mirror(modes=3)
    random = np.random.default_rng(2)
    regulator = shared_filter(np.eye(3) + 0.2 * random.standard_normal((3, 3)), integrator(0.1, 0.01))
    loop = replace(loop, sees=np.eye(3) + 0.1 * random.standard_normal((3, 3)), regulator=regulator)
    plant, own = to_control(plant_model(loop)), to_control(controller_model(loop))
    assert np.abs(control.feedback(plant, own).poles()).max() == pytest.approx(
        abs(worst_pole(loop).value), rel=1e-9
    )
    up = sampled_margins(loop).gain_up
    for factor, stable in ((1 - 1e-5, True), (1 + 1e-5, False)):
        poles = control.feedback(factor * up * plant, own).poles()
        assert (np.abs(poles).max() < 1) == stable


def test_a_structure_answers_nothing_at_rest_and_the_opposite_of_what_is_fast():
    mode = recoil(10.0, 0.02)
    assert mode.static_gain == pytest.approx(0.0, abs=1e-12)
    assert mode.d == -1.0
    s = 2j * np.pi * 4.0
    w = 2 * np.pi * 10.0
    gain = mode.c @ np.linalg.solve(s * np.eye(2) - mode.a, mode.b) + mode.d
    assert gain == pytest.approx(-(s**2 + 0.04 * w * s) / (s**2 + 0.04 * w * s + w**2), rel=1e-12)


@pytest.mark.parametrize("sensor", [first_order(30.0), acceleration(60.0, 0.7)])
def test_runs_on_a_structure_are_those_of_an_ode_solver(sensor):
    """Two loops of different rates move a structure that both sensors see; DOP853 between all events."""
    modes = (recoil(7.0, 0.02), recoil(16.0, 0.03))
    timings = (Timing(T, 0.6 * T, 1, 0.4 * T), Timing(2 * T, 2 * T, 1, 0.0))
    scale = 1e-4 if sensor.d else 1.0
    sensors, dynamics = (first_order(200.0), sensor), (SERVO, first_order(25.0))
    drives = (np.array([[0.2, 0.1], [0.0, 0.3]]), np.array([[0.15], [-0.1]]))
    sees = (
        np.array([[1.0, 0.1, 0.2, 1.0, 0.5], [0.0, 1.0, 0.1, -0.4, 1.0]]),
        scale * np.array([[0.1, 0.0, 1.0, 0.7, 1.0]]),
    )
    gains, random = (0.1, 0.05), np.random.default_rng(4)
    loops, seen = [], []
    for k in range(2):
        count = len(drives[k].T)
        moved = Actuator(dynamics[k], np.full(count, np.inf), np.inf, np.full(count, np.nan))
        regulator = shared_filter(np.eye(count), integrator(gains[k]))
        loops.append(Loop(timings[k], regulator, moved, sees[k], 0.0, sensors[k], drives[k]))
        seen.append(random.standard_normal((20 // (k + 1), count, 1)))
    looks = np.array([0.011, 0.1, 0.173, 0.4])
    found = run(loops, schedule(timings, looks), seen, len(looks), modes).positions[..., 0]
    np.testing.assert_allclose(found, by_hand(loops, modes, seen, looks), rtol=1e-8, atol=1e-9)
    assert np.abs(found[-1, 3:]).max() > 1e-3


def by_hand(loops, modes, seen, looks):
    """Integrate commands, actuators, modes (one for all that drive it) and sensors as one system."""
    commands = [np.zeros(len(one.drives.T)) for one in loops]
    integrators = [np.zeros(len(one.drives.T)) for one in loops]
    n_a = [len(one.actuator.dynamics) * len(one.drives.T) for one in loops]
    n_s = [len(one.sensor) * len(one.sees) for one in loops]
    starts = np.cumsum([0, *n_a, 2 * len(modes), *n_s, *(len(one.sees) for one in loops)])

    def channels(x):
        found = []
        for k, one in enumerate(loops):
            own, p = one.actuator.dynamics, len(commands[k])
            found.append(own.c @ x[starts[k] : starts[k + 1]].reshape(-1, p) + own.d * commands[k])
        return found

    def all_of(x):
        q = channels(x)
        along = sum(one.drives @ values for one, values in zip(loops, q, strict=True))
        states = x[starts[2] : starts[3]].reshape(-1, 2)
        answered = [m.c @ z + m.d * u for m, z, u in zip(modes, states, along, strict=True)]
        return along, np.concatenate([*q, answered])

    def rates(_, x):
        along, positions = all_of(x)
        parts = []
        for k, one in enumerate(loops):
            own, p = one.actuator.dynamics, len(commands[k])
            parts.append(
                (own.a @ x[starts[k] : starts[k + 1]].reshape(-1, p) + np.outer(own.b, commands[k])).ravel()
            )
        states = x[starts[2] : starts[3]].reshape(-1, 2)
        parts.append(
            np.concatenate([m.a @ z + m.b * u for m, z, u in zip(modes, states, along, strict=True)])
        )
        given = []
        for k, one in enumerate(loops):
            m, read = len(one.sees), one.sees @ positions
            z = x[starts[3 + k] : starts[4 + k]].reshape(-1, m)
            parts.append((one.sensor.a @ z + np.outer(one.sensor.b, read)).ravel())
            given.append(one.sensor.c @ z + one.sensor.d * read)
        return np.concatenate([*parts, *given])

    events = [(at, 3, 0) for at in looks]
    for k, one in enumerate(loops):
        when = one.timing
        for frame in range(1, len(seen[k]) + 1):
            end = frame * when.frame
            events += [(end, 1, k), (end + when.latency, 2, k)]
            if when.integration < when.frame:
                events.append((end - when.integration, 0, k))
    x, now, found, waiting, frames = np.zeros(starts[-1]), 0.0, [], [[], []], [0, 0]
    for at, kind, k in sorted((round(at, 12), kind, k) for at, kind, k in events):
        if at > looks[-1]:
            break
        if at > now:
            x = solve_ivp(rates, (now, at), x, method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
            now = at
        total = slice(starts[5 + k], starts[6 + k]) if kind < 2 else slice(0, 0)
        if kind == 0:
            x[total] = 0.0
        elif kind == 1:
            reading = seen[k][frames[k], :, 0] + x[total] / loops[k].timing.integration
            frames[k] += 1
            x[total] = 0.0
            gain = -loops[k].regulator.b[0, 0, 0]
            integrators[k] = integrators[k] - gain * reading
            waiting[k].append(integrators[k].copy())
        elif kind == 2:
            commands[k] = waiting[k].pop(0)
        else:
            found.append(all_of(x)[1])
    return np.array(found)
