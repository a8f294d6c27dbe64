"""Faces of media whose index varies that touch, cross or fall away from others."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.kernels.device.devices import NUMPY, list_devices
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.kernels.trace.status import OK
from wavequake.optics.media.glasses import AIR
from wavequake.optics.media.gradients import luneburg, selfoc
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.shapes.shapes import Conic
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil
from wavequake.optics.wavefronts.wavefront import measure_system, prepare_system

OPENCL = [device for device in list_devices() if device.kind != "numpy"]
DEVICES = [NUMPY, *OPENCL, *(replace(one, kind="gpu", vector_width=1) for one in OPENCL if one.kind == "cpu")]
NAMES = {"argvalues": DEVICES, "ids": lambda device: f"{device.kind}-{device.vector_width}"}
PLANE, WAVE = Conic(), 550e-6
N0, G = 1.6, 0.05


def system(medium, length, ends):
    rows = [
        SurfaceRow("front", ends[0], length, "refract", medium),
        SurfaceRow("rear", ends[1], 0.0, "refract", AIR),
        SurfaceRow("image"),
    ]
    return OpticalSystem("rod", sequential(rows), 0, Pupil("entrance_diameter", 2.0))


@pytest.mark.parametrize("device", **NAMES)
@pytest.mark.parametrize(
    ("before", "curved"), [(0.0, 0.0), (0.0, 30.0), (0.0, -30.0), (20.0, 30.0), (20.0, -30.0)]
)
def test_a_stop_on_a_face_changes_nothing(device, before, curved):
    """It lies behind some of the rays that come from the face: homogeneous glass takes such steps, too."""
    face = Conic(curved) if curved else PLANE
    rod = system(selfoc(N0, G), 20.0, (face, face))
    rows = [
        SurfaceRow("front", face, before, "refract", selfoc(N0, G)),
        SurfaceRow("stop", thickness=20.0 - before),
    ]
    rows += [SurfaceRow("rear", face, 0.0, "refract", AIR), SurfaceRow("image")]
    stopped = replace(rod, surfaces=sequential(rows))
    place = np.array([[0.0, 1.0, -2.0, 6.0], [0.5, 0.0, 1.0, -4.0], [-2.0] * 4])
    direction = np.array([[0.1], [-0.05], [1.0]]) / np.linalg.norm([0.1, -0.05, 1.0])
    rays = Rays(place, np.repeat(direction, 4, axis=1), np.zeros(4))
    states = rest_states(stopped, 20)
    random = np.random.default_rng(3)
    states.surface_motion[1:, 1] = random.normal(0.0, 1e-2, (19, 6))
    found = trace_sequence(pack(stopped, WAVE), rays, moving(stopped, states), device)
    expected = trace_sequence(pack(rod, WAVE), rays, moving(rod, rest_states(rod)), device)
    assert (found.status == OK).all()
    for name in ("path", "x", "y", "u", "v"):
        there = np.broadcast_to(getattr(expected, name), found.path.shape)
        np.testing.assert_allclose(getattr(found, name), there, rtol=0, atol=1e-9)


def test_a_stop_on_a_face_can_be_aimed_at():
    rows = [
        SurfaceRow("front", Conic(60.0), 0.0, "refract", selfoc(N0, G)),
        SurfaceRow("stop", thickness=20.0),
    ]
    rows += [SurfaceRow("rear", PLANE, 8.0, "refract", AIR), SurfaceRow("image")]
    rod = OpticalSystem("rod", sequential(rows), 1, Pupil("entrance_diameter", 2.0))
    points = sunflower(0.0, 1.0, 100)
    prepared = prepare_system(rod, points.x, points.y, points.weight, 6)
    found = measure_system(prepared, rest_states(rod), NUMPY)
    assert (found.lost == 0).all()


@pytest.mark.parametrize("device", **NAMES)
def test_steep_rays_go_forward_to_a_steep_face(device):
    """Parallel rays along d meet at R d from a Luneburg lens' center; its rear face falls away at the rim."""
    R, slopes = 10.0, (0.7, 0.2)
    lens = system(luneburg(R, 0.05), 2 * R, (Conic(R), Conic(-R)))
    direction = np.array([*slopes, 1.0]) / np.linalg.norm([*slopes, 1.0])
    on_face = np.array([[-9.0, -8.0, 0.0, 3.0], [1.0, -3.0, 0.0, 2.0], np.zeros(4)])
    on_face[2] = R - np.sqrt(R**2 - np.sum(on_face[:2] ** 2, axis=0))
    start = on_face - 25.0 * direction[:, None]
    rays = Rays(start, np.repeat(direction[:, None], 4, axis=1), np.zeros(4))
    traced = trace_sequence(pack(lens, WAVE), rays, moving(lens, rest_states(lens)), device)
    assert (traced.status == OK).all()
    focus = R * direction + [0.0, 0.0, -R]  # in the frame of the image, at the rear vertex
    w = np.sqrt(1.0 - traced.u**2 - traced.v**2)
    np.testing.assert_allclose(traced.x + focus[2] * traced.u / w, focus[0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(traced.y + focus[2] * traced.v / w, focus[1], rtol=0, atol=1e-6)
