import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from wavequake.errors import UserError
from wavequake.kernels.device.tiles import TILE, from_tiles
from wavequake.optics.segments.kinematics import (
    after_m1,
    cardan,
    field_directions,
    relative_transforms,
    segment_poses,
)
from wavequake.optics.segments.layout import Segments
from wavequake.optics.segments.telescope import segmented_telescope
from wavequake.optics.shapes.shapes import Conic
from wavequake.optics.systems.system import Surface

FLIP = np.diag([1.0, 1.0, -1.0])
angles = st.floats(-3.0, 3.0)


def some_segments(count=5, seed=3):
    rng = np.random.default_rng(seed)
    return Segments(
        names=tuple(f"S{k}" for k in range(count)),
        centers=rng.uniform(-15e3, 15e3, (count, 3)),
        axes=Rotation.random(count, rng=rng).as_matrix(),
        corners=np.zeros((count, 6, 2)),
    )


def some_system():
    def turned(degrees):
        return Rotation.from_euler("y", degrees, degrees=True).as_matrix()

    vertices = np.array([[0.0, 0.0, -27093.75], [0.0, 0.0, -3500.0], [-20000.0, 0.0, -3500.0]])
    frames = zip(["M2", "M3", "image"], [-6227.68, np.inf, np.inf], vertices, [0, 45, 90], strict=True)
    surfaces = tuple(
        Surface(name, Conic(radius), p, turned(angle), "pass" if name == "image" else "reflect")
        for name, radius, p, angle in frames
    )
    return segmented_telescope("test", some_segments(), -60e3, -1.0, surfaces, -1874.97, 1512.2, 15000.0)


def poses_after_m1(motion):
    return relative_transforms(*after_m1(some_system(), motion))


def transforms(poses):
    """Return A (batch, surface, 3, 3) and o (batch, surface, 3) of poses in tile layout."""
    numbers = from_tiles(poses)
    return numbers[..., :9].reshape(*numbers.shape[:-1], 3, 3), numbers[..., 9:]


def applied(poses, points):
    turn, shift = transforms(poses)
    return (turn @ points[..., None])[..., 0] + shift


@given(arrays(float, 3, elements=angles))
def test_cardan_is_the_intrinsic_xyz_rotation(triple):
    np.testing.assert_allclose(
        cardan(triple), Rotation.from_euler("XYZ", triple).as_matrix(), rtol=0, atol=1e-15
    )


@given(angles, angles)
def test_cardan_turns_the_z_axis_as_equation_3_10_says(alpha, beta):
    normal = [np.sin(beta), -np.sin(alpha) * np.cos(beta), np.cos(alpha) * np.cos(beta)]
    np.testing.assert_allclose(cardan(np.array([alpha, beta, 0.7]))[:, 2], normal, rtol=0, atol=1e-15)


def test_rest_gives_the_identity_exactly():
    turn, shift = transforms(segment_poses(some_segments(), np.zeros((TILE, 5, 6))))
    np.testing.assert_array_equal(turn, np.broadcast_to(np.eye(3), turn.shape))
    np.testing.assert_array_equal(shift, 0.0)


@pytest.mark.parametrize("frame", ["local", "global"])
def test_segment_poses_undo_the_motion_of_material_points(frame):
    segments, rng = some_segments(), np.random.default_rng(0)
    motion = rng.normal(size=(2 * TILE, 5, 6)) * [3.0, 3.0, 3.0, 0.4, 0.4, 0.4]
    points = rng.uniform(-15e3, 15e3, (2 * TILE, 5, 3))
    axes = FLIP @ segments.axes if frame == "local" else np.broadcast_to(np.eye(3), (5, 3, 3))
    rotation = Rotation.from_euler("XYZ", motion[..., 3:].reshape(-1, 3)).as_matrix().reshape(-1, 5, 3, 3)
    arm = axes @ rotation @ np.swapaxes(axes, 1, 2) @ (points - segments.centers)[..., None]
    moved = segments.centers + (axes @ motion[..., :3, None] + arm)[..., 0]
    np.testing.assert_allclose(
        applied(segment_poses(segments, motion, frame), moved), points, rtol=0, atol=1e-10
    )


def test_a_rotation_leaves_the_center_of_its_segment():
    segments = some_segments()
    motion = np.random.default_rng(1).normal(size=(TILE, 5, 6)) * [0, 0, 0, 1, 1, 1]
    center = np.broadcast_to(segments.centers, (TILE, 5, 3))
    np.testing.assert_allclose(applied(segment_poses(segments, motion), center), center, rtol=0, atol=1e-11)


def test_a_nanoradian_keeps_its_digits():
    """For a small rotation about x the offset is (0, -rx z, rx y): no digits are lost to the 15 m arm."""
    segments = some_segments()
    motion = np.zeros((TILE, 5, 6))
    motion[..., 3] = 1e-9
    shift = transforms(segment_poses(segments, motion, "global"))[1][0]
    _, y, z = segments.centers.T
    np.testing.assert_allclose(shift, 1e-9 * np.stack([0 * y, -z, y], axis=1), rtol=1e-8, atol=1e-20)


def test_local_normal_motion_is_along_the_normal_towards_the_sky():
    segments = some_segments()
    motion = np.zeros((TILE, 5, 6))
    motion[..., 2] = 0.1
    shift = transforms(segment_poses(segments, motion))[1][0]
    np.testing.assert_allclose(-shift, 0.1 * segments.axes[:, :, 2] * [1, 1, -1], rtol=0, atol=1e-13)


def test_an_instant_has_the_same_pose_alone_and_in_a_batch():
    segments, motion = some_segments(), np.random.default_rng(2).normal(size=(4 * TILE, 5, 6))
    batch = segment_poses(segments, motion)
    np.testing.assert_array_equal(batch[2], segment_poses(segments, motion[2 * TILE : 3 * TILE])[0])


@settings(max_examples=20)
@given(arrays(float, (3, 6), elements=st.floats(-1.0, 1.0)))
def test_relative_poses_compose_to_the_absolute_ones(one_motion):
    system = some_system()
    motion = np.zeros((TILE, 5, 6))
    motion[:, 2:] = one_motion
    turn, shift = (values[0] for values in transforms(poses_after_m1(motion)))
    absolute, point = np.array([100.0, -200.0, 300.0]), np.array([100.0, -200.0, 300.0])
    for surface, move, relative, offset in zip(system.after_primary, one_motion, turn, shift, strict=True):
        point = relative @ point + offset
        rotation = surface.rotation @ Rotation.from_euler("XYZ", move[3:]).as_matrix()
        position = surface.position + surface.rotation @ move[:3]
        np.testing.assert_allclose(point, rotation.T @ (absolute - position), rtol=0, atol=1e-10)


def test_the_reference_configuration_of_table_4_2():
    turn, shift = (values[0] for values in transforms(poses_after_m1(np.zeros((TILE, 5, 6)))))
    half = np.sqrt(0.5)
    np.testing.assert_allclose(shift[0], [0, 0, 27093.75], rtol=0, atol=1e-10)
    # The image is at (-14142.136, 0, -14142.136) in M3's frame and turned by 45 degrees against it.
    np.testing.assert_allclose(turn[2], [[half, 0, -half], [0, 1, 0], [half, 0, half]], rtol=0, atol=1e-15)
    np.testing.assert_allclose(-turn[2].T @ shift[2], [-14142.135624, 0, -14142.135624], rtol=0, atol=1e-6)


@given(arrays(float, (TILE, 2), elements=st.floats(-0.1, 0.1)))
def test_field_directions_are_unit_vectors_with_the_given_slopes(field):
    direction = from_tiles(field_directions(field))
    np.testing.assert_allclose(np.sum(direction**2, axis=1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(direction[:, :2] / direction[:, 2:], np.tan(field), rtol=0, atol=1e-16)


@pytest.mark.parametrize(
    "call",
    [
        lambda: segment_poses(some_segments(), np.zeros((TILE, 5, 6)), "sky"),
        lambda: segment_poses(some_segments(), np.zeros((TILE, 4, 6))),
        lambda: segment_poses(some_segments(), np.zeros((TILE + 1, 5, 6))),
        lambda: poses_after_m1(np.zeros((TILE, 2, 6))),
    ],
)
def test_bad_input_is_named(call):
    with pytest.raises(UserError):
        call()
