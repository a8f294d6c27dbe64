"""Any linear controller on the boards' modes: against scipy's simulation of the controller itself."""

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import dlsim

from wavequake.control.linear import linear_model
from wavequake.control.linear_regulator import linear_regulator, read_controller
from wavequake.control.loop import commands_of
from wavequake.errors import UserError

RNG = np.random.default_rng(0)
READINGS = RNG.standard_normal(400)
LINES = np.exp(-0.01 + 1j * np.linspace(0.02, 0.7, 12))  # close pairs, as those of a Kalman filter


def sampled(a, b, c, d):
    return linear_model(a, b, c, d, 0.002)


def of_poles(poles, rng, through=0.0):
    blocks = [
        np.array([[p.real, p.imag], [-p.imag, p.real]]) if p.imag else np.array([[p.real]]) for p in poles
    ]
    size = sum(len(block) for block in blocks)
    a, at = np.zeros((size, size)), 0
    for block in blocks:
        a[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    return sampled(a, rng.standard_normal((size, 1)), rng.standard_normal((1, size)), [[through]])


CONTROLLERS = {
    "integrator": sampled([[1.0]], [[0.3]], [[1.0]], [[0.3]]),  # 0 at z = 0: no poles on top
    "integrator, a frame late": sampled([[1.0, 0.0], [1.0, 0.0]], [[0.3], [0.0]], [[0.0, 1.0]], [[0.0]]),
    "double integrator": sampled([[1.0, 1.0], [0.0, 1.0]], [[0.0], [0.3]], [[1.0, 0.0]], [[0.0]]),
    "three frames": sampled(np.eye(3, k=-1), [[1.0], [0.0], [0.0]], [[0.0, 0.0, 1.0]], [[0.0]]),
    "gain": sampled([[0.0]], [[0.0]], [[0.0]], [[0.7]]),
    "lines": of_poles(LINES, RNG),
    "lines, direct": of_poles(LINES, RNG, -2.0),
}


def of_regulator(controller):
    found = linear_regulator(controller)
    assert np.abs(found.step).max() < 1
    return commands_of(found, READINGS[None])[0]


def of_scipy(controller):
    parts = (controller.a, controller.b, controller.c, controller.d, controller.sample_time)
    return dlsim(parts, READINGS)[1][:, 0]


@pytest.mark.parametrize("name", CONTROLLERS)
def test_the_regulator_gives_the_controllers_commands(name):
    wanted = of_scipy(CONTROLLERS[name])
    assert np.abs(wanted).max() > 0.1
    assert np.abs(of_regulator(CONTROLLERS[name]) - wanted).max() < 1e-10 * np.abs(wanted).max()


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), size=st.integers(1, 10), radius=st.floats(0.05, 1.0))
def test_any_controller_that_does_not_grow(seed, size, radius):
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((size, size))
    a *= radius / np.abs(np.linalg.eigvals(a)).max()
    controller = sampled(
        a, rng.standard_normal((size, 1)), rng.standard_normal((1, size)), rng.standard_normal((1, 1))
    )
    wanted = of_scipy(controller)
    assert np.abs(of_regulator(controller) - wanted).max() < 1e-7 * np.abs(wanted).max()


def test_gains_are_small_enough_for_integers():
    for name in ("integrator", "integrator, a frame late", "double integrator", "gain"):
        found = linear_regulator(CONTROLLERS[name])
        assert np.abs([found.gain.real, found.gain.imag]).max() < 1


@pytest.mark.parametrize(
    ("controller", "words"),
    [
        (linear_model([[-1.0]], [[1.0]], [[1.0]]), "continuous"),
        (sampled([[0.5]], [[1.0, 1.0]], [[1.0]], None), "2 inputs and 1 outputs"),
        (sampled([[1.01]], [[1.0]], [[1.0]], None), "pole of magnitude 1.01"),
    ],
)
def test_controllers_that_no_board_can_run(controller, words):
    with pytest.raises(UserError, match=words):
        linear_regulator(controller)


GOOD = {
    "A": np.eye(2) / 2,
    "B": np.ones((2, 1)),
    "C": np.ones((1, 2)),
    "D": np.zeros((1, 1)),
    "sample_time_s": 0.002,
}


def packed(**arrays):
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def test_a_file_holds_a_controller():
    found = read_controller(packed(**GOOD))
    assert found.sample_time == 0.002
    np.testing.assert_array_equal(found.a, GOOD["A"])


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"A": None}, "it has no A;"),
        ({"sample_time_s": -1.0}, "one positive number"),
        ({"sample_time_s": [0.1, 0.2]}, "one positive number"),
        ({"sample_time_s": np.nan}, "one positive number"),
        ({"A": np.eye(3)}, r"A has shape \(3, 3\) and B \(2, 1\)"),
        ({"A": np.zeros((0, 0)), "B": np.zeros((0, 1))}, "n > 0"),
        ({"A": np.full((2, 2), np.inf)}, "A has entries that are not finite"),
        ({"D": np.ones((2, 2))}, "D has shape"),
        ({"B": np.array([["a"], ["b"]])}, "B holds <U1, not real numbers"),
        ({"C": np.ones((1, 2)) * 1j}, "C holds complex128"),
    ],
)
def test_files_that_hold_none(changed, words):
    arrays = {name: value for name, value in (GOOD | changed).items() if value is not None}
    with pytest.raises(UserError, match=words):
        read_controller(packed(**arrays))


def test_a_damaged_file_is_one_sentence():
    with pytest.raises(UserError, match=r"no NumPy \.npz file"):
        read_controller(b"PK not a zip")


def test_a_double_resonance_on_the_unit_circle_is_run_in_any_coordinates():
    """Rounding parts its double pole to both sides of the circle; commands are those of the matrices."""
    turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    basis = np.random.default_rng(3).standard_normal((4, 4))
    a = basis @ np.block([[turn, np.eye(2)], [np.zeros((2, 2)), turn]]) @ np.linalg.inv(basis)
    assert np.abs(np.linalg.eigvals(a)).max() > 1 + 1e-9
    b, c = basis @ np.array([[0.0], [0.0], [0.1], [0.0]]), np.array([[1.0, 0, 0, 0]]) @ np.linalg.inv(basis)
    made = linear_regulator(linear_model(a, b, c, np.zeros((1, 1)), 0.002))
    measured, state, wanted = np.random.default_rng(4).standard_normal(200), np.zeros(4), []
    for reading in measured:
        wanted.append((c @ state).item())
        state = a @ state + b[:, 0] * reading
    found = commands_of(made, measured[None])[0]
    np.testing.assert_allclose(found, wanted, atol=1e-6 * np.abs(wanted).max())


def test_a_controller_that_overflows_is_said_in_a_sentence():
    one = np.ones((1, 1))
    with pytest.raises(UserError, match="overflows"):
        linear_regulator(linear_model(0.5 * one, 1e200 * one, 1e200 * one, 0 * one, 0.002))
