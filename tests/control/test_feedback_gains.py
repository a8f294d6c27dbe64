"""Gains against closed forms, python-control and the noise that they are optimal for."""

from importlib import import_module

import numpy as np
import pytest

from wavequake.control.gains import (
    kalman_bucy_gain,
    kalman_gain,
    placed_observer,
    placed_regulator,
    regulator_gain,
)
from wavequake.control.linear import linear_model, zero_order_hold
from wavequake.errors import UserError

DOUBLE = linear_model([[0, 1], [0, 0]], [[0], [1.0]], [[1, 0]])
CHAIN = linear_model(
    [[0, 0, 1, 0], [0, 0, 0, 1], [-9, 4, -0.1, 0], [4, -16, 0, -0.2]], [[0], [0], [1], [0.5]], [[0, 1, 0, 0]]
)
# Two equal oscillators, of which input and output know the first alone.
HIDDEN = linear_model(
    [[0, 1, 0, 0], [-4, -0.1, 0, 0], [0, 0, 0, 1], [0, 0, -9, 0.3]],
    [[0], [1], [0], [0]],
    [[1, 0, 0, 0]],
)


def test_regulator_of_the_double_integrator():
    # Closed form: K = (sqrt(q/r), sqrt(2 sqrt(q/r))).
    np.testing.assert_allclose(regulator_gain(DOUBLE, [9.0, 0.0], 4.0), [[1.5, np.sqrt(3)]], rtol=1e-9)


def test_filter_of_a_random_walk():
    walk = linear_model([[0.0]], [[1.0]], [[1.0]])
    assert kalman_bucy_gain(walk, 4.0, 0.25)[0, 0] == pytest.approx(4.0)
    # Sampled: P = M + q, M = P r / (P + r), gain P / (P + r); with q = r it is the inverse golden ratio.
    assert kalman_gain(np.eye(1), np.eye(1), 0.3, 0.3)[0, 0] == pytest.approx((np.sqrt(5) - 1) / 2)


def test_gains_agree_with_python_control():
    control = import_module("control")
    q, r = np.diag([1.0, 2, 3, 4]), 0.3
    np.testing.assert_allclose(
        regulator_gain(CHAIN, q, r), control.lqr(CHAIN.a, CHAIN.b, q, [[r]])[0], rtol=1e-7
    )
    np.testing.assert_allclose(
        kalman_bucy_gain(CHAIN, q, r), control.lqe(CHAIN.a, np.eye(4), CHAIN.c, q, [[r]])[0], rtol=1e-7
    )


def test_no_other_gain_of_the_sampled_filter_has_a_smaller_error():
    """The covariance of the filtered error, from the Lyapunov recursion alone, is least at the gain."""
    a, c, q, r = zero_order_hold(CHAIN, 0.1).a, CHAIN.c, 1e-3 * np.eye(4), np.array([[1e-2]])

    def error(gain):
        covariance, keep = np.eye(4), np.eye(4) - gain @ c
        for _ in range(3000):
            covariance = keep @ (a @ covariance @ a.T + q) @ keep.T + gain @ r @ gain.T
        return np.trace(covariance)

    gain = kalman_gain(a, c, q, r)
    rng = np.random.default_rng(3)
    for _ in range(6):
        assert error(gain + 0.02 * rng.normal(size=gain.shape)) > error(gain)


def test_poles_are_placed():
    wanted = np.array([-1.0, -2.0, -3 + 1j, -3 - 1j])
    for closed in (
        CHAIN.a - CHAIN.b @ placed_regulator(CHAIN, wanted),
        CHAIN.a - placed_observer(CHAIN, wanted) @ CHAIN.c,
    ):
        np.testing.assert_allclose(
            np.sort_complex(np.linalg.eigvals(closed)), np.sort_complex(wanted), rtol=0, atol=1e-6
        )


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: placed_observer(HIDDEN, [-1, -2, -3, -4]), r"does not see mode 2 \(3 rad/s"),
        (lambda: placed_regulator(HIDDEN, [-1, -2, -3, -4]), r"does not drive mode 2 \(3 rad/s"),
        (lambda: kalman_bucy_gain(HIDDEN, 1.0, 1.0), r"does not see mode 2 \(3 rad/s.*grows"),
        (lambda: regulator_gain(HIDDEN, 1.0, 1.0), r"does not drive mode 2 \(3 rad/s.*grows"),
        (lambda: regulator_gain(CHAIN, [1.0, 2.0], 1.0), "Q must be a number, 4 numbers"),
        (lambda: regulator_gain(CHAIN, 1.0, 0.0), "R must be positive definite"),
        (lambda: kalman_bucy_gain(CHAIN, -1.0, 1.0), "Q must be finite and without negative"),
        (lambda: placed_observer(CHAIN, [-1.0]), "1 poles are given"),
        (lambda: placed_observer(CHAIN, [-1.0] * 4), "cannot be placed"),
        (
            lambda: kalman_gain(2 * np.eye(2), np.array([[1.0, 0]]), 1.0, 1.0),
            "does not see the mode of 0 turns",
        ),
    ],
)
def test_designs_that_cannot_be_are_refused(call, words):
    with pytest.raises(UserError, match=words):
        call()
