"""Fish-eyes: light that comes from the side and from behind the first surface."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.kernels.trace.status import OK
from wavequake.optics.media.glasses import Medium
from wavequake.optics.rays.aiming import pupil_rays
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.stop_following import follow_stop, meet_stop, steering
from wavequake.optics.shapes.shapes import Conic
from wavequake.optics.systems.info import info
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil
from wavequake.optics.zemax.read import parse_zmx

GLASS = Medium("glass", "constant", (1.8,))
ZERO = np.zeros(1)


def fish_eye(*fields_deg):
    """Two meniscus lenses and a stop; the first one takes in more than a half space."""
    rows = [
        SurfaceRow("1", Conic(100.0), 4.0, "refract", GLASS),
        SurfaceRow("2", Conic(30.0), 30.0, "refract"),
        SurfaceRow("3", Conic(60.0), 3.0, "refract", GLASS),
        SurfaceRow("4", Conic(25.0), 30.0, "refract"),
        SurfaceRow("stop", Conic(), 40.0),
        SurfaceRow("image", Conic(), 0.0),
    ]
    return OpticalSystem(
        "fish-eye",
        sequential(rows),
        4,
        Pupil("stop", 1.0),
        fields=np.deg2rad(np.array(fields_deg)),
        wavelengths=np.array([500e-6]),
    )


def arrival(system, field_deg, x=ZERO, y=ZERO):
    rays = pupil_rays(system, np.deg2rad(np.array(field_deg)), 500e-6, x, y)
    traced = trace_sequence_numpy(pack(system, 500e-6), rays, moving(system, rest_states(system)))
    assert (traced.status == OK).all()
    return rays, traced


@pytest.mark.parametrize("field", [(0.0, 90.0), (0.0, 97.0), (-95.0, 0.0), (10.0, 95.0)])
def test_light_from_the_side_goes_as_its_angles_say_and_meets_the_stop(field):
    system = fish_eye(field)
    rays, _ = arrival(system, field, np.array([0.0, 0.5]), np.array([0.0, -0.3]))
    x, y = np.deg2rad(field)
    expected = np.array([np.sin(x) * np.cos(y), np.cos(x) * np.sin(y), np.cos(x) * np.cos(y)])
    expected /= np.linalg.norm(expected)
    np.testing.assert_allclose(rays.direction, np.stack([expected] * 2, axis=1), rtol=0, atol=1e-15)
    rest = moving(system, rest_states(system))
    met = meet_stop(pack(system, 500e-6), rays, rest, system.stop)[:, 0]
    np.testing.assert_allclose(met, [[0.0, 0.5], [0.0, -0.3]], rtol=0, atol=1e-9)


def test_light_from_90_degrees_on_is_that_of_a_little_less():
    step = 1e-5
    before, at, beyond = (
        arrival(fish_eye((0.0, 90.0 + k * step)), (0.0, 90.0 + k * step), ZERO + 0.4, ZERO + 0.7)[1]
        for k in (-1, 0, 1)
    )
    for name in ("x", "y", "path"):
        one, two, three = (getattr(traced, name)[0, 0] for traced in (before, at, beyond))
        assert abs(three - two) < 1e-4
        assert abs(one + three - 2.0 * two) < 1e-9, name


def test_chief_rays_from_the_side_follow_the_stop():
    system = fish_eye((0.0, 95.0))
    sequence = pack(system, 500e-6)
    (chief, _) = arrival(system, (0.0, 95.0))
    states = rest_states(system, 2)
    states.surface_motion[1, 0] = (0.01, -0.02, 0.005, 1e-4, 0.0, 0.0)
    light = moving(system, states)
    assert np.abs(meet_stop(sequence, chief, light, system.stop)[:, 1]).max() > 1e-3
    followed = follow_stop(system, sequence, chief, steering(system, sequence, chief), light)
    assert np.abs(meet_stop(sequence, chief, followed, system.stop)).max() < 1e-9


@pytest.mark.parametrize("field", [(95.0, 95.0), (0.0, 180.0)])
def test_light_that_no_angles_say_is_refused(field):
    with pytest.raises(UserError, match="its light does not come in"):
        pack(fish_eye(field), 500e-6)


def test_info_leaves_out_what_a_wide_field_does_not_have():
    system = fish_eye((0.0, 95.0))
    assert "Lagrange" not in info(system)
    assert "(0, 95) deg" in info(system)
    assert "Lagrange" in info(replace(system, fields=np.deg2rad([[0.0, 60.0]])))


def test_light_of_wide_fields_is_launched_as_that_of_smaller_ones():
    # Below 85 degrees rays start on the first vertex plane and meet spheres by their own sense.
    steps = np.array([84.9998, 84.9999, 85.0001, 85.0002])
    ends = [arrival(fish_eye((0.0, one)), (0.0, one), ZERO + 0.4, ZERO + 0.7)[1] for one in steps]
    for name in ("x", "y", "path"):
        found = np.array([getattr(traced, name)[0, 0] for traced in ends])
        slope = (found[2] - found[1]) / (steps[2] - steps[1])
        assert abs(found[3] - found[2] - slope * 1e-4) < 1e-8, name
        assert abs(found[1] - found[0] - slope * 1e-4) < 1e-8, name


@pytest.mark.parametrize(("angle", "said"), [(90, True), (-90, True), (89, False), (100, False)])
def test_lens_files_say_that_another_angle_than_90_degrees_is_traced_elsewhere(angle, said):
    head = f"ENPD 1\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0\nYFLN {angle}\n"
    rows = "SURF 0\n  DISZ INFINITY\nSURF 1\n  STOP\n  DISZ 9\nSURF 2\n  DISZ 0\n"
    system = parse_zmx(head + rows, "lens.zmx")
    assert ("OpticStudio traces a field of 90 degrees as one of 89.8" in system.note) == said


def test_light_from_behind_that_misses_is_refused_without_warnings():
    with pytest.raises(UserError, match="misses that surface"):
        arrival(fish_eye((0.0, 180.0 - 1e-7)), (0.0, 180.0 - 1e-7))


def test_an_object_on_the_first_surface_but_for_rounding_is_refused():
    near = replace(fish_eye((0.0, 0.0)), object_distance=1e-200)
    with pytest.raises(UserError, match="stands in the first surface"):
        arrival(near, (0.0, 0.0))
