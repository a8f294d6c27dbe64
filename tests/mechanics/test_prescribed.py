from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from truss import TOWER, model, oscillator, truss

from wavequake.errors import UserError
from wavequake.mechanics.model import rigid_modes
from wavequake.mechanics.vibration.drive import Drive, Harmonic, ramped_sine
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.prescribed import static_lift
from wavequake.mechanics.vibration.response import displacements, respond

ALL = np.ones(9, dtype=bool)
FORCES = np.zeros(9, dtype=bool)


def flags(*places):
    chosen = np.zeros(9, dtype=bool)
    chosen[list(places)] = True
    return chosen


def test_slow_rigid_motion_of_all_interfaces_moves_the_body_rigidly():
    """What moves 1e4 times slower than the body's first mode sees a rigid body."""
    body = truss(damping=1e-4)
    modal = modal_model(body, ALL)
    rows = rigid_modes(TOWER, TOWER[0])
    pattern = 1e-3 * np.array([1.0, -2, 0.5, 0.3, 0.2, -0.4])
    slow = 1e-4 * np.sqrt(modal.squared[0])
    time = np.linspace(0, 4 * np.pi / slow, 200)
    drive = Drive(ALL, ramped_sine(slow, (rows @ pattern)[:9], np.pi / slow))
    found = displacements(respond(modal, [drive], time), body.surface)[0]
    swing = np.sin(0.5 * np.pi * np.minimum(time * slow / np.pi, 1)) ** 2 * np.sin(slow * time)
    np.testing.assert_allclose(
        found, np.outer(swing, rows @ pattern), rtol=0, atol=1e-6 * np.abs(pattern).max()
    )


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), places=st.sets(st.integers(0, 8), min_size=6, max_size=9))
def test_prescribed_directions_move_as_told(seed, places):
    body, chosen = truss(), flags(*places)
    try:
        modal = modal_model(body, chosen)
    except UserError as error:
        assert "without stiffness" in str(error)  # noqa: PT017 - six directions need not hold a body
        return
    random = np.random.default_rng(seed)
    samples = random.standard_normal((50, 9)).cumsum(axis=0)
    found = displacements(
        respond(modal, [Drive(chosen, samples=samples)], 1e-3 * np.arange(50)), body.inputs.T
    )
    size = np.abs(samples).max()
    np.testing.assert_allclose(found[0][:, chosen], samples[:, chosen], rtol=0, atol=1e-9 * size)


def test_oscillator_on_a_shaken_base():
    """Two masses, the first one shaken: the second obeys the textbook base excitation."""
    k, d, omega = 900.0, 1.2, 21.0
    pair = np.array([[1.0, -1.0], [-1.0, 1.0]])
    body = model(np.diag([5.0, 1.0]), d * pair, k * pair, [[1.0], [0.0]])
    drive = Drive(np.ones(1, dtype=bool), ramped_sine(omega, np.ones(1), 0.0))
    time = np.linspace(0, 40, 4000)
    found = displacements(respond(modal_model(body, np.ones(1, dtype=bool)), [drive], time), np.eye(2))[0]
    steady = (k + 1j * omega * d) / (k - omega**2 + 1j * omega * d)
    late = time > 35
    np.testing.assert_allclose(
        found[late, 1], (steady * np.exp(1j * omega * time[late])).imag, rtol=0, atol=1e-8
    )
    np.testing.assert_allclose(found[:, 0], np.sin(omega * time), rtol=0, atol=1e-12)


def test_prescribing_is_the_limit_of_a_heavy_base():
    """A direction moved by the force m w'' on a base of mass m errs as 1 / m; w = (1 - cos omega t) / 2."""
    body, chosen, omega, zero = truss(damping=1e-5), flags(0, 1, 2, 4, 5, 6, 7, 8), 300.0, np.zeros(9)
    unit, time = np.eye(9)[4], np.linspace(0, 0.02, 101)
    waves = (Harmonic(0.0, 0.0, 0.5 * unit, zero), Harmonic(omega, 0.0, -0.5 * unit, zero))
    moved = displacements(respond(modal_model(body, chosen), [Drive(chosen, waves)], time), body.surface)[0]
    errors = []
    for heavy in (1e6, 1e7):
        base = modal_model(replace(body, mass=body.mass + heavy * np.diag(np.append(chosen, FORCES))))
        push = Harmonic(omega, 0.0, 0.5 * omega**2 * heavy * unit, zero)
        found = displacements(respond(base, [Drive(FORCES, (push,))], time), body.surface)[0]
        errors.append(np.abs(found - moved).max())
    assert errors[1] < 1e-4
    assert errors[0] / errors[1] == pytest.approx(10.0, rel=0.01)


def test_eigenfrequencies_of_the_held_body_are_those_of_the_struck_matrix():
    body = truss()
    modal = modal_model(body, ALL)
    inner = np.linalg.inv(np.diag(np.diag(body.mass)[9:])) @ body.stiffness[9:, 9:]
    np.testing.assert_allclose(modal.squared, np.sort(np.linalg.eigvals(inner).real), rtol=1e-9)
    assert not modal.free.any()
    assert modal_model(body).free.sum() == 6


def test_static_lift_is_orthogonal_to_what_remains():
    body = truss()
    motions, lift = static_lift(body.stiffness, body.inputs.T, "truss")
    np.testing.assert_allclose(body.inputs.T @ lift, np.eye(9), rtol=0, atol=1e-12)
    np.testing.assert_allclose(body.inputs.T @ motions, 0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(motions.T @ body.stiffness @ lift, 0, rtol=0, atol=1e-6)


@pytest.mark.parametrize("places", [(2, 5, 8), (0, 1, 2, 3, 4, 5)])
def test_a_prescribed_set_that_leaves_a_mechanism_is_refused(places):
    with pytest.raises(UserError, match="without stiffness"):
        modal_model(truss(), flags(*places))


def test_directions_that_the_model_cannot_move_are_refused():
    body = truss()
    inputs = body.inputs.copy()
    inputs[:, 8] = inputs[:, 7]
    with pytest.raises(UserError, match="dependent"):
        modal_model(replace(body, inputs=inputs), ALL)
    with pytest.raises(UserError, match="too few"):
        modal_model(model(np.eye(2), np.zeros((2, 2)), np.eye(2), np.ones((2, 9))), ALL)


def test_bad_models_are_refused():
    good = truss()
    nan = good.stiffness.copy()
    nan[0, 0] = np.nan
    skew = good.damping_matrix.copy()
    skew[0, 1] += 1e6
    singular = good.mass.copy()
    singular[0, 0] = 0.0
    bad = {
        "not finite": replace(good, stiffness=nan),
        "not symmetric": replace(good, damping_matrix=skew),
        "not positive definite": replace(good, mass=singular),
        "unstable": replace(good, stiffness=good.stiffness - 1e5 * np.eye(18)),
        "negative in some direction, so its vibration would grow": replace(
            good, damping_matrix=-good.damping_matrix
        ),
        "reduce the model first": replace(good, mass=np.zeros((3001, 1))),
    }
    for match, body in bad.items():
        with pytest.raises(UserError, match=match):
            modal_model(body)
    with pytest.raises(UserError, match="one flag for each of its 9"):
        modal_model(good, np.ones(3, dtype=bool))


def test_a_single_prescribed_coordinate_leaves_nothing_to_vibrate():
    modal = modal_model(oscillator(3.0, 0.0), np.ones(1, dtype=bool))
    found = respond(modal, [Drive(np.ones(1, dtype=bool), samples=np.ones((5, 1)))], np.linspace(0, 1, 5))
    assert (displacements(found, np.eye(1)) == 1.0).all()
