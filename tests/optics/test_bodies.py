from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.segments.kinematics import cardan
from wavequake.optics.shapes.shapes import Conic
from wavequake.optics.systems.bodies import Body, beam_extents, beam_radii, rigid_body, with_bodies
from wavequake.optics.systems.kinematics import moved_poses, rest_states
from wavequake.optics.systems.paraxial import entrance_pupil_center, paraxial
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface
from wavequake.optics.wavefronts.wavefront import measure_system, prepare_system

LENS = replace(optical_system("double-gauss"), pupil=Pupil("f_number", 8.0))
GLASS = tuple(surface.name for surface in LENS.surfaces[:-1])


def prepared_lens(field=0):
    rays = sunflower(0.0, 1.0, 200)
    return prepare_system(LENS, rays.x, rays.y, rays.weight, 28, field)


def states_of(system, bodies, sight=None):
    instants = len(bodies[0][1])
    states = rest_states(system, instants)
    motion = with_bodies(system, states.surface_motion, bodies)
    return replace(
        states, surface_motion=motion, line_of_sight=np.zeros((instants, 2)) if sight is None else sight
    )


def turned(**angles):
    motion = np.zeros((1, 6))
    for name, value in angles.items():
        motion[0, ("dx", "dy", "dz", "rx", "ry", "rz").index(name)] = value
    return motion


@given(
    st.lists(st.floats(-1.4, 1.4), min_size=3, max_size=3), st.lists(st.floats(-9, 9), min_size=3, max_size=3)
)
def test_every_point_of_a_body_moves_rigidly(angles, shift):
    """Against the definition: p -> P + Q (p - P) + d, at the vertex and along each axis of a surface."""
    body = rigid_body(LENS, "lens", ["surface 1", "surface 2"], (1.0, -2.0, 30.0))
    motion = with_bodies(LENS, rest_states(LENS).surface_motion, [(body, np.array([[*shift, *angles]]))])
    position, rotation = moved_poses(LENS, motion)
    turn = cardan(np.array(angles))
    for index in (0, 1):
        expected = body.point + turn @ (LENS.surfaces[index].position - body.point) + np.array(shift)
        np.testing.assert_allclose(position[0, index], expected, rtol=0, atol=1e-12)
        np.testing.assert_allclose(rotation[0, index], turn, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(motion[:, 2:], 0.0)


def test_a_body_has_the_axes_of_its_first_surface():
    turn = cardan(np.array([0.3, -0.2, 0.5]))
    surfaces = (
        Surface("front", Conic(100.0), np.array([0.0, 0.0, 5.0]), turn, "refract"),
        Surface("image", position=np.array([0.0, 0.0, 50.0])),
    )
    system = OpticalSystem("askew", surfaces, 0, Pupil("entrance_diameter", 1.0))
    motion = with_bodies(
        system,
        rest_states(system).surface_motion,
        [(rigid_body(system, "body", ["front", "image"]), turned(dx=2.0))],
    )
    assert motion[0, 0] == pytest.approx([2.0, 0, 0, 0, 0, 0], abs=1e-15)
    np.testing.assert_allclose(motion[0, 1, :3], turn[:, 0] * 2.0, rtol=0, atol=1e-15)


@pytest.mark.parametrize("angle", [1e-3, 0.1])
def test_turning_everything_with_the_light_changes_nothing(angle):
    """The lens, its image and the bundle turn about the entrance pupil as one."""
    names = [surface.name for surface in LENS.surfaces]
    body = rigid_body(LENS, "all", names, entrance_pupil_center(LENS))
    prepared = prepared_lens(field=1)
    rest = measure_system(prepared, rest_states(LENS), NUMPY)
    for motion, sight in ((turned(rx=-angle), (0.0, angle)), (turned(ry=angle), (angle, 0.0))):
        found = measure_system(prepared, states_of(LENS, [(body, motion)], np.array([sight])), NUMPY)
        np.testing.assert_allclose(found.zernike, rest.zernike, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.los, rest.los, rtol=0, atol=1e-10)


@pytest.mark.parametrize("beyond", [0.0, 10.0])
def test_nodal_slide(beyond):
    """A lens in air that turns about its rear nodal point leaves the image of a star where it is."""
    data = paraxial(LENS)
    nodal = LENS.surfaces[-2].position[2] + data.rear_principal
    body = rigid_body(LENS, "lens", GLASS, (0.0, 0.0, nodal + beyond))
    prepared, angle = prepared_lens(), 1e-4
    found = measure_system(prepared, states_of(LENS, [(body, turned(rx=angle))]), NUMPY)
    # The nodal point moves by (R - 1) a; rx turns +z towards -y.
    assert found.chief[0, 1] == pytest.approx(beyond * angle, abs=2e-7)


def test_a_sphere_that_turns_about_its_center_stays():
    radius = -1000.0
    surfaces = (
        Surface("stop", position=np.array([0.0, 0.0, -900.0])),
        Surface("mirror", Conic(radius), action="reflect"),
        Surface("image", position=np.array([0.0, 0.0, radius / 2])),
    )
    system = OpticalSystem("schmidt", surfaces, 0, Pupil("entrance_diameter", 100.0))
    rays = sunflower(0.0, 1.0, 100)
    prepared = prepare_system(system, rays.x, rays.y, rays.weight, 15)
    body = rigid_body(system, "mirror about its center", ["mirror"], (0.0, 0.0, radius))
    rest = measure_system(prepared, rest_states(system), NUMPY)
    found = measure_system(prepared, states_of(system, [(body, turned(rx=0.01, ry=-0.02, rz=0.3))]), NUMPY)
    np.testing.assert_allclose(found.zernike, rest.zernike, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.centroid, rest.centroid, rtol=0, atol=1e-10)


def test_later_bodies_carry_earlier_ones_and_own_motion():
    """Lens in a barrel: both turn about one point, so the angles add."""
    point = (0.0, 0.0, 20.0)
    inner = rigid_body(LENS, "lens", ["surface 1", "surface 2"], point)
    outer = rigid_body(LENS, "barrel", GLASS, point)
    one = with_bodies(
        LENS, rest_states(LENS).surface_motion, [(inner, turned(rx=0.1)), (outer, turned(rx=0.2))]
    )
    two = with_bodies(LENS, rest_states(LENS).surface_motion, [(outer, turned(rx=0.2))])
    both = with_bodies(LENS, rest_states(LENS).surface_motion, [(outer, turned(rx=0.1 + 0.2))])
    np.testing.assert_allclose(one[:, :2], both[:, :2], rtol=0, atol=1e-13)
    np.testing.assert_array_equal(one[:, 2:], two[:, 2:])
    own = rest_states(LENS).surface_motion
    own[0, 0, 2] = 0.5
    carried = with_bodies(LENS, own, [(outer, turned(rz=np.pi / 2, dx=1.0))])
    assert carried[0, 0] == pytest.approx([1.0, 0.0, 0.5, 0.0, 0.0, np.pi / 2], abs=1e-14)


def test_beams_fill_what_first_order_optics_says():
    system = replace(optical_system("double-gauss"), pupil=Pupil("f_number", 50.0))
    data = paraxial(system)
    marginal = data.entrance_pupil_diameter / 2
    assert beam_radii(replace(system, fields=np.zeros((1, 2))), [0])[0] == pytest.approx(marginal, rel=1e-3)
    small = np.array([[0.0, 0.0], [0.0, 0.01]])
    chief = np.tan(0.01) * data.entrance_pupil
    assert beam_radii(replace(system, fields=small), [0])[0] == pytest.approx(marginal + chief, rel=2e-3)
    # Across the field the beam is as wide as on the axis.
    extents = beam_extents(replace(system, fields=small), [0])[0]
    assert extents == pytest.approx([marginal, marginal + chief], rel=2e-3)
    everywhere = beam_radii(replace(system, fields=np.zeros((1, 2))), range(len(system.surfaces)))
    assert everywhere[system.stop] == pytest.approx(data.stop_radius, rel=1e-3)
    assert everywhere[-1] < 0.01  # the focus


def test_what_does_not_exist_is_named():
    with pytest.raises(UserError, match="did you mean 'surface 1'"):
        rigid_body(LENS, "L1", ["surfac 1"])
    with pytest.raises(UserError, match="twice"):
        rigid_body(LENS, "L1", ["surface 1", "surface 1"])
    middle = rigid_body(LENS, "L1", ["surface 2", "surface 1"])
    assert isinstance(middle, Body)
    assert middle.point == pytest.approx([0.0, 0.0, 4.375])
