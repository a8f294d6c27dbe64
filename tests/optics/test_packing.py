import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import on_glass, sag_and_slopes, trace_sequence_numpy
from wavequake.optics.media.glasses import AIR, Medium
from wavequake.optics.rays.packing import moving, opening_regions, pack
from wavequake.optics.shapes.sag import deformation_sag, shape_sag
from wavequake.optics.shapes.shapes import (
    Conic,
    EvenAsphere,
    ExtendedPolynomial,
    GridDeformation,
    GridSag,
    Opening,
    ZernikeDeformation,
    ZernikeSag,
)
from wavequake.optics.systems.kinematics import Break, SurfaceRow, rest_poses, rest_states, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface

RNG = np.random.default_rng(8)
X, Y = RNG.uniform(-28.0, 28.0, (2, 60))
GLASS = Medium("glass", "constant", (1.5,))
SHAPES = [
    Conic(),
    Conic(-250.0, -1.3),
    EvenAsphere(300.0, 0.4, (1e-5, -2e-8, 3e-12)),
    ExtendedPolynomial(-400.0, 0.2, (0.1, -0.2, 0.05, 0.03, -0.02, 0.01, 0.0), 50.0),
    ZernikeSag(500.0, -0.5, tuple(RNG.normal(size=37) * 1e-3), 40.0),
    ZernikeSag(500.0, -0.5, tuple(RNG.normal(size=22) * 1e-3), 40.0, 0.3),
    GridSag(-700.0, 0.0, RNG.normal(size=(9, 12)) * 1e-3, 6.0, 8.0),
]
seeds = st.integers(0, 2**32 - 1)


def system_of(*surfaces, **options):
    return OpticalSystem(
        "test", (*surfaces, Surface("image")), 0, Pupil("entrance_diameter", 10.0), **options
    )


def objective():
    """A lens, a deformable mirror, a fold and an image, none of which stands upright."""
    rows = [
        SurfaceRow("front", Conic(200.0), 10.0, "refract", GLASS),
        SurfaceRow("back", EvenAsphere(-200.0, 0.0, (0.0, 1e-8)), 200.0, "refract", AIR),
        SurfaceRow("M1", Conic(-900.0, -1.0), -150.0, "reflect", deformation=ZernikeDeformation(15, 20.0)),
        Break(tilt=(0.1, 0.3, 0.0)),
        SurfaceRow("fold", action="reflect"),
        Break(tilt=(0.1, 0.3, 0.0), thickness=100.0),
        SurfaceRow("image"),
    ]
    return OpticalSystem("objective", sequential(rows), 0, Pupil("entrance_diameter", 20.0))


def bundle():
    x, y = RNG.uniform(-9.0, 9.0, (2, 40))
    direction = np.broadcast_to(np.array([[0.01], [-0.02], [1.0]]), (3, 40)) / np.sqrt(1.0005)
    return Rays(np.stack([x, y, np.full(40, -50.0)]), direction.copy(), np.zeros(40))


def own_motion(system, turn, shift):
    """Return the motions in the surfaces' own frames that a rigid motion of the whole system is."""
    position, rotation = rest_poses(system)
    moved = np.zeros((1, len(position), 6))
    displacement = position @ turn.T + shift - position
    moved[0, :, :3] = np.einsum("lji,lj->li", rotation, displacement)
    own = np.swapaxes(rotation, 1, 2) @ turn @ rotation
    moved[0, :, 3:] = Rotation.from_matrix(own).as_euler("XYZ")
    return moved


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_packed_surfaces_have_the_sag_and_slopes_of_their_shapes(shape):
    element = pack(system_of(Surface("s", shape, action="reflect")), 550e-6).elements[0]
    for got, expected in zip(sag_and_slopes(element, X, Y), shape_sag(shape, X, Y), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-14, rtol=1e-11)


@pytest.mark.parametrize(
    ("form", "numbers"),
    [
        (ZernikeDeformation(28, 40.0), RNG.normal(size=(3, 28)) * 1e-3),
        (ZernikeDeformation(28, 40.0, 0.4), RNG.normal(size=(3, 28)) * 1e-3),
        (GridDeformation(9, 12, 6.0, 8.0), RNG.normal(size=(3, 9, 12)) * 1e-3),
    ],
)
def test_deformations_of_every_instant_are_those_asked_for(form, numbers):
    system = system_of(Surface("s", Conic(-300.0), action="reflect", deformation=form))
    states = rest_states(system, 3)
    states.deformations[0][:] = numbers
    packed, element = moving(system, states), pack(system, 550e-6).elements[0]
    at = np.broadcast_to(X, (3, X.size)), np.broadcast_to(Y, (3, Y.size))
    got = sag_and_slopes(element, *at, packed.deformations[0], packed.grids[0])
    base = shape_sag(Conic(-300.0), X, Y)
    for instant in range(3):
        expected = deformation_sag(form, numbers[instant], X, Y)
        for k in range(3):
            np.testing.assert_allclose(got[k][instant], base[k] + expected[k], atol=1e-14, rtol=1e-11)


def test_indices_follow_the_light_through_glass_and_mirrors():
    sequence = pack(objective(), 550e-6)
    assert sequence.index == 1.0
    assert [element.index for element in sequence.elements] == [1.5, 1.0, 1.0, 1.0, 1.0]


@pytest.mark.parametrize("center", [(0.0, 0.0), (3.0, -4.0)])
def test_openings_pass_what_geometry_says(center):
    x, y = RNG.uniform(-12.0, 12.0, (2, 4000))
    radius = np.hypot(x, y)
    at = x + center[0], y + center[1]
    got = on_glass(opening_regions(Opening(10.0, 3.0, arms=((0.5, 1.0),), center=center)), *at)
    along, across = x * np.cos(0.5) + y * np.sin(0.5), y * np.cos(0.5) - x * np.sin(0.5)
    shadow = (along >= 0.0) & (np.abs(across) <= 0.5)
    np.testing.assert_array_equal(got, (radius <= 10.0) & (radius > 3.0) & ~shadow)
    square = ((-5.0, -4.0), (5.0, -4.0), (5.0, 4.0), (-5.0, 4.0))
    got = on_glass(opening_regions(Opening(corners=square, center=center)), *at)
    np.testing.assert_array_equal(got, (np.abs(x) <= 5.0) & (np.abs(y) <= 4.0))
    assert opening_regions(Opening()) == ()


@pytest.mark.parametrize(
    ("opening", "message"),
    [
        (Opening(corners=((0.0, 0.0), (1.0, 0.0))), "at least 3 corners"),
        (Opening(corners=((0.0, 0.0), (0.0, 1.0), (1.0, 0.0))), "counterclockwise"),
        (Opening(corners=((0.0, 0.0), (4.0, 4.0), (4.0, 0.0), (0.0, 4.0))), "counterclockwise"),
        (
            Opening(corners=((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (1.0, 4.0), (2.0, -1.0), (0.0, 4.0))),
            "its edges cross",
        ),
        (Opening(arms=((0.0, 0.0),)), "spider arm"),
        (Opening(5.0, center=(0.0, np.nan)), "center of an opening"),
        (Opening(5.0, center=(0.0, 1e200)), "center of an opening"),
        (Opening(corners=((0.0, 0.0), (1e200, 0.0), (0.0, 1e200))), "at most 1e.12 mm"),
    ],
)
def test_openings_without_sense_are_refused(opening, message):
    with pytest.raises(UserError, match=message):
        opening_regions(opening)


def test_a_pupil_without_light_is_refused():
    with pytest.raises(UserError, match="0 <= inner < outer"):
        pack(system_of(Surface("s", opening=Opening(3.0, 3.0))), 550e-6)


@settings(deadline=None, max_examples=30)
@given(seeds)
def test_moving_the_whole_system_with_its_light_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.normal(size=3) * 0.5).as_matrix()
    shift = rng.normal(size=3) * 100.0
    system, rays = objective(), bundle()
    sequence, rest = pack(system, 550e-6), rest_states(system)
    at_rest = trace_sequence_numpy(sequence, rays, moving(system, rest))
    with_light = Rays(turn @ rays.position + shift[:, None], turn @ rays.direction, rays.path)
    states = rest_states(system)
    states.surface_motion[:] = own_motion(system, turn, shift)
    moved = trace_sequence_numpy(sequence, with_light, moving(system, states))
    assert (moved.status == 0).all()
    for name in ("path", "x", "y", "u", "v"):
        np.testing.assert_allclose(getattr(moved, name), getattr(at_rest, name), rtol=0, atol=1e-10)


@settings(deadline=None, max_examples=30)
@given(seeds)
def test_turning_the_light_is_turning_the_system_the_other_way(seed):
    angles = np.random.default_rng(seed).normal(size=(1, 2)) * 0.02
    system, rays = objective(), bundle()
    sequence, states = pack(system, 550e-6), rest_states(system)
    states.line_of_sight[:] = angles
    turned = trace_sequence_numpy(sequence, rays, moving(system, states))
    direction = np.array([*np.tan(angles[0]), 1.0])
    axis = np.cross([0.0, 0.0, 1.0], direction)
    size = np.arctan2(np.linalg.norm(axis), 1.0)
    back = Rotation.from_rotvec(-size * axis / np.linalg.norm(axis)).as_matrix()
    states = rest_states(system)
    states.surface_motion[:] = own_motion(system, back, np.zeros(3))  # the pupil's center is the origin
    expected = trace_sequence_numpy(sequence, rays, moving(system, states))
    for name in ("path", "x", "y", "u", "v"):
        np.testing.assert_allclose(getattr(turned, name), getattr(expected, name), rtol=0, atol=1e-10)


def test_a_sphere_that_turns_about_its_center_changes_nothing():
    radius = -500.0
    system = system_of(
        Surface("M", Conic(radius), np.array([0.0, 0.0, 100.0]), action="reflect"),
    )
    states = rest_states(system, 2)
    turn = Rotation.from_euler("XYZ", [0.01, -0.02, 0.03])
    center = np.array([0.0, 0.0, radius])
    states.surface_motion[1, 0, :3] = center - turn.apply(center)
    states.surface_motion[1, 0, 3:] = [0.01, -0.02, 0.03]
    traced = trace_sequence_numpy(pack(system, 550e-6), bundle(), moving(system, states))
    for name in ("path", "x", "y", "u", "v"):
        np.testing.assert_allclose(getattr(traced, name)[1], getattr(traced, name)[0], rtol=0, atol=1e-11)


def test_an_instant_does_not_depend_on_the_others():
    system, rays, rng = objective(), bundle(), np.random.default_rng(1)
    states = rest_states(system, 5)
    states.surface_motion[:] = rng.normal(size=states.surface_motion.shape) * 1e-3
    states.deformations[2][:] = rng.normal(size=(5, 15)) * 1e-4
    states.line_of_sight[:] = rng.normal(size=(5, 2)) * 1e-4
    whole = moving(system, states)
    alone = moving(
        system,
        type(states)(
            states.surface_motion[3:4],
            tuple(None if a is None else a[3:4] for a in states.deformations),
            states.line_of_sight[3:4],
        ),
    )
    np.testing.assert_array_equal(whole.poses[3], alone.poses[0])
    np.testing.assert_allclose(whole.deformations[2][3], alone.deformations[2][0], rtol=1e-14)
    assert trace_sequence_numpy(pack(system, 550e-6), rays, whole).x.shape == (5, 40)


def test_states_that_do_not_fit_are_refused():
    system = objective()
    good = rest_states(system, 2)

    def refused(message, **change):
        fields = {name: getattr(good, name) for name in ("surface_motion", "deformations", "line_of_sight")}
        with pytest.raises(UserError, match=message):
            moving(system, type(good)(**{**fields, **change}))

    def far(angle):
        motion = np.zeros((2, 5, 6))
        motion[1, 0, 4] = angle
        return motion

    none = (None,) * 5
    refused("hold 4 deformations", deformations=none[:4])
    refused("M1 can deform", deformations=none)
    refused("front cannot deform", deformations=(np.zeros((2, 3)), None, np.zeros((2, 15)), None, None))
    refused("deformation of M1 has the shape", deformations=(None, None, np.zeros((2, 14)), None, None))
    refused("M1 holds numbers", deformations=(None, None, np.full((2, 15), np.nan), None, None))
    refused("line of sight", line_of_sight=np.full((2, 2), np.inf))
    refused("motion", surface_motion=np.zeros((2, 6)))
    refused("front at instant 1 is 1e.17; it must be at most 1e.12 mm or rad", surface_motion=far(1e17))
    refused("front at instant 1 is 1e.300", surface_motion=far(-1e300))
    refused("front at instant 1 is not a finite number", surface_motion=far(np.inf))


def test_light_at_a_telecentric_system_cannot_turn_about_its_pupil():
    flat = OpticalSystem(
        "telecentric",
        sequential(
            [
                SurfaceRow("M", Conic(-200.0), -100.0, "reflect"),
                SurfaceRow("stop", thickness=-50.0),
                SurfaceRow("image"),
            ]
        ),
        1,
        Pupil("object_na", 0.05),
        object_distance=200.0,
    )
    states = rest_states(flat)
    states.line_of_sight[:] = 1e-3
    with pytest.raises(UserError, match="pupil of telecentric is at infinity"):
        moving(flat, states)
