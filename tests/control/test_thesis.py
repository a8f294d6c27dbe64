"""The reference's controllers against its equations, written out, and its statements."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_are

from wavequake.control.bench import bench_model, fitted_bench
from wavequake.control.hammer import HAMMER, impulse
from wavequake.control.loop import run_thesis, stage_motion
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
    together = run_thesis(controller, measured)
    state, alone = np.zeros(len(controller.a)), []
    handed = impulse(HAMMER, 0.002 * np.arange(51))  # until each step
    for k in range(50):
        v = np.array([measured[2, k], (handed[k + 1] - handed[k]) / 0.002])
        alone.append(controller.c @ state + controller.d @ v)
        state = controller.a @ state + controller.b @ v
    np.testing.assert_allclose(together[2], alone, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(run_thesis(controller, measured[1:3])[1], together[2])


def test_stage_follows_a_step_as_its_partial_fractions():
    """Step response gain (1 + Σ r_j e^{p_j t}), delayed; zero at rest."""
    stage = Stage()
    commands = np.full((1, 60), 8e-3)
    found = stage_motion(stage, commands, 0.002, 0.001, 1e-3, 100)[0]
    poles = np.array(stage.poles)
    s = [np.prod([1 - p / z for z in stage.zeros]) for p in poles]
    residues = [
        top / np.prod([1 - p / other for other in poles if other != p])
        for top, p in zip(s, poles, strict=True)
    ]
    time = 1e-3 * np.arange(100) - 0.001
    exact = 1 + sum(-r * np.exp(p * time) for r, p in zip(residues, poles, strict=True))
    np.testing.assert_allclose(found[2:], 8e-3 * 0.97 * exact.real[2:], rtol=0, atol=1e-9)
    assert found[0] == 0.0
    with pytest.raises(UserError, match=r"0\.25 ms is no multiple"):
        stage_motion(stage, commands, 0.002, 0.00025, 1e-3, 100)
