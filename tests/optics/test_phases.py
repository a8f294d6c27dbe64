"""Gratings, binary optics and perfect lenses: the grating equation, equal paths, rays that follow them."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, list_devices
from wavequake.kernels.trace.sequence import Element, Focus, Form, Moving, Phase, Polynomial, Rays, Sequence
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.kernels.trace.status import NO_ORDER, OK
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.shapes.phases import Diffraction, PerfectLens, axis_effect, phase_of
from wavequake.optics.systems.info import info
from wavequake.optics.systems.kinematics import Break, SurfaceRow, rest_states, sequential
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, Pupil
from wavequake.optics.wavefronts.wavefront import measure_system, prepare_system

RNG = np.random.default_rng(5)
WAVE = 600e-6  # mm
DEVICES = {"argvalues": list_devices(), "ids": lambda device: device.kind}


def poses(*steps):
    return np.array([[[*np.eye(3).ravel(), 0.0, 0.0, -step] for step in steps]])


def unit(u, v):
    return np.stack([u, v, np.sqrt(1.0 - u**2 - v**2)])


def traced(element, rays, before=1.0, image=7.0, device=NUMPY):
    """Rays from their start to an element at z = 0 and a plane behind it; directions (3, N)."""
    sequence = Sequence((element, Element()), before)
    found = trace_sequence(sequence, rays, Moving(poses(0.0, image), (None, None), (None, None)), device)
    w = found.w_sign * np.sqrt(1.0 - found.u**2 - found.v**2)
    return found, np.concatenate([found.u, found.v, w])


@pytest.mark.parametrize("device", **DEVICES)
@pytest.mark.parametrize("action", ["reflect", "refract", "pass"])
def test_a_plane_grating_obeys_the_grating_equation(action, device):
    """n' sin' = n sin + order wavelength / period across the grooves, n' sin' = n sin along them."""
    before, after = (1.3, 1.3) if action != "refract" else (1.3, 1.6)
    phase = phase_of(Diffraction(order=-2.0, lines=250.0), WAVE)
    u, v = RNG.uniform(-0.4, 0.4, (2, 50))
    start = np.stack([*RNG.uniform(-3.0, 3.0, (2, 50)), np.full(50, -5.0)])
    element = Element(action=action, index=1.6, phase=phase)
    found, direction = traced(element, Rays(start, unit(u, v), np.zeros(50)), before, -7.0, device)
    assert (found.status == OK).all()
    np.testing.assert_allclose(after * direction[1], before * v - 2.0 * WAVE * 250.0, rtol=0, atol=1e-14)
    np.testing.assert_allclose(after * direction[0], before * u, rtol=0, atol=1e-14)
    assert (np.sign(direction[2]) == (-1.0 if action == "reflect" else 1.0)).all()
    # On the way the grating adds order times wavelength times grooves.
    hit = start + 5.0 / unit(u, v)[2] * unit(u, v)
    way = before * 5.0 / unit(u, v)[2] + after * (-7.0) / direction[2]
    np.testing.assert_allclose(found.path[0], way - 2.0 * WAVE * 250.0 * hit[1], rtol=0, atol=1e-12)


PHASES = {
    "grating": Diffraction(1.0, 120.0),
    "radial": Diffraction(-1.0, radial=(900.0, -300.0, 100.0), normalization_radius=9.0),
    "polynomial": Diffraction(
        2.0, polynomial=(30.0, -20.0, 200.0, 50.0, 90.0, 40.0), normalization_radius=9.0
    ),
    "all": Diffraction(1.0, 40.0, (300.0, -100.0), (3.0, 5.0, 40.0), 9.0),
}
BASES = {
    "plane": Element(),
    "sphere": Element(0.02),
    "asphere": Element(-0.015, -0.6, even=(0.0, 2e-6)),
    "biconic": Element(0.02, -1.0, form=Form("biconic", (0.03, 0.01, 9e-4, 1e-4), near=0.02)),
}


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("action", ["reflect", "refract"])
def test_rays_behind_a_phase_stand_on_surfaces_of_equal_path(phase, base, action):
    """The law of Malus and Dupin: between neighbors the path changes by n' d' times their distance.

    It ties the added path to the bend of the light, on any surface, with no formula of either.
    """
    element = replace(BASES[base], action=action, index=1.5, phase=phase_of(PHASES[phase], WAVE))
    x, y = RNG.uniform(-6.0, 6.0, (2, 40))
    d = unit(np.full(40, 0.1), np.full(40, -0.2))
    image = -9.0 if action == "reflect" else 9.0

    def end(x, y):
        start = np.stack([x, y, np.full_like(x, -5.0)])
        found, direction = traced(element, Rays(start, d, np.sum(d * start, axis=0)), 1.0, image)
        assert (found.status == OK).all()
        return found.path[0], np.stack([found.x[0], found.y[0]]), direction

    h, index = 1e-4, 1.0 if action == "reflect" else 1.5
    _, _, direction = end(x, y)
    for step in (np.array([h, 0.0]), np.array([0.0, h])):
        ahead, back = end(x + step[0], y + step[1]), end(x - step[0], y - step[1])
        moved = ahead[1] - back[1]
        np.testing.assert_allclose(
            ahead[0] - back[0], index * np.sum(direction[:2] * moved, axis=0), rtol=0, atol=2e-11
        )
        assert np.abs(moved).max() > 1e-5


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("action", ["reflect", "refract", "pass"])
def test_kernels_diffract_as_their_twins_in_numpy(phase, base, action):
    element = replace(BASES[base], action=action, index=1.5, phase=phase_of(PHASES[phase], WAVE))
    rays = Rays(
        np.stack([*RNG.uniform(-6.0, 6.0, (2, 100)), np.full(100, -5.0)]),
        unit(*RNG.uniform(-0.3, 0.3, (2, 100))),
        np.zeros(100),
    )
    ours, _ = traced(element, rays, 1.2, 9.0)
    assert (ours.status == OK).mean() > 0.9
    for device in list_devices():
        theirs, _ = traced(element, rays, 1.2, 9.0, device)
        np.testing.assert_array_equal(theirs.status, ours.status)
        for key in ("path", "x", "y", "u", "v"):
            np.testing.assert_allclose(getattr(theirs, key), getattr(ours, key), rtol=0, atol=2e-12)


@pytest.mark.parametrize("device", **DEVICES)
@pytest.mark.parametrize("action", ["reflect", "refract"])
def test_an_order_that_cannot_leave_is_lost_by_name(action, device):
    """sin' = sin + 0.9 leaves for sin < 0.1 only."""
    element = Element(action=action, index=1.0, phase=phase_of(Diffraction(3.0, 500.0), WAVE))
    v = np.array([-0.5, 0.09, 0.11, 0.5])
    rays = Rays(np.tile([[0.0], [0.0], [-1.0]], (1, 4)), unit(0.0 * v, v), np.zeros(4))
    found, _ = traced(element, rays, 1.0, -3.0, device)
    assert found.status[0].tolist() == [OK, OK, NO_ORDER, NO_ORDER]
    assert found.surface[0].tolist() == [-1, -1, 0, 0]


@pytest.mark.parametrize("device", **DEVICES)
@pytest.mark.parametrize(
    ("focal", "distance", "before", "after"),
    [
        (50.0, 80.0, 1.0, 1.0),  # a real image
        (50.0, 30.0, 1.0, 1.0),  # a virtual one
        (-40.0, 60.0, 1.0, 1.33),
        (50.0, -25.0, 1.5, 1.0),  # a virtual object
        (30.0, 100.0, 1.5, 1.7),
    ],
)
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_perfect_lens_images_points_with_equal_paths(focal, distance, before, after, sense, device):
    """All rays of a point beside the axis meet in one, with the path of the ray through the lens's center."""
    point = np.array([4.0, -7.0, -sense * distance])
    x, y = RNG.uniform(-12.0, 12.0, (2, 60))
    x[0] = y[0] = 0.0
    onto = np.stack([x, y, 0.0 * x])
    way = (onto - point[:, None]) * np.sign(distance)
    direction = way / np.linalg.norm(way, axis=0)
    path = before * np.sign(distance) * np.linalg.norm(way, axis=0)
    image = after / (1.0 / focal - before / distance)
    action = "pass" if before == after else "refract"
    element = Element(action=action, index=after, phase=Focus(1.0 / focal, 1.0 / distance))
    found, _ = traced(element, Rays(onto, direction, path), before, sense * image, device)
    np.testing.assert_allclose(found.x[0], -4.0 * before * image / (after * distance), rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.y[0], 7.0 * before * image / (after * distance), rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.path[0], found.path[0, 0], rtol=0, atol=1e-11)


def test_a_perfect_lens_collimates_and_focuses_parallel_light():
    v = np.full(30, 0.1)
    x, y = RNG.uniform(-10.0, 10.0, (2, 30))
    d, place = unit(0.0 * v, v), np.stack([x, y, 0.0 * x])
    found, _ = traced(Element(phase=Focus(1.0 / 60.0)), Rays(place, d, np.sum(d * place, axis=0)), 1.0, 60.0)
    np.testing.assert_allclose(found.y, 60.0 * 0.1 / np.sqrt(0.99), rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.path, found.path[0, 0], rtol=0, atol=1e-12)
    back = Rays(np.tile([[0.0], [5.0], [-60.0]], (1, 30)), unit(x / 200.0, y / 200.0), np.zeros(30))
    found, direction = traced(Element(phase=Focus(1.0 / 60.0, 1.0 / 60.0)), back, 1.0, 10.0)
    np.testing.assert_allclose(direction, np.repeat(direction[:, :1], 30, axis=1), rtol=0, atol=1e-13)
    wave = found.path[0] - direction[0] * found.x[0] - direction[1] * found.y[0]
    np.testing.assert_allclose(wave, wave[0], rtol=0, atol=1e-11)


def relay(*rows, **more):
    system = {"object_distance": np.inf, "fields": np.deg2rad([[0.0, 0.0], [1.0, 3.0]]), **more}
    return OpticalSystem(
        "ideal", sequential(rows), 0, Pupil("entrance_diameter", 20.0), wavelengths=np.array([WAVE]), **system
    )


def test_two_perfect_lenses_make_a_perfect_telescope_camera():
    """A star's wavefront is exact at each field, and the focal length that of two thin lenses."""
    first, second, gap = 100.0, -80.0, 50.0
    focal = 1.0 / (1.0 / first + 1.0 / second - gap / (first * second))
    back = focal * (1.0 - gap / first)
    system = relay(
        SurfaceRow("objective", thickness=gap, phase=PerfectLens(first)),
        SurfaceRow("tele", thickness=back, phase=PerfectLens(second)),
        SurfaceRow("image"),
    )
    data = paraxial(system)
    assert data.focal_length == pytest.approx(focal, rel=1e-12)
    assert data.defocus == pytest.approx(0.0, abs=1e-9)
    rays = sunflower(0.0, 1.0, 200)
    for field in (0, 1):
        found = measure_system(
            prepare_system(system, rays.x, rays.y, rays.weight, 15, field), rest_states(system), NUMPY
        )
        assert found.rms_raw[0] < 2e-6
        assert found.spot_rms[0] < 1e-10
        np.testing.assert_allclose(found.chief[0], focal * np.tan(system.fields[field]), rtol=0, atol=1e-9)
    assert "perfect lens of f = 100 mm" in info(system)


def test_a_moved_perfect_lens_moves_the_image_alone():
    system = relay(SurfaceRow("lens", thickness=100.0, phase=PerfectLens(100.0)), SurfaceRow("image"))
    states = rest_states(system)
    states.surface_motion[0, 0, 1] = 0.25  # mm along y
    rays = sunflower(0.0, 1.0, 200)
    found = measure_system(prepare_system(system, rays.x, rays.y, rays.weight, 15), states, NUMPY)
    np.testing.assert_allclose(found.centroid[0], [0.0, 0.25], rtol=0, atol=1e-9)
    assert found.rms[0] < 1e-6


def test_a_radial_phase_is_a_lens_whose_power_goes_with_the_wavelength():
    """Phase -pi r^2 / (wavelength f): f at the design wavelength, and f times the ratio at another."""
    phase = Diffraction(1.0, radial=(-np.pi * 15.0**2 / (WAVE * 200.0),), normalization_radius=15.0)
    system = relay(SurfaceRow("zones", thickness=200.0, phase=phase), SurfaceRow("image"))
    assert paraxial(system).focal_length == pytest.approx(200.0, rel=1e-12)
    assert paraxial(system, 450e-6).focal_length == pytest.approx(200.0 * 600.0 / 450.0, rel=1e-12)
    start = Rays(np.array([[0.0], [0.1], [0.0]]), np.array([[0.0], [0.0], [1.0]]), np.zeros(1))
    found = trace_sequence(pack(system, WAVE), start, moving(system, rest_states(system)), NUMPY)
    assert found.y[0, 0] == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize("order", [1.0, -1.0])
def test_the_axis_follows_a_grating(order):
    """A spectrograph: the camera stands where the order goes, and is on the axis."""
    sine = order * WAVE * 300.0
    angle = np.degrees(np.arcsin(sine))
    rows = [
        SurfaceRow("grating", phase=Diffraction(order, 300.0)),
        Break(tilt=(-np.deg2rad(angle), 0.0, 0.0), thickness=40.0),
        SurfaceRow("camera", thickness=100.0, phase=PerfectLens(100.0)),
        SurfaceRow("image"),
    ]
    system = relay(*rows, fields=np.zeros((1, 2)))
    data = paraxial(system)
    assert data.focal_length == pytest.approx(100.0, rel=1e-12)
    assert data.defocus == pytest.approx(0.0, abs=1e-9)
    rays = sunflower(0.0, 1.0, 200)
    found = measure_system(
        prepare_system(system, rays.x, rays.y, rays.weight, 11), rest_states(system), NUMPY
    )
    assert found.rms_raw[0] < 1e-6
    np.testing.assert_allclose(found.chief[0], 0.0, rtol=0, atol=1e-9)
    assert f"grating of 300 / mm, order {order:g}" in info(system)
    steep = replace(
        system, surfaces=(replace(system.surfaces[0], phase=Diffraction(order, 3000.0)), *system.surfaces[1:])
    )
    with pytest.raises(UserError, match="order of the axis ray of ideal leaves grating at no real angle"):
        paraxial(steep)


@pytest.mark.parametrize("device", **DEVICES)
def test_a_grating_that_shakes_moves_its_line(device):
    """Turned by a about its grooves, it sends light that it meets upright a (1 / cos - 1) beside the line.

    A shift along y changes the paths of all rays, the chief ray's as well, by wavelengths, and moves nothing.
    """
    sine = WAVE * 300.0
    rows = [
        SurfaceRow("grating", phase=Diffraction(1.0, 300.0)),
        Break(tilt=(-float(np.arcsin(sine)), 0.0, 0.0), thickness=40.0),
        SurfaceRow("camera", thickness=100.0, phase=PerfectLens(100.0)),
        SurfaceRow("image"),
    ]
    system = relay(*rows, fields=np.zeros((1, 2)))
    rays = sunflower(0.0, 1.0, 300)
    prepared = prepare_system(system, rays.x, rays.y, rays.weight, 11)
    states = rest_states(system, 3)
    states.surface_motion[1, 0, 3] = 1e-5
    states.surface_motion[2, 0, 1] = 1e-3
    found = measure_system(prepared, states, device)
    turned = 100.0 * 1e-5 * (1.0 / np.sqrt(1.0 - sine**2) - 1.0)
    np.testing.assert_allclose(found.centroid[:, 1], [0.0, turned, 0.0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.chief[:, 0], 0.0, rtol=0, atol=1e-12)
    assert found.rms.max() < 1e-5


def test_powers_of_phases_are_those_of_their_slopes():
    phase = Diffraction(2.0, 10.0, (3.0,), (1.0, 2.0, 5.0, 7.0, 9.0), 4.0)
    power, slopes = axis_effect(phase, WAVE)
    packed = phase_of(phase, WAVE)
    assert isinstance(packed, Phase)
    assert isinstance(packed.polynomial, Polynomial)
    waves = 2.0 * WAVE / (2.0 * np.pi)
    assert slopes == pytest.approx((waves / 4.0, waves * 2.0 / 4.0 + 2.0 * WAVE * 10.0))
    assert power == pytest.approx(-waves * (2.0 * 3.0 + 5.0 + 9.0) / 16.0)
