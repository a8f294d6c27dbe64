from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from truss import TOWER, truss

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.mechanics.model import rigid_modes
from wavequake.mechanics.multibody.floating_frame import floating_frame, momentum, split
from wavequake.mechanics.vibration.drive import Drive, Impulse
from wavequake.mechanics.vibration.modal import modal_model
from wavequake.mechanics.vibration.response import displacements, respond

WEIGHTS = 1.0 + 0.2 * np.arange(6)


def test_mass_center_and_inertia_are_those_of_the_points():
    frame = floating_frame(truss())
    center = WEIGHTS @ TOWER / WEIGHTS.sum()
    arm = TOWER - center
    inertia = np.einsum("k,kij->ij", WEIGHTS, (arm**2).sum(1)[:, None, None] * np.eye(3))
    inertia -= np.einsum("k,ki,kj->ij", WEIGHTS, arm, arm)
    assert frame.mass == pytest.approx(WEIGHTS.sum(), rel=1e-9)
    np.testing.assert_allclose(frame.center, center, rtol=0, atol=1e-9)
    np.testing.assert_allclose(frame.inertia, inertia, rtol=0, atol=1e-9 * inertia.max())
    np.testing.assert_allclose(frame.rigid, rigid_modes(TOWER, center), rtol=0, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_elastic_motion_carries_no_momentum(seed):
    body = truss()
    frame, motion = floating_frame(body), np.random.default_rng(seed).standard_normal((4, 18))
    rigid, elastic = split(frame, motion)
    linear = np.einsum("k,tkd->td", WEIGHTS, elastic.reshape(4, 6, 3))
    angular = np.einsum("k,tkd->td", WEIGHTS, np.cross(TOWER, elastic.reshape(4, 6, 3)))
    np.testing.assert_allclose(linear, 0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(angular, 0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(rigid @ frame.rigid.T + elastic, motion, rtol=0, atol=1e-12)
    np.testing.assert_allclose(frame.rigid.T @ body.mass @ elastic.T, 0, rtol=0, atol=1e-8)


def test_a_blow_moves_the_frame_as_newton_and_euler_say():
    body, time = truss(damping=0.0), np.linspace(0, 0.05, 200)
    push = np.zeros(9)
    push[5] = 2.0
    drive = Drive(np.zeros(9, dtype=bool), impulses=(Impulse(0.0, push),))
    frame = floating_frame(body)
    motion = displacements(respond(modal_model(body), [drive], time), np.eye(18))[0]
    rigid, _ = split(frame, motion)
    turn = np.linalg.solve(frame.inertia, np.cross(TOWER[1] - frame.center, [0, 0, 2.0]))
    expected = np.concatenate([[0, 0, 2.0 / frame.mass], turn])
    np.testing.assert_allclose(rigid, np.outer(time, expected), rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        momentum(frame, body, frame.rigid @ expected)[:3], [0, 0, 2.0], rtol=0, atol=1e-9
    )


def test_frame_of_a_flat_disc_is_that_of_a_cylinder():
    disc = circular_mirror(CircularMirror(focal_length=np.inf))
    frame = floating_frame(disc)
    assert frame.mass == pytest.approx(2700 * np.pi * 0.25 * 0.02, rel=1e-3)
    np.testing.assert_allclose(frame.center, [0, 0, -0.01], rtol=0, atol=1e-4)
    expected = np.diag([0.25 * 0.25 + 0.02**2 / 12, 0.25 * 0.25 + 0.02**2 / 12, 0.125]) * frame.mass
    np.testing.assert_allclose(frame.inertia, expected, rtol=0, atol=2e-3 * expected.max())


def test_bodies_that_are_not_free_are_refused():
    body = truss()
    with pytest.raises(UserError, match="0 motions without stiffness"):
        floating_frame(replace(body, stiffness=body.stiffness + 1e4 * np.eye(18)))
    with pytest.raises(UserError, match="not in one line"):
        floating_frame(truss(interfaces=(0, 1)))
    heavy = body.mass.copy()
    heavy[0, 0] *= 2
    with pytest.raises(UserError, match="differs between x, y and z"):
        floating_frame(replace(body, mass=heavy))
    with pytest.raises(UserError, match="not rigid at its interface"):
        floating_frame(replace(body, nodes=2 * TOWER[::-1]))
