"""Sampling and transfer functions against closed forms, integration and python-control."""

from importlib import import_module

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from wavequake.control.linear import (
    bogacki_shampine,
    first_order_hold,
    frequency_response,
    in_series,
    linear_model,
    second_order_model,
    simulate,
    spectral_radius,
    static_gain,
    zero_order_hold,
)
from wavequake.errors import UserError

OSCILLATOR = linear_model([[0, 1], [-25.0, -0.6]], [[0], [2.0]], [[1.0, 0.1]], [[0.3]])
INTEGRATOR = linear_model([[0, 1], [0, 0]], [[0], [1.0]], [[1, 0]])


def integrated(model, held, step, count):
    """Integrate with a held or straight input between samples, outputs at the samples."""
    state, outputs = np.zeros(len(model.a)), []
    for k in range(count):
        outputs.append(model.c @ state + model.d[:, 0] * held(k, 0.0))
        solution = solve_ivp(
            lambda t, x, k=k: model.a @ x + model.b[:, 0] * held(k, t / step),
            (0, step), state, rtol=1e-10, atol=1e-12,
        )  # fmt: skip
        state = solution.y[:, -1]
    return np.array(outputs)


@pytest.mark.parametrize("model", [OSCILLATOR, INTEGRATOR], ids=["oscillator", "double integrator"])
@pytest.mark.parametrize("ramp", [False, True], ids=["held", "straight"])
def test_holds_are_exact(model, ramp):
    inputs = np.array([0.0, 1.0, -0.5, 0.8, 0.1, 0.0, 0.3])
    sampled = (first_order_hold if ramp else zero_order_hold)(model, 0.2)
    expected = integrated(
        model, lambda k, s: inputs[k] + ramp * s * (inputs[k + 1] - inputs[k]), 0.2, len(inputs) - 1
    )
    np.testing.assert_allclose(simulate(sampled, inputs)[:-1], expected, rtol=0, atol=1e-8)


def test_ode3_converges_with_its_order_and_follows_the_published_tableau():
    def stages(a, h, x):
        k1 = a @ x
        k2 = a @ (x + h / 2 * k1)
        k3 = a @ (x + 3 * h / 4 * k2)
        return x + h / 9 * (2 * k1 + 3 * k2 + 4 * k3)

    h = 0.05
    step = bogacki_shampine(OSCILLATOR, h).a
    np.testing.assert_allclose(step, np.column_stack([stages(OSCILLATOR.a, h, x) for x in np.eye(2)]))
    errors = [
        np.abs(bogacki_shampine(OSCILLATOR, h).b - zero_order_hold(OSCILLATOR, h).b).max()
        for h in (0.01, 0.005)
    ]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.2)  # local error


def test_ode3_is_unstable_beyond_its_stability_limit():
    decay = linear_model([[-1.0]], [[1.0]], [[1.0]])
    assert spectral_radius(bogacki_shampine(decay, 2.5127)) == pytest.approx(1.0, abs=1e-4)
    assert spectral_radius(bogacki_shampine(decay, 3.0)) == pytest.approx(2.0)


def test_frequency_response_of_an_oscillator():
    omega = np.array([0.0, 3.0, 5.0, 40.0])
    model = second_order_model(np.eye(1) * 2, np.eye(1) * 0.4, np.eye(1) * 50, np.ones(1), np.ones((1, 1)))
    np.testing.assert_allclose(
        frequency_response(model, omega)[:, 0, 0], 1 / (50 - 2 * omega**2 + 0.4j * omega), rtol=1e-12
    )
    assert static_gain(model)[0, 0] == pytest.approx(1 / 50)


def test_sampled_models_agree_with_python_control():
    control = import_module("control")
    system = control.ss(OSCILLATOR.a, OSCILLATOR.b, OSCILLATOR.c, OSCILLATOR.d)
    omega = np.array([0.5, 3.0, 9.0])
    for kind, ours in (("zoh", zero_order_hold), ("foh", first_order_hold)):
        theirs = control.sample_system(system, 0.1, kind)
        np.testing.assert_allclose(
            frequency_response(ours(OSCILLATOR, 0.1), omega)[:, 0, 0], theirs(np.exp(0.1j * omega)), rtol=1e-9
        )


def test_series_multiplies_transfer_functions():
    omega = np.array([0.3, 4.0, 11.0])
    product = frequency_response(OSCILLATOR, omega) ** 2
    np.testing.assert_allclose(frequency_response(in_series(OSCILLATOR, OSCILLATOR), omega), product)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: linear_model([[1, 2]], [[1]], [[1]]), "A has shape"),
        (lambda: linear_model([[np.nan]], [[1]], [[1]]), "A has entries that are not finite"),
        (lambda: linear_model([[1]], [[1]], [[1]], [1, 2]), "D has shape"),
        (lambda: zero_order_hold(OSCILLATOR, 0.0), "must be positive"),
        (lambda: zero_order_hold(zero_order_hold(OSCILLATOR, 0.1), 0.1), "sampled already"),
        (lambda: simulate(OSCILLATOR, [1.0]), "continuous"),
        (lambda: static_gain(INTEGRATOR), "integrates"),
        (lambda: in_series(OSCILLATOR, linear_model([[1]], [[1, 1]], [[1]])), "do not fit"),
        (lambda: second_order_model(np.zeros((1, 1)), *[np.eye(1)] * 3, np.ones((1, 1))), "singular"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(UserError, match=words):
        call()
