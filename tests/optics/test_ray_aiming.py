from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.catalog.names import optical_system, system_names
from wavequake.optics.media.glasses import Medium
from wavequake.optics.rays.aiming import pupil_rays
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.segments.kinematics import cardan
from wavequake.optics.shapes.shapes import Conic, EvenAsphere, Opening
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.once import once_per_system
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface

GLASS = Medium("glass", "constant", (1.5,))
X, Y = np.random.default_rng(4).uniform(-0.7, 0.7, (2, 30))


def at_stop(system, rays, wavelength):
    """Return where rays really meet the stop: the system ends there, and light goes on beside openings."""
    front = OpticalSystem(
        system.name,
        (
            *system.surfaces[: system.stop],
            Surface(
                "at stop",
                system.surfaces[system.stop].shape,
                system.surfaces[system.stop].position,
                system.surfaces[system.stop].rotation,
            ),
        ),
        0,
        Pupil("stop", 1.0),
        medium=system.medium,
    )
    traced = trace_sequence_numpy(pack(front, wavelength), rays, moving(front, rest_states(front)), True)
    return np.stack([traced.x[0], traced.y[0]])


@pytest.mark.parametrize("name", system_names())
def test_rays_of_every_field_and_color_meet_the_stop(name):
    system = optical_system(name)
    radius = paraxial(system).stop_radius  # one opening for light of all colors
    for wavelength in system.wavelengths:
        for field in system.fields:
            rays = pupil_rays(system, field, wavelength, X, Y)
            miss = at_stop(system, rays, wavelength) - radius * np.stack([X, Y])
            assert np.abs(miss).max() < 1e-9
            np.testing.assert_allclose(np.sum(rays.direction**2, axis=0), 1.0, rtol=1e-14)


def test_a_far_object_sends_a_plane_wave_through_the_pupil_s_center():
    system = optical_system("double-gauss")
    field = np.array([0.1, -0.2])
    rays = pupil_rays(system, field, 587.5618e-6, X, Y)
    expected = np.array([*np.tan(field), 1.0]) / np.sqrt(1.0 + np.sum(np.tan(field) ** 2))
    np.testing.assert_allclose(
        rays.direction, np.broadcast_to(expected[:, None], (3, 30)), rtol=0, atol=1e-15
    )
    center = np.array([0.0, 0.0, paraxial(system).entrance_pupil])
    np.testing.assert_allclose(rays.path, expected @ (rays.position - center[:, None]), rtol=0, atol=1e-12)


def test_a_near_object_sends_rays_from_its_point():
    system = optical_system("six-lens")
    rays = pupil_rays(system, np.array([0.0, 5.0]), 587.5618e-6, X, Y)
    point = np.array([0.0, 5.0, -system.object_distance])
    np.testing.assert_array_equal(rays.position, np.broadcast_to(point[:, None], (3, 30)))
    np.testing.assert_array_equal(rays.path, 0.0)


def test_a_near_object_stays_where_it_is_if_the_first_surface_is_tilted_beside_the_axis():
    # A surface that does nothing changes nothing, however it stands before the lens.
    lens = optical_system("six-lens")
    for shift, turn in [((0.0, 8.0), (0.5, 0.0, 0.0)), ((-3.0, 6.0), (0.2, -0.4, 0.1))]:
        idle = Surface("idle", position=np.array([*shift, -20.0]), rotation=cardan(np.array(turn)))
        other = replace(
            lens,
            surfaces=(idle, *lens.surfaces),
            stop=lens.stop + 1,
            object_distance=lens.object_distance - 20.0,
        )
        first, second = paraxial(lens), paraxial(other)
        for key in ("magnification", "stop_radius", "image_na", "defocus", "lagrange"):
            assert getattr(second, key) == pytest.approx(getattr(first, key), rel=1e-12, abs=1e-9)
        field = np.array([1.0, 5.0])
        alone, behind = (pupil_rays(one, field, 587.5618e-6, X, Y) for one in (lens, other))
        np.testing.assert_allclose(behind.position, alone.position, rtol=0, atol=1e-12)
        np.testing.assert_allclose(behind.direction, alone.direction, rtol=0, atol=1e-9)


def test_telecentric_chief_rays_are_parallel_to_the_axis():
    rows = [
        SurfaceRow("M", Conic(-200.0, -1.0), -100.0, "reflect"),
        SurfaceRow("stop", thickness=-50.0),
        SurfaceRow("image"),
    ]
    system = OpticalSystem(
        "telecentric",
        sequential(rows),
        1,
        Pupil("object_na", 0.01),
        object_distance=150.0,
        telecentric=True,
    )
    # A paraboloid sends every ray parallel to its axis through its focus, where the stop is.
    for height in (0.0, 3.0, 20.0):
        rays = pupil_rays(system, np.array([height, 0.0]), 550e-6, np.zeros(1), np.zeros(1))
        np.testing.assert_allclose(rays.direction[:2], 0.0, rtol=0, atol=1e-12)
    moved = OpticalSystem(
        "wrong",
        sequential([rows[0], SurfaceRow("x", thickness=-50.0), *rows[1:]]),
        2,
        Pupil("object_na", 0.01),
        object_distance=150.0,
        telecentric=True,
    )
    with pytest.raises(UserError, match="declared telecentric"):
        pupil_rays(moved, np.zeros(2), 550e-6, X, Y)


def test_rays_are_aimed_through_misaligned_lenses():
    system = optical_system("double-gauss")
    surfaces = list(system.surfaces)
    for number in (0, 1, 2):
        turn = cardan(np.array([0.01, -0.02, 0.0]))
        surfaces[number] = replace(
            surfaces[number], position=surfaces[number].position + np.array([0.4, -0.2, 0.0]), rotation=turn
        )
    crooked = replace(system, surfaces=tuple(surfaces))
    rays = pupil_rays(crooked, np.array([0.0, 0.1]), 587.5618e-6, X, Y)
    radius = paraxial(crooked, 587.5618e-6).stop_radius
    assert np.abs(at_stop(crooked, rays, 587.5618e-6) - radius * np.stack([X, Y])).max() < 1e-9


def test_the_chief_ray_of_an_annular_pupil_is_virtual():
    system = optical_system("tmt-thesis")
    chief = pupil_rays(system, np.zeros(2), 550e-6, np.zeros(1), np.zeros(1))
    sequence, rest = pack(system, 550e-6), moving(system, rest_states(system))
    real, virtual = (trace_sequence_numpy(sequence, chief, rest, ignore) for ignore in (False, True))
    assert real.status[0, 0] == 1
    assert real.vignetted[0] == 1
    assert virtual.status[0, 0] == 0
    assert abs(virtual.x[0, 0]) < 1e-9


@settings(deadline=None, max_examples=6)
@given(st.floats(-0.9, 0.9), st.floats(-0.3, 0.3))
def test_rays_do_not_depend_on_their_neighbors(x, y):
    system = optical_system("double-gauss")
    alone = pupil_rays(system, system.fields[2], 587.5618e-6, np.array([x]), np.array([y]))
    among = pupil_rays(
        system, system.fields[2], 587.5618e-6, np.array([0.5, x, -0.4]), np.array([0.1, y, 0.2])
    )
    np.testing.assert_array_equal(among.position[:, 1], alone.position[:, 0])


def test_rays_that_cannot_reach_the_stop_name_the_surface():
    rows = [
        SurfaceRow("strong", Conic(10.0), 8.0, "refract", GLASS),
        SurfaceRow("flat", Conic(), 3.0, "refract"),
        SurfaceRow("stop", thickness=5.0),
        SurfaceRow("image"),
    ]
    system = OpticalSystem("fast", sequential(rows), 2, Pupil("stop", 30.0))
    with pytest.raises(
        UserError, match=r"of 30 rays of fast cannot be aimed at the stop stop: .* (strong|flat)"
    ):
        pupil_rays(system, np.zeros(2), 550e-6, X, Y)


def test_an_asphere_that_folds_over_is_named():
    shape = EvenAsphere(np.inf, 0.0, (0.0, 3e-3))
    rows = [
        SurfaceRow("cup", shape, 100.0, "refract", GLASS),
        SurfaceRow("flat", Conic(), 3.0, "refract"),
        SurfaceRow("stop", thickness=5.0),
        SurfaceRow("image"),
    ]
    system = OpticalSystem("folding", sequential(rows), 2, Pupil("stop", 20.0))
    with pytest.raises(UserError, match=r"folding cannot be aimed at the stop stop: .*(cup|flat)"):
        pupil_rays(system, np.array([1.2, 0.0]), 550e-6, X, Y)


def test_a_beam_wider_than_an_opening_is_counted_as_vignetted():
    surfaces = sequential(
        [
            SurfaceRow("M1", Conic(-2000.0, -1.0), -1000.0, "reflect", opening=Opening(50.0)),
            SurfaceRow("image"),
        ]
    )
    system = OpticalSystem("small mirror", surfaces, 0, Pupil("entrance_diameter", 200.0))
    x = np.linspace(-1.0, 1.0, 21)
    rays = pupil_rays(system, np.zeros(2), 550e-6, x, np.zeros(21))
    traced = trace_sequence_numpy(pack(system, 550e-6), rays, moving(system, rest_states(system)))
    assert traced.vignetted[0] == np.sum(np.abs(x) > 0.5)
    assert traced.vignetted.sum() == 10


def test_bad_fields_and_objects_are_refused():
    system = optical_system("double-gauss")
    with pytest.raises(UserError, match="2 finite numbers"):
        pupil_rays(system, np.array([0.0, np.nan]), 587e-6, X, Y)
    with pytest.raises(UserError, match="equally long"):
        pupil_rays(system, np.zeros(2), 587e-6, X, Y[:3])
    with pytest.raises(UserError, match="N-SSK2"):
        pupil_rays(system, np.zeros(2), 50e-3, X, Y)
    for nowhere in (0.0, np.nan):
        at = OpticalSystem("x", system.surfaces, 5, Pupil("stop", 3.0), object_distance=nowhere)
        with pytest.raises(UserError, match="object"):
            pupil_rays(at, np.zeros(2), 587e-6, X, Y)


def test_what_is_asked_of_one_system_again_is_computed_once():
    calls = []

    @once_per_system
    def made(system, key):
        calls.append(key)
        return object()

    one, other = optical_system("double-gauss"), replace(optical_system("double-gauss"))
    assert made(one, 1) is made(one, 1)
    assert len({made(one, 1), made(one, 2), made(other, 1)}) == len(calls) == 3
    assert made(one, [1]) is not made(one, [1])  # what cannot be a key is no mistake of its own
