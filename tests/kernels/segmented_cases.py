"""What tests of the segmented trace share: devices, one mirror, comparisons."""

import numpy as np

from wavequake.kernels.device.devices import NUMPY, Device, list_devices
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.segmented import SegmentedTrain, trace_chief

OPENCL = [device for device in list_devices() if device.kind != "numpy"]
# Processors also run the variant for GPUs: one instant per work-item, copied buffers.
OPENCL += [Device(device.name, "gpu", device.platform, 1) for device in OPENCL if device.kind == "cpu"]
ALL = [NUMPY, *OPENCL]
NAMES = {"argvalues": ALL, "ids": lambda device: f"{device.kind}-{device.vector_width}"}
MILLIONTH_WAVE = 550e-12  # mm, of light of 550 nm


def poses(*matrices_and_offsets, tiles=1):
    """Pack pairs of a rotation (3, 3) and an offset (3,) as (tiles, number, 12, 16)."""
    packed = [np.concatenate([np.ravel(matrix), offset]) for matrix, offset in matrices_and_offsets]
    return np.tile(np.array(packed)[None, :, :, None], (tiles, 1, 1, TILE))


def one_mirror(curvature=0.0, conic=0.0, image_z=-1000.0, degree=-1, sphere_radius=1000.0):
    """Arguments of a trace over one mirror without an edge and an image plane at z = `image_z`."""
    frames = np.array([[3.0, -2.0, 0.01, 0.0]])
    train = SegmentedTrain(
        curvature, conic, np.zeros((1, 0, 3)), frames, degree, np.zeros(1), np.zeros(1), sphere_radius
    )
    ray_x, ray_y = (grid.ravel() for grid in np.meshgrid(np.linspace(-90, 80, 6), np.linspace(-70, 100, 5)))
    arguments = {
        "train": train,
        "ray_x": ray_x,
        "ray_y": ray_y,
        "start_z": -20.0,
        "candidates": np.zeros((ray_x.size, 1), dtype=np.int32),
        "segment_poses": poses((np.eye(3), np.zeros(3))),
        "figure": None if degree < 0 else np.zeros((1, 1, (degree + 1) * (degree + 2) // 2, TILE)),
        "surface_poses": poses((np.eye(3), [0.0, 0.0, -image_z])),
        "directions": np.broadcast_to(np.array([0.0, 0.0, 1.0])[:, None], (1, 3, TILE)).copy(),
    }
    return arguments | {
        "chief": trace_chief(train, arguments["surface_poses"], arguments["directions"], -20.0)
    }


def assert_same(traced, batch, tile=None):
    """Equal bits; NaN equals NaN."""
    for name in ("opd", "x", "y", "status"):
        expected = getattr(batch, name)
        expected = expected if tile is None else expected[tile : tile + 1]
        np.testing.assert_array_equal(getattr(traced, name), expected)


def assert_close(traced, expected):
    np.testing.assert_array_equal(traced.status, expected.status)
    np.testing.assert_allclose(traced.opd, expected.opd, rtol=0.0, atol=MILLIONTH_WAVE)
    np.testing.assert_allclose(traced.x, expected.x, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(traced.y, expected.y, rtol=0.0, atol=1e-9)
