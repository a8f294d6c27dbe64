"""The control package beside python-control: filter, holds, placement, series, rank tests on the lens bench.

Where both call the same function of SciPy, this still compares signs, transposes and what a gain multiplies.
"""

import numpy as np
import pytest

from wavequake.control.bench import bench_model, fitted_bench
from wavequake.control.gains import (
    kalman_bucy_gain,
    kalman_gain,
    placed_observer,
    placed_regulator,
    regulator_gain,
)
from wavequake.control.linear import (
    first_order_hold,
    frequency_response,
    in_series,
    linear_model,
    static_gain,
    zero_order_hold,
)
from wavequake.control.modes import modes
from wavequake.control.stage import Stage, all_pass_inverse, stage_model
from wavequake.control.thesis import PROCESS_NOISE, SENSOR_NOISE

control = pytest.importorskip("control", reason="needs python-control: pip install control")

BENCH = bench_model(fitted_bench())
SEEN = linear_model(BENCH.a, BENCH.b, BENCH.c[1:])
STAGE = stage_model(Stage())
OMEGA = np.array([1.0, 20.0, 44.0, 80.0, 300.0])


def peer(model):
    return control.ss(model.a, model.b, model.c, model.d)


def response(system):
    return np.moveaxis(control.frequency_response(system, OMEGA, squeeze=False).frdata, -1, 0)


def test_regulator_and_filter_of_the_bench():
    weight, cost = 100 * np.eye(22), np.array([[1e-2]])
    wanted = control.lqr(SEEN.a, SEEN.b, weight, cost)[0]
    np.testing.assert_allclose(
        regulator_gain(SEEN, 100.0, 1e-2), wanted, rtol=1e-6, atol=1e-6 * np.abs(wanted).max()
    )
    noise = PROCESS_NOISE * np.eye(22), np.array([[SENSOR_NOISE]])
    wanted = control.lqe(SEEN.a, np.eye(22), SEEN.c, *noise)[0]
    found = kalman_bucy_gain(SEEN, PROCESS_NOISE, SENSOR_NOISE)
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-6 * np.abs(wanted).max())


def test_sampled_filter_of_the_bench():
    """The peer's gain predicts, x := A x + L (y - C x); one of ours corrects before the step, so L = A M."""
    sampled = zero_order_hold(SEEN, 0.002)
    wanted = control.dlqe(sampled.a, np.eye(22), sampled.c, 1e-10 * np.eye(22), np.array([[1e-9]]))[0]
    found = sampled.a @ kalman_gain(sampled.a, sampled.c, 1e-10, 1e-9)
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-6 * np.abs(wanted).max())


@pytest.mark.parametrize(("hold", "name"), [(zero_order_hold, "zoh"), (first_order_hold, "foh")])
@pytest.mark.parametrize("model", [BENCH, STAGE], ids=["bench", "stage"])
def test_holds(hold, name, model):
    found = frequency_response(hold(model, 0.002), OMEGA)
    wanted = response(control.sample_system(peer(model), 0.002, name))
    np.testing.assert_allclose(found, wanted, rtol=1e-7, atol=1e-7 * np.abs(wanted).max())


def test_placement_on_the_stage():
    """The peer's is Ackermann's formula; one input leaves the gain no freedom."""
    wished = [-300.0, -200 + 100j, -200 - 100j]
    pairs = (
        (placed_regulator(STAGE, wished)[0], control.acker(STAGE.a, STAGE.b, wished)),
        (placed_observer(STAGE, wished)[:, 0], control.acker(STAGE.a.T, STAGE.c.T, wished)),
    )
    for found, wanted in pairs:
        np.testing.assert_allclose(found, np.ravel(wanted), rtol=1e-7)


def test_series_and_static_gain():
    """The stage behind its all-pass inverse (Störkle 2018, Eq. 5.21)."""
    inverse = all_pass_inverse(Stage())
    joint, wanted = in_series(inverse, STAGE), control.series(peer(inverse), peer(STAGE))
    np.testing.assert_allclose(frequency_response(joint, OMEGA), response(wanted), rtol=1e-9)
    np.testing.assert_allclose(static_gain(joint), control.dcgain(wanted), rtol=1e-9)


@pytest.mark.parametrize("hidden", [False, True])
def test_hidden_modes_are_those_that_the_rank_misses(hidden):
    """Two oscillators; by Kalman's rank test, too, one is hidden if the output takes the other alone."""
    a = np.array([[0, 1, 0, 0], [-4, -0.1, 0, 0], [0, 0, 0, 1], [0, 0, -9, -0.3]])
    model = linear_model(a, [[0], [1], [0], [1.0]], [[1, 0, 0.0 if hidden else 1.0, 0]])
    lost = sum(mode.observability < 1e-9 for mode in modes(model))
    assert np.linalg.matrix_rank(control.obsv(model.a, model.c)) == 4 - 2 * lost
    assert np.linalg.matrix_rank(control.ctrb(model.a, model.b)) == 4
    assert min(mode.controllability for mode in modes(model)) > 1e-3
    assert lost == hidden
