"""The reference's controllers against its equations, written out, and its statements."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_are

from wavequake.control.bench import bench_model, fitted_bench
from wavequake.control.hammer import HAMMER, impulse
from wavequake.control.loop import commands_of, stage_motion
from wavequake.control.sensor import quantized_command
from wavequake.control.stage import Stage
from wavequake.control.thesis import feed_forward, future_integration, kalman_filter
from wavequake.errors import UserError

BENCH = fitted_bench()


def test_filter_is_that_of_the_riccati_equation():
    model = bench_model(BENCH)
    c = model.c[1:]
    p = solve_continuous_are(model.a.T, c.T, 5e-8 * np.eye(22), [[1e-9]])
    residual = model.a @ p + p @ model.a.T - p @ c.T @ c @ p / 1e-9 + 5e-8 * np.eye(22)  # Eq. 2.23
    assert np.abs(residual).max() < 1e-9 * np.abs(model.a @ p).max()
    found = kalman_filter(BENCH)
    np.testing.assert_allclose(found.gain, (p @ c.T / 1e-9)[:, 0], rtol=1e-5, atol=1e-6)  # Eq. 2.22
    assert np.linalg.eigvals(found.a).real.max() < 0


def test_future_integration_is_equation_5_20():
    estimator, step = kalman_filter(BENCH, with_force=False), 0.008
    ahead = expm(estimator.a * step)
    driven = np.linalg.solve(estimator.a, ahead - np.eye(22)) @ estimator.b  # Eq. 5.19
    state = np.random.default_rng(1).normal(size=22) * 1e-3
    given = np.array([2e-4, 0.0])
    future = ahead @ ahead @ state + (ahead + np.eye(22)) @ driven @ given
    controller = future_integration(BENCH)
    command = controller.c @ state + controller.d @ given
    assert command == pytest.approx(-estimator.image @ future / 1.394, rel=1e-9)
    assert not controller.b[:, 1].any()


def test_ode3_limits_the_sample_time_of_the_feed_forward():
    """Störkle 2018, Section 5.4.1: FF runs at 2 ms and is unstable for longer steps."""
    feed_forward(BENCH, Stage(), 0.002)
    with pytest.raises(UserError, match=r"FF is unstable at a sample time of 4 ms.*spectral radius 6\."):
        feed_forward(BENCH, Stage(), 0.004)
    with pytest.raises(
        UserError, match=r"FF\+FI is unstable at a sample time of 8 ms.*radius 6\d\."
    ) as error:
        feed_forward(BENCH, Stage(), 0.008, ahead=2)
    longest = float(str(error.value).split("; ")[1].split(" ms")[0])
    assert 2.0 <= longest < 4.0
    feed_forward(BENCH, Stage(), longest / 1e3)


def test_a_hidden_mode_is_named():
    """Without springs, lens 6 swings by itself: lens 4 cannot see it."""
    springs = BENCH.lens_springs.copy()
    springs[5] = 0.0
    with pytest.raises(UserError, match=r"does not see mode 1 \(6\.26\d rad/s"):
        kalman_filter(replace(BENCH, lens_springs=springs))


def test_running_many_is_running_each():
    controller = feed_forward(BENCH, Stage())
    measured = np.random.default_rng(2).normal(size=(4, 50)) * 1e-3
    together = commands_of(controller, measured)
    state, alone = np.zeros(len(controller.a)), []
    handed = impulse(HAMMER, 0.002 * np.arange(51))  # until each step
    for k in range(50):
        v = np.array([measured[2, k], (handed[k + 1] - handed[k]) / 0.002])
        alone.append(controller.c @ state + controller.d @ v)
        state = controller.a @ state + controller.b @ v
    np.testing.assert_allclose(together[2], alone, rtol=1e-9, atol=1e-12)
    turned = commands_of(controller, np.roll(measured, 1, axis=0))
    np.testing.assert_array_equal(turned[3], together[2])


@pytest.mark.parametrize(("delay", "before"), [(0.001, 1), (0.00025, 1), (0.0053, 6)])
def test_stages_follow_held_commands_as_their_partial_fractions(delay, before):
    """Of each stage of a batch: states of its poles, in extended precision; zero at rest."""
    stages = [Stage(), Stage(poles=(-300.0, -400 + 250j, -400 - 250j), gain=1.02)]
    commands = 1e-3 * np.cumsum(np.random.default_rng(4).normal(size=(2, 300)), axis=1) / 5
    found = stage_motion(stages, commands, 0.002, delay, 1e-3, 500)
    assert not found[:, :before].any()
    late, gone = int(delay // 0.001), np.longdouble(delay) % np.longdouble(0.001)
    for stage, given, moved in zip(stages, quantized_command(commands), found, strict=True):
        poles = np.array(stage.poles, np.clongdouble)
        zeros = np.array(stage.zeros, np.clongdouble)
        through = (stage.gain * np.prod(poles) / np.prod(zeros)).real
        residues = np.array(
            [-p * stage.gain * np.prod(1 - p / zeros) / np.prod(1 - p / poles[poles != p]) for p in poles]
        )
        state, acting = np.zeros(3, np.clongdouble), np.longdouble(0)
        for k in range(500):
            # Between instants k - 1 and k a command acts `gone` s after the first, where one does.
            since = k - 1 - late
            for span in (gone, np.longdouble(0.001) - gone):
                state = np.exp(poles * span) * state + (np.exp(poles * span) - 1) / poles * acting
                if span is gone and since >= 0 and since % 2 == 0:
                    acting = np.longdouble(given[since // 2])
            if not gone and k >= late and (k - late) % 2 == 0:
                acting = np.longdouble(given[(k - late) // 2])
            exact = (residues * state).sum().real + through * acting
            assert abs(moved[k] - exact) < 1e-13 * np.ptp(given), k
