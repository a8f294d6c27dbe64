"""What tests of telescopes' wavefronts share: rays, motions, devices."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from wavequake.kernels.device.devices import NUMPY, list_devices
from wavequake.kernels.device.tiles import TILE
from wavequake.optics.rays.pupils import PupilRays
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.layout import Segments
from wavequake.optics.segments.prepared import prepare
from wavequake.optics.segments.telescope import with_segments
from wavequake.optics.systems.kinematics import rest_states

DATA = Path(__file__).parents[1] / "data"
WAVELENGTH = 550e-6
TERMS = 45
FLIP = np.diag([1.0, 1.0, -1.0])
DEVICES = [NUMPY, *(device for device in list_devices() if device.kind == "cpu")][:2]
each_device = pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.kind)


def reference(name):
    return json.loads((DATA / name).read_text())


def quadrature_rays(inner, outer, radii=24, azimuths=96):
    nodes, weights = np.polynomial.legendre.leggauss(radii)
    r = np.sqrt(inner**2 + (outer**2 - inner**2) * (nodes + 1) / 2)
    theta = 2 * np.pi * np.arange(azimuths) / azimuths
    x, y = np.outer(r, np.cos(theta)).ravel(), np.outer(r, np.sin(theta)).ravel()
    return PupilRays(x, y, np.repeat(weights / 2 / azimuths, azimuths), np.zeros(len(x), dtype=np.int64))


def sunflower_rays(system, count=2000):
    """Equal areas over the annulus, each ray with the segment whose center is nearest (regular hexagons)."""
    i, inner, outer = np.arange(count), system.annulus.inner, system.annulus.outer
    r = np.sqrt(inner**2 + (i + 0.5) / count * (outer**2 - inner**2))
    x, y = r * np.cos(i * np.pi * (3 - np.sqrt(5))), r * np.sin(i * np.pi * (3 - np.sqrt(5)))
    centers = system.segments.centers
    distance = np.hypot(x[:, None] - centers[:, 0], y[:, None] - centers[:, 1])
    return PupilRays(x, y, np.ones(count), np.argmin(distance, axis=1))


def local_motion(segments, in_optics_frame):
    """Turn motions (batch, S, 6) along and about the optics axes into the local frames of the segments."""
    axes = FLIP @ segments.axes
    back = np.swapaxes(axes, 1, 2)
    turn = Rotation.from_euler("XYZ", in_optics_frame[..., 3:].reshape(-1, 3)).as_matrix()
    turn = back @ turn.reshape(-1, len(segments), 3, 3) @ axes
    angles = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_euler("XYZ").reshape(-1, len(segments), 3)
    return np.concatenate([(back @ in_optics_frame[..., :3, None])[..., 0], angles], axis=-1)


def states_of(prepared, batch=TILE):
    return rest_states(prepared.system, batch)


def slope(values, step):
    """Central differences of consecutive pairs (+step, -step)."""
    return (values[0::2] - values[1::2]) / (2 * step)


def two_of_492(names):
    """The telescope of which only these segments are left, at the reference's grid points on them."""
    whole = telescope("tmt")
    chosen = [whole.segments.names.index(name) for name in names]
    corners, centers = whole.segments.corners[chosen], whole.segments.centers[chosen]
    segments = Segments(tuple(names), centers, whole.segments.axes[chosen], corners)
    grid = (np.arange(600) + 0.5) * 50.0 - 15e3
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    edge = np.roll(corners, -1, axis=1) - corners
    side = edge[..., :1] * (y - corners[..., 1:]) - edge[..., 1:] * (x - corners[..., :1])
    segment, point = np.nonzero((side > 0).all(axis=1))
    rays = PupilRays(x[point], y[point], np.ones(len(point)), segment)
    return prepare(with_segments(whole, segments), rays, WAVELENGTH, 3)
