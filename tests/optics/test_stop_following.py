"""Light follows a stop that moves, against systems that are built with the stop where it has moved to."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.trace.sequence import Moving
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.rays.packing import moving
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.rays.stop_following import follow_stop, stays
from wavequake.optics.segments.kinematics import cardan
from wavequake.optics.shapes.shapes import Conic, Opening, ZernikeDeformation
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, Pupil
from wavequake.optics.wavefronts.wavefront import incoming_light, measure_system, prepare_system

POINTS = sunflower(0.0, 1.0, 120)
LENSES = ["double-gauss", "six-lens", "euv", "gregorian"]
POINTS_XY = np.stack([POINTS.x, POINTS.y])
# How far rays of the outermost field miss their points of a moved stop, as a share of its shift.
MISS = {"double-gauss": 0.06, "six-lens": 1e-3, "gregorian": 1e-6}


def prepared_of(system, field=-1):
    field = range(len(system.fields))[field]
    return prepare_system(system, POINTS.x, POINTS.y, POINTS.weight, 15, field)


def at_stop(prepared, light, rays):
    """Return where rays meet the stop, (2, T, N), in its frame at each instant."""
    stop = prepared.system.stop
    part = replace(prepared.sequence, elements=prepared.sequence.elements[: stop + 1])
    short = Moving(light.poses[:, : stop + 1], light.deformations[: stop + 1], light.grids[: stop + 1])
    traced = trace_sequence_numpy(part, rays, short, True)
    return np.stack([traced.x, traced.y])


def displaced(system, surface, motion):
    """The system built with a surface where its motion takes it."""
    one = system.surfaces[surface]
    rotation = one.rotation @ cardan(motion[None, 3:])[0]
    moved = replace(one, position=one.position + one.rotation @ motion[:3], rotation=rotation)
    return replace(system, surfaces=(*system.surfaces[:surface], moved, *system.surfaces[surface + 1 :]))


@pytest.mark.parametrize("name", ["double-gauss", "six-lens", "gregorian"])
def test_a_shifted_stop_is_the_system_built_with_it(name):
    system = optical_system(name)
    prepared = prepared_of(system)
    size = 1e-4 * paraxial(system).stop_radius
    states = rest_states(system, 2)
    states.surface_motion[1, system.stop, :2] = 0.6 * size, -0.8 * size
    found = measure_system(prepared, states, NUMPY)
    built = prepared_of(displaced(system, system.stop, states.surface_motion[1, system.stop]))
    truth = measure_system(built, rest_states(built.system), NUMPY)
    changed = np.abs(truth.zernike[0, 1:] - found.zernike[0, 1:]).max()
    share = 3 * MISS[name]
    np.testing.assert_allclose(
        found.zernike[1, 1:], truth.zernike[0, 1:], rtol=0, atol=share * changed + 1e-8
    )
    np.testing.assert_allclose(found.chief[1], truth.chief[0], rtol=0, atol=1e-10)
    target = paraxial(system, prepared.wavelength).stop_radius * POINTS_XY
    miss = np.abs(at_stop(prepared, incoming_light(prepared, states), prepared.rays)[:, 1] - target).max()
    assert miss < MISS[name] * size


@pytest.mark.parametrize("name", LENSES)
def test_any_motion_before_the_stop_keeps_the_chief_ray_in_its_center(name):
    system = optical_system(name)
    prepared = prepared_of(system)
    states = rest_states(system, 3)
    moves = np.random.default_rng(3).normal(size=(2, system.stop + 1, 6))
    states.surface_motion[1:, : system.stop + 1] = moves * np.repeat([1e-3, 1e-5], 3)
    beside = at_stop(prepared, moving(system, states), prepared.chief)
    after = at_stop(prepared, incoming_light(prepared, states), prepared.chief)
    assert np.abs(beside[:, 1:]).max() > 1e-5
    assert np.abs(after).max() <= 1e-9


def test_a_stop_that_moves_within_its_beam_stops_no_light():
    """Its opening is 1 % wider than the beam; 5 % off, a beam that stays behind would lose a crescent."""
    system = optical_system("double-gauss")
    radius = paraxial(system).stop_radius
    surfaces = list(system.surfaces)
    surfaces[system.stop] = replace(surfaces[system.stop], opening=Opening(1.01 * radius))
    system = replace(system, surfaces=tuple(surfaces))
    prepared = prepared_of(system, 0)
    states = rest_states(system, 2)
    states.surface_motion[1, system.stop, 0] = 0.05 * radius
    assert measure_system(prepared, states, NUMPY).vignetted.tolist() == [0, 0]
    stays = trace_sequence_numpy(prepared.sequence, prepared.rays, moving(system, states))
    assert stays.vignetted.sum() > 0


@pytest.mark.parametrize("name", LENSES)
def test_at_rest_the_light_is_left_alone(name):
    system = optical_system(name)
    states = rest_states(system, 2)
    np.testing.assert_array_equal(
        incoming_light(prepared_of(system), states).poses, moving(system, states).poses
    )


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("disturbed", ["nothing", "after", "before", "stop", "light"])
def test_the_trace_to_the_stop_is_left_out_only_where_nothing_up_to_it_moves(name, disturbed):
    system = optical_system(name)
    prepared = prepared_of(system)
    states = rest_states(system, 2)
    place = {"after": -1, "before": max(system.stop - 1, 0), "stop": system.stop}.get(disturbed)
    if place is not None:
        states.surface_motion[1, place, 0] = 1e-3
    if disturbed == "light":
        states.line_of_sight[1, 0] = 1e-5
    stay = disturbed in ("nothing", "after")
    assert stays(system, prepared.chief, states) == stay
    light = moving(system, states)
    followed = follow_stop(system, prepared.sequence, prepared.chief, prepared.steering, light)
    if stay:
        np.testing.assert_array_equal(followed.poses, light.poses)
    np.testing.assert_array_equal(incoming_light(prepared, states).poses, followed.poses)


@pytest.mark.parametrize("at", ["before the stop", "oblique to the stop", "upright on the stop"])
def test_a_surface_that_deforms_before_the_stop_moves_the_light_to_it(at):
    """A mirror that tilts by deformation sends the beam beside a stop after it; at the stop itself it cannot.

    Only a chief ray that comes obliquely meets a raised center of the stop elsewhere.
    """
    form = ZernikeDeformation(4, 100.0, 0.0)
    rows = [
        SurfaceRow("mirror", Conic(-2000.0, -1.0), -300.0, "reflect", deformation=form),
        SurfaceRow("stop", thickness=-700.0),
        SurfaceRow("image"),
    ]
    stop, field = (1 if at.startswith("before") else 0), (0.01 if at.startswith("oblique") else 0.0)
    pupil = Pupil("entrance_diameter", 150.0)
    system = OpticalSystem("bent", sequential(rows), stop, pupil, fields=np.array([[field, 0.0]]))
    prepared = prepared_of(system)
    states = rest_states(system, 2)
    states.deformations[0][1, :2] = 1e-2, 1e-3
    upright = at.startswith("upright")
    assert stays(system, prepared.chief, states) == upright
    light = moving(system, states)
    followed = follow_stop(system, prepared.sequence, prepared.chief, prepared.steering, light)
    assert (followed.poses == light.poses).all() == upright
    np.testing.assert_array_equal(incoming_light(prepared, states).poses, followed.poses)


def test_an_instant_does_not_depend_on_its_batch():
    system = optical_system("six-lens")
    prepared = prepared_of(system)
    states = rest_states(system, 4)
    states.surface_motion[1:] = (
        np.random.default_rng(5).normal(size=(3, *states.surface_motion.shape[1:])) * 1e-4
    )
    whole = incoming_light(prepared, states).poses
    for one in range(4):
        alone = replace(
            states,
            surface_motion=states.surface_motion[one : one + 1],
            line_of_sight=states.line_of_sight[one : one + 1],
        )
        np.testing.assert_array_equal(incoming_light(prepared, alone).poses[0], whole[one])


def test_a_chief_ray_that_cannot_reach_the_stop_leaves_the_light_as_it_is():
    system = optical_system("double-gauss")
    prepared = prepared_of(system)
    states = rest_states(system, 2)
    states.surface_motion[1, 1, 0] = 1e4  # the first lens is gone
    np.testing.assert_array_equal(incoming_light(prepared, states).poses, moving(system, states).poses)
    assert np.isnan(measure_system(prepared, states, NUMPY).los[1]).all()


def test_the_line_of_sight_still_turns_the_light_about_the_pupil():
    """A star 10 urad beside the axis has its image at f times that: light keeps its direction."""
    system = optical_system("double-gauss")
    prepared = prepared_of(system, 0)
    states = rest_states(system, 1)
    states.line_of_sight[:] = [[1e-5, -2e-5]]
    found = measure_system(prepared, states, NUMPY).los[0]
    np.testing.assert_allclose(found, paraxial(system).focal_length * np.array([1e-5, -2e-5]), rtol=5e-2)


def test_a_telecentric_stop_turns_the_light_by_its_shift_over_the_focal_length():
    """A paraboloid of f = 100 mm, its stop in the focus: rays at an angle a meet its plane f tan a off."""
    rows = [
        SurfaceRow("M", Conic(-200.0, -1.0), -100.0, "reflect"),
        SurfaceRow("stop", thickness=-200.0),
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
    prepared = prepared_of(system)
    states = rest_states(system, 3)
    states.surface_motion[1:, 1, 0] = 0.01, -0.01
    light = incoming_light(prepared, states)
    assert np.abs(at_stop(prepared, light, prepared.chief)).max() <= 1e-9
    still = moving(system, rest_states(system)).poses[0, 0, :9].reshape(3, 3)
    turn = light.poses[:, 0, :9].reshape(3, 3, 3) @ still.T
    angle = np.arctan2(turn[:, 0, 2], turn[:, 2, 2])
    np.testing.assert_allclose(np.abs(angle), [0.0, 1e-4, 1e-4], rtol=1e-5)
    assert angle[1] == pytest.approx(-angle[2], rel=1e-5)
