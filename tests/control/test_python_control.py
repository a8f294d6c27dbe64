"""Models that go to python-control and back: matrices, sample times, answers, and what has no way."""

import sys

import numpy as np
import pytest

from wavequake.control.bench import bench_model, fitted_bench
from wavequake.control.linear import frequency_response, linear_model, poles, zero_order_hold
from wavequake.control.python_control import from_control, to_control
from wavequake.errors import UserError
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.state_space import state_space
from wavequake.reduction.reduce import reduce

BENCH = bench_model(fitted_bench())


def peer():
    return pytest.importorskip("control", reason="needs python-control: pip install control")


@pytest.mark.parametrize("model", [BENCH, zero_order_hold(BENCH, 0.002)], ids=["continuous", "sampled"])
def test_there_and_back_nothing_changes(model):
    peer()
    system = to_control(model)
    found = from_control(system)
    for name in "abcd":
        np.testing.assert_array_equal(getattr(found, name), getattr(model, name))
    assert found.sample_time == model.sample_time
    assert system.isdtime(strict=True) is (model.sample_time is not None)


@pytest.mark.parametrize("step", [None, 0.002])
def test_python_control_answers_the_same(step):
    peer()
    omega = np.array([1.0, 21.0, 55.0, 300.0])
    model = BENCH if step is None else zero_order_hold(BENCH, step)
    found = np.moveaxis(to_control(model).frequency_response(omega, squeeze=False).frdata, -1, 0)
    wanted = frequency_response(model, omega)
    np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-9 * np.abs(wanted).max())


def test_a_reduced_mirror_goes_there_too():
    """Poles of the reduced model are natural frequencies, with its damping."""
    peer()
    body = reduce(circular_mirror(CircularMirror(core=3, rings=3)), "craigb18")
    model = linear_model(*state_space(modal_model(body), body.surface[:3]))
    found = to_control(model)
    assert (found.ninputs, found.noutputs, found.nstates) == (9, 3, len(model.a))
    order = lambda values: np.sort_complex(np.round(values, 3))  # noqa: E731
    np.testing.assert_allclose(order(found.poles()), order(poles(model)), rtol=1e-6, atol=1e-2)


def test_transfer_functions_come_as_state_spaces():
    control = peer()
    model = from_control(control.ss(control.tf([1.0], [1.0, 0.4, 4.0])))
    np.testing.assert_allclose(np.sort(np.abs(poles(model))), [2.0, 2.0])
    with pytest.raises(UserError, match=r"not TransferFunction; control\.ss makes one"):
        from_control(control.tf([1.0], [1.0, 0.4, 4.0]))


def test_a_system_without_sample_time_is_refused():
    control = peer()
    with pytest.raises(UserError, match="sampled but does not say how often"):
        from_control(control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], True))


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(UserError, match="pip install control"):
        to_control(BENCH)
