"""Transforms to moving surfaces against rotations of SciPy, on every device."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, Device, list_devices
from wavequake.kernels.trace import poses
from wavequake.kernels.trace.poses import surface_poses

OPENCL = [device for device in list_devices() if device.kind != "numpy"]
OPENCL += [Device(device.name, "gpu", device.platform, 1) for device in OPENCL if device.kind == "cpu"]
NAMES = {"argvalues": [NUMPY, *OPENCL], "ids": lambda device: f"{device.kind}-{device.vector_width}"}


def case(seed, instants, surfaces, angle):
    random = np.random.default_rng(seed)
    rotation = Rotation.random(surfaces, rng=random).as_matrix()
    motion = random.normal(size=(instants, surfaces, 6)) * ([1.0] * 3 + [angle] * 3)
    motion[:, random.random(surfaces) < 0.3] = 0.0
    return random.normal(0.0, 100.0, (surfaces, 3)), rotation, motion


@pytest.mark.parametrize("device", **NAMES)
@given(
    seed=st.integers(0, 2**32 - 1),
    instants=st.integers(1, 20),
    surfaces=st.integers(1, 5),
    angle=st.sampled_from([1e-9, 1e-3, 1.0, 30.0]),
)
def test_points_go_from_one_moved_frame_to_the_next(device, seed, instants, surfaces, angle):
    """Through the frames of all: out of the predecessor's, along the step at rest, into the surface's."""
    position, rotation, motion = case(seed, instants, surfaces, angle)
    found = surface_poses(position, rotation, motion, device)
    assert found.shape == (instants, surfaces, 12)
    point = np.random.default_rng(seed + 1).normal(0.0, 10.0, 3)
    turns = Rotation.from_euler("XYZ", motion[..., 3:].reshape(-1, 3)).as_matrix()
    turns = turns.reshape(instants, surfaces, 3, 3)
    for t in range(instants):
        for k in range(surfaces):
            before, shift = (turns[t, k - 1], motion[t, k - 1, :3]) if k else (np.eye(3), np.zeros(3))
            at_rest = rotation[k].T @ (before @ point + shift - position[k])
            expected = turns[t, k].T @ (at_rest - motion[t, k, :3])
            assert found[t, k, :9].reshape(3, 3) @ point + found[t, k, 9:] == pytest.approx(
                expected, abs=2e-13 * max(1.0, angle)
            )


@pytest.mark.parametrize("device", **NAMES)
def test_small_turns_keep_their_digits(device):
    """Of nanoradians, in entries beside the diagonal: R - R^T holds twice the sine of the angle."""
    motion = np.zeros((3, 1, 6))
    motion[:, 0, 3:] = 1e-9 * np.eye(3)
    found = surface_poses(np.zeros((1, 3)), np.eye(3)[None], motion, device)[:, 0, :9].reshape(-1, 3, 3)
    for turn, (i, j) in zip(found, [(1, 2), (2, 0), (0, 1)], strict=True):
        assert turn[i, j] == pytest.approx(1e-9, rel=1e-15)
        assert turn[j, i] == pytest.approx(-1e-9, rel=1e-15)


@pytest.mark.parametrize("device", **NAMES)
def test_what_rests_is_not_turned_at_all(device):
    """Then the trace leaves the product out."""
    position = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    motion = np.zeros((9, 2, 6), np.float32)
    found = surface_poses(position, np.array([np.eye(3)] * 2), motion, device)
    assert np.array_equal(found[..., :9].reshape(9, 2, 3, 3), np.broadcast_to(np.eye(3), (9, 2, 3, 3)))
    assert np.array_equal(found[..., 9:], np.broadcast_to(-position, (9, 2, 3)))


@pytest.mark.parametrize("device", **NAMES)
def test_an_instant_does_not_depend_on_its_batch(device):
    position, rotation, motion = case(3, 21, 4, 1e-3)
    together = surface_poses(position, rotation, motion, device)
    alone = [surface_poses(position, rotation, row[None], device) for row in motion]
    assert np.array_equal(together, np.concatenate(alone))
    assert surface_poses(position, rotation, motion[:0], device).shape == (0, 4, 12)


@pytest.mark.parametrize("device", **NAMES)
def test_numbers_of_any_kind_are_taken_as_double_precision(device, monkeypatch):
    monkeypatch.setattr("wavequake.kernels.device.first_batch._TRUSTED", set())
    position, rotation, motion = case(7, 9, 3, 1e-3)
    for taken in (motion.astype(np.float32), np.ones(motion.shape, int), motion.tolist()):
        expected = surface_poses(position, rotation, np.array(taken, np.float64))
        np.testing.assert_allclose(
            surface_poses(position, rotation, taken, device), expected, rtol=0, atol=1e-12
        )


@pytest.mark.parametrize("device", OPENCL, ids=lambda device: device.kind)
def test_a_device_that_turns_wrong_is_refused(device, monkeypatch):
    monkeypatch.setattr("wavequake.kernels.device.first_batch._TRUSTED", set())
    monkeypatch.setattr(poses, "run_steps", lambda *arguments: arguments[3]["found"].fill(0.5))
    with pytest.raises(UserError, match="instants of the first batch"):
        surface_poses(*case(5, 20, 3, 1e-3), device)
