import numpy as np
import pytest
import scipy.signal
from truss import oscillator, truss

from wavequake.errors import UserError
from wavequake.mechanics.vibration.drive import Drive
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import displacements, respond
from wavequake.mechanics.vibration.state_space import state_space

ALL = np.ones(9, dtype=bool)
FORCES = np.zeros(9, dtype=bool)


def damped():
    """A body that a damper between two coordinates makes non-proportional."""
    extra = np.zeros((18, 18))
    extra[np.ix_([2, 17], [2, 17])] = 40.0 * np.array([[1, -1], [-1, 1]])
    return truss(damping=1e-5, extra=extra)


def transfer(system, s):
    return system.c @ np.linalg.solve(s * np.eye(len(system.a)) - system.a, system.b) + system.d


@pytest.mark.parametrize("frequency", [1.0, 97.0, 1300.0])
def test_transfer_matrix_of_forces_is_the_dynamic_compliance(frequency):
    body, s = damped(), 2j * np.pi * frequency
    found = transfer(state_space(modal_model(body), body.surface), s)
    expected = np.linalg.solve(s**2 * body.mass + s * body.damping_matrix + body.stiffness, body.inputs)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("frequency", [1.0, 97.0, 1300.0])
def test_transfer_matrix_of_prescribed_motion_solves_the_partitioned_equations(frequency):
    body, s = damped(), 2j * np.pi * frequency
    found = transfer(state_space(modal_model(body, ALL), body.surface), s)
    dynamic = s**2 * body.mass + s * body.damping_matrix + body.stiffness
    inner = -np.linalg.solve(dynamic[9:, 9:], dynamic[9:, :9])
    np.testing.assert_allclose(found, np.vstack([np.eye(9), inner]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("prescribed", [FORCES, ALL])
def test_python_control_simulates_the_same(prescribed):
    control = pytest.importorskip("control")
    body, time = damped(), 1e-4 * np.arange(300)
    samples = np.random.default_rng(1).standard_normal((300, 9)).cumsum(axis=0)
    modal = modal_model(body, prescribed)
    system = control.ss(*state_space(modal, body.surface))
    other = control.forced_response(system, time, samples.T).outputs
    found = displacements(respond(modal, [Drive(prescribed, samples=samples)], time), body.surface)[0]
    np.testing.assert_allclose(found, other.T, rtol=0, atol=1e-9 * np.abs(found).max())


def test_scipy_takes_the_tuple():
    body = oscillator(30.0, 0.1)
    system = scipy.signal.StateSpace(*state_space(modal_model(body), np.eye(1)))
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(system.A)), [-3 - 29.8496j, -3 + 29.8496j], rtol=0, atol=1e-4
    )


def test_bad_rows_are_named():
    modal = modal_model(truss())
    with pytest.raises(UserError, match="do not fit the 18 coordinates"):
        state_space(modal, np.eye(3))
