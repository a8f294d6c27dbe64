import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from wavequake.errors import UserError
from wavequake.optics.shapes.shapes import Conic, GridDeformation, ZernikeDeformation
from wavequake.optics.systems.kinematics import (
    Break,
    SurfaceRow,
    absolute_poses,
    motion_about,
    moved_poses,
    relative_changes,
    relative_poses,
    rest_poses,
    rest_states,
    sequential,
)
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface

seeds = st.integers(0, 2**32 - 1)


def random_poses(seed, instants=3, count=5):
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(instants * count, rng=rng).as_matrix().reshape(instants, count, 3, 3)
    return rng.normal(size=(instants, count, 3)) * 1e3, rotation


def folded():
    return sequential(
        [
            SurfaceRow("stop", thickness=1874.9721),
            SurfaceRow("M1", Conic(-60e3, -1.0009535), -27093.75, "reflect"),
            SurfaceRow("M2", Conic(-6227.68, -1.31822813), 23593.75, "reflect"),
            Break(tilt=(0.0, np.pi / 4, 0.0)),
            SurfaceRow("M3", action="reflect"),
            Break((-14142.136, 0.0, -14142.136)),
            Break(tilt=(0.0, np.pi / 4, 0.0)),
            SurfaceRow("image"),
        ]
    )


@settings(deadline=None)
@given(seeds)
def test_relative_and_absolute_poses_are_inverse(seed):
    position, rotation = random_poses(seed)
    back = absolute_poses(*relative_poses(position, rotation))
    np.testing.assert_allclose(back[0], position, rtol=0, atol=1e-9)
    np.testing.assert_allclose(back[1], rotation, rtol=0, atol=1e-14)


@settings(deadline=None)
@given(seeds)
def test_relative_poses_map_points_as_equation_3_11(seed):
    position, rotation = random_poses(seed)
    step, turn = relative_poses(position, rotation)
    point = np.random.default_rng(seed).normal(size=3) * 100.0
    in_third = rotation[0, 3].T @ (point - position[0, 3])
    in_second = rotation[0, 2].T @ (point - position[0, 2])
    np.testing.assert_allclose(turn[0, 3].T @ (in_second - step[0, 3]), in_third, rtol=0, atol=1e-9)


@settings(deadline=None)
@given(seeds)
def test_a_rigid_move_of_everything_changes_only_the_first_relative_pose(seed):
    position, rotation = random_poses(seed, instants=1)
    rng = np.random.default_rng(seed + 1)
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    moved = position @ turn.T + shift, turn @ rotation
    change, turning = relative_changes(*moved, (position[0], rotation[0]))
    np.testing.assert_allclose(change[0, 1:], 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(turning[0, 1:], np.broadcast_to(np.eye(3), (4, 3, 3)), rtol=0, atol=1e-13)


@settings(deadline=None)
@given(seeds)
def test_a_rotation_about_a_segment_s_center_keeps_the_center(seed):
    rng = np.random.default_rng(seed)
    center, turn = rng.normal(size=3) * 1e4, Rotation.random(rng=rng).as_matrix()
    np.testing.assert_allclose(turn @ center + motion_about(center, turn), center, rtol=0, atol=1e-9)


def test_table_4_2_ends_beside_the_telescope():
    surfaces = folded()
    np.testing.assert_allclose(surfaces[3].position[2], 1874.9721 - 3500.0)
    np.testing.assert_allclose(
        surfaces[-1].position - surfaces[3].position, [-14142.136 * np.sqrt(2), 0.0, 0.0], rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(surfaces[-1].rotation[:, 2], [1.0, 0.0, 0.0], rtol=0, atol=1e-15)


def test_a_break_and_its_negative_restore_the_frame():
    shift, tilt = (1.0, -2.0, 3.0), (0.3, 0.0, 0.0)
    back = Break(tuple(-s for s in shift), tuple(-t for t in tilt), tilt_first=True)
    first, second = sequential([SurfaceRow("a"), Break(shift, tilt), back, SurfaceRow("b")])
    np.testing.assert_allclose(second.position, first.position, rtol=0, atol=1e-15)
    np.testing.assert_allclose(second.rotation, np.eye(3), rtol=0, atol=1e-15)


def test_surfaces_move_in_their_own_frames():
    system = OpticalSystem("folded", folded(), 0, Pupil("entrance_diameter", 30e3))
    motion = rest_states(system, 2).surface_motion
    motion[1, -1] = [0.0, 0.0, 5.0, 0.0, 0.0, 0.1]
    position, rotation = moved_poses(system, motion)
    rest_position, rest_rotation = rest_poses(system)
    np.testing.assert_array_equal(position[0], rest_position)
    np.testing.assert_allclose(position[1, -1] - rest_position[-1], [5.0, 0.0, 0.0], rtol=0, atol=1e-9)
    expected = rest_rotation[-1] @ Rotation.from_euler("z", 0.1).as_matrix()
    np.testing.assert_allclose(rotation[1, -1], expected, rtol=0, atol=1e-15)


def test_states_at_rest_have_room_for_every_deformation():
    surfaces = (
        Surface("a", deformation=ZernikeDeformation(7, 1.0)),
        Surface("b", deformation=GridDeformation(5, 6, 1.0, 1.0)),
        Surface("image"),
    )
    states = rest_states(OpticalSystem("x", surfaces, 0, Pupil("stop", 1.0)), 4)
    assert states.surface_motion.shape == (4, 3, 6)
    assert states.deformations[0].shape == (4, 7)
    assert states.deformations[1].shape == (4, 5, 6)
    assert states.deformations[2] is None


def test_bad_prescriptions_and_motions_are_refused():
    with pytest.raises(UserError, match="thickness of row 1"):
        sequential([SurfaceRow("a", thickness=np.inf)])
    with pytest.raises(UserError, match="row 2"):
        sequential([SurfaceRow("a"), Break((np.nan, 0.0, 0.0))])
    with pytest.raises(UserError, match="no surface"):
        sequential([])
    system = OpticalSystem("folded", folded(), 0, Pupil("entrance_diameter", 30e3))
    with pytest.raises(UserError, match=r"\(instants, 5, 6\)"):
        moved_poses(system, np.zeros((2, 4, 6)))
    motion = np.zeros((2, 5, 6))
    motion[1, 2, 0] = np.nan
    with pytest.raises(UserError, match="M2 at instant 1"):
        moved_poses(system, motion)
