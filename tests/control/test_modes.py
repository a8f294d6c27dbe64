"""Reports of observability on models whose hidden modes are known."""

import numpy as np
import pytest
from scipy.linalg import eigh, null_space

from wavequake.control.linear import linear_model, second_order_model
from wavequake.control.modes import check_stable, modes
from wavequake.errors import UserError
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.state_space import state_space
from wavequake.reduction.reduce import reduce


def chain(rows, inputs, masses=3):
    """Equal masses between walls: mode shapes are sines, so that the middle one is a node of mode 2."""
    stiffness = 100 * (2 * np.eye(masses) - np.eye(masses, k=1) - np.eye(masses, k=-1))
    return second_order_model(np.eye(masses), 1e-3 * stiffness, stiffness, inputs, rows)


def test_frequencies_are_those_of_the_chain():
    found = modes(chain(np.eye(3), np.eye(3)))
    np.testing.assert_allclose(
        [mode.omega for mode in found], 20 * np.sin(np.arange(1, 4) * np.pi / 8), rtol=1e-9
    )
    assert [mode.number for mode in found] == [1, 2, 3]
    assert all(mode.stable and min(mode.observability, mode.controllability) > 0.01 for mode in found)


def test_the_node_of_a_mode_neither_sees_nor_drives_it():
    found = modes(chain(np.array([[0.0, 1, 0]]), np.array([0.0, 1, 0])))
    assert [mode.observability > 1e-6 for mode in found] == [True, False, True]
    assert [mode.controllability > 1e-6 for mode in found] == [True, False, True]


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_units_of_the_coordinates_do_not_decide(unit):
    model = chain(np.array([[1.0, 0, 0]]), np.array([1.0, 0, 0]))
    scale = np.diag([unit, 1, 1 / unit, unit, 1, 1 / unit])
    scaled = linear_model(
        scale @ model.a @ np.linalg.inv(scale), scale @ model.b, model.c @ np.linalg.inv(scale)
    )
    assert all(mode.observability > 1e-3 and mode.controllability > 1e-3 for mode in modes(scaled))


def test_two_equal_oscillators_need_two_outputs():
    a = np.kron(np.eye(2), [[0, 1], [-4, -0.1]])
    one = modes(linear_model(a, np.eye(4), [[1, 0, 1, 0]]))
    two = modes(linear_model(a, np.eye(4), [[1, 0, 0, 0], [0, 0, 1, 0]]))
    assert len(one) == len(two) == 1
    assert one[0].observability == 0.0 < 0.1 < two[0].observability


def test_a_free_mass_is_seen_by_its_position_and_not_by_its_velocity():
    free = [[0, 1], [0, 0]]
    assert modes(linear_model(free, [[0], [1]], [[1, 0]]))[0].observability > 0.1
    assert modes(linear_model(free, [[0], [1]], [[0, 1]]))[0].observability < 1e-9


def test_an_unstable_mode_is_named():
    with pytest.raises(UserError, match=r"is unstable: mode 2 \(3 rad/s, 0.477 Hz\) grows, real part 0.15"):
        check_stable(
            linear_model(np.array([[-1, 0, 0], [0, 0, 1], [0, -9, 0.3]]), np.ones((3, 1)), np.ones((1, 3)))
        )


def test_modes_of_an_exported_reduced_mirror_are_its_own():
    model = circular_mirror(CircularMirror(core=3, rings=2))
    reduced = reduce(model, "craigb18")
    system = linear_model(*state_space(modal_model(reduced, np.ones(9, dtype=bool)), reduced.surface[::7]))
    held = null_space(reduced.inputs.T)
    inner = np.sqrt(eigh(held.T @ reduced.stiffness @ held, held.T @ reduced.mass @ held, eigvals_only=True))
    found = modes(system)
    apart = inner[np.append(True, np.diff(inner) > 1e-5 * inner[1:])]  # pairs are one mode
    np.testing.assert_allclose([mode.omega for mode in found], apart, rtol=1e-6)
    assert all(mode.stable and mode.observability > 1e-6 for mode in found)
