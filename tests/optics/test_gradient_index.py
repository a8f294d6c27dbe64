"""Media whose index varies, inside optical systems, against closed forms and an adaptive integrator."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, list_devices
from wavequake.kernels.trace.sequence import Element, Gradient, Moving, Rays, Sequence
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.kernels.trace.status import MISS, OK, TOTAL_REFLECTION
from wavequake.optics.media.glasses import AIR, constant, glass, refractive_index
from wavequake.optics.media.gradients import GradientIndex, axial, luneburg, selfoc
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.segments.kinematics import cardan
from wavequake.optics.shapes.shapes import Conic, ZernikeDeformation
from wavequake.optics.systems.info import info
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface
from wavequake.optics.wavefronts.wavefront import measure_system, prepare_system

OPENCL = [device for device in list_devices() if device.kind != "numpy"]
# A processor once more in the shape of a GPU, which has one ray for each work-item.
DEVICES = [NUMPY, *OPENCL, *(replace(one, kind="gpu", vector_width=1) for one in OPENCL if one.kind == "cpu")]

PLANE = Conic()
N0, G = 1.6, 0.05  # a quarter of its pitch is 31.4 mm
WAVE = 550e-6


def system(medium, length, ends=(PLANE, PLANE), gap=0.0, **keys):
    rows = [
        SurfaceRow("front", ends[0], length, "refract", medium),
        SurfaceRow("rear", ends[1], gap, "refract", AIR),
        SurfaceRow("image"),
    ]
    return OpticalSystem("rod", sequential(rows), 0, Pupil("entrance_diameter", 2.0), **keys)


def bundle(x, y=0.0, slopes=(0.0, 0.0), z=0.0):
    x, y, u, v = np.broadcast_arrays(*np.atleast_1d(x, y, *slopes))
    position = np.stack([x, y, np.full(x.shape, z)]).astype(float)
    direction = np.stack([u, v, np.ones(x.shape)]).astype(float)
    return Rays(position, direction / np.linalg.norm(direction, axis=0), np.zeros(x.shape))


@pytest.fixture(params=DEVICES, ids=lambda device: f"{device.kind}-{device.vector_width}")
def trace_all(request):
    """Return what traces a sequence on a device."""
    return partial(trace_sequence, device=request.param)


@pytest.fixture
def trace(trace_all):
    """Return what traces a system at rest on a device."""
    return lambda optics, rays: trace_all(pack(optics, WAVE), rays, moving(optics, rest_states(optics)))


def rod_in_closed_form(rays, length):
    """Rays behind a plane rod in n² = n0² (1 - g² r²): x = A sin(w t + phase) in both planes, z = T_z t."""
    n2 = N0**2 * (1 - G**2 * np.sum(rays.position[:2] ** 2, axis=0))
    across = rays.direction[:2]  # a plane face in air keeps the transverse part of n d
    w, t = N0 * G, length / np.sqrt(n2 - np.sum(across**2, axis=0))
    cos, sin = np.cos(w * t), np.sin(w * t)
    x0, v = rays.position[:2], across / w
    # The integral of n² = n0² - w² r² along the way, with x = x0 cos + v sin.
    squares = (x0**2 + v**2) / 2 * t + (x0**2 - v**2) * np.sin(2 * w * t) / (4 * w) + x0 * v * sin**2 / w
    path = N0**2 * t - w**2 * np.sum(squares, axis=0)
    return x0 * cos + v * sin, across * cos - w * x0 * sin, path


def test_selfoc_rays_are_sinusoids(trace):
    rays = bundle([0.0, 1.0, -2.0, 3.0], [0.5, 0.0, 1.0, -2.0], slopes=(0.1, -0.05))
    traced = trace(system(selfoc(N0, G, step=0.1), 100.0), rays)
    place, direction, path = rod_in_closed_form(rays, 100.0)
    np.testing.assert_allclose(np.stack([traced.x[0], traced.y[0]]), place, rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.stack([traced.u[0], traced.v[0]]), direction, rtol=0, atol=1e-11)
    np.testing.assert_allclose(traced.path[0], path, rtol=1e-12)
    assert (traced.status == OK).all()


def test_default_steps_are_good_to_1e_10_mm(trace):
    rays = bundle([0.0, 1.0, -2.0, 3.0], [0.5, 0.0, 1.0, -2.0], slopes=(0.1, -0.05))
    traced = trace(system(selfoc(N0, G), 31.4), rays)
    place, _, path = rod_in_closed_form(rays, 31.4)
    np.testing.assert_allclose(np.stack([traced.x[0], traced.y[0]]), place, rtol=0, atol=1e-9)
    np.testing.assert_allclose(traced.path[0], path, rtol=0, atol=5e-10)  # 1e-6 waves


def test_the_order_of_convergence_is_four(trace):
    rays = bundle([2.0, -3.0], [1.0, 0.5], slopes=(0.1, 0.2))
    place, direction, path = rod_in_closed_form(rays, 60.0)
    errors = []
    for step in (4.0, 2.0, 1.0, 0.5):
        traced = trace(system(selfoc(N0, G, step=step), 60.0), rays)
        errors.append(
            [
                np.abs(traced.x - place[0]).max(),
                np.abs(traced.u - direction[0]).max(),
                np.abs(traced.path - path).max(),
            ]
        )
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders[-1], 4.0, rtol=0, atol=0.25)
    assert orders.min() > 3.5


@pytest.mark.parametrize(("steps", "bound"), [(10, 1e-5), (100, 1e-9), (1000, 1e-13)])
def test_stated_accuracy_of_a_luneburg_lens_per_number_of_steps(trace, steps, bound):
    """Every ray ends at the antipode; the path from the front vertex plane is R (1 + pi / 2) for all."""
    R = 10.0
    lens = system(luneburg(R, 2 * R * np.pi / 4 / steps), 2 * R, (Conic(R), Conic(-R)))
    rays = bundle([0.0, 1.0, -4.0, 7.0], [0.0, 2.0, 3.0, -4.0])
    traced = trace(lens, rays)
    away = np.abs([traced.x, traced.y, traced.path - R * (1 + np.pi / 2)]).max()
    assert away / (2 * R) < bound
    # A ray at the height h arrives under the angle asin(h / R).
    np.testing.assert_allclose([traced.u[0], traced.v[0]], -rays.position[:2] / R, rtol=0, atol=3 * bound)


def test_a_rod_has_its_focus_in_first_order_and_in_the_trace(trace):
    """A plane rod of length L has f = 1 / (n0 g sin g L) and focuses at cot(g L) / (n0 g) behind its face."""
    length = 20.0
    back = 1 / (N0 * G * np.tan(G * length))
    optics = system(selfoc(N0, G), length, gap=back)
    data = paraxial(optics)
    assert data.focal_length == pytest.approx(1 / (N0 * G * np.sin(G * length)), rel=1e-13)
    assert data.back_focus == pytest.approx(back, rel=1e-13)
    assert data.defocus == pytest.approx(0.0, abs=1e-12)
    traced = trace(optics, bundle([1e-4]))
    np.testing.assert_allclose(traced.x, 0.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(-1e-4 / traced.u, data.focal_length, rtol=1e-8)


def test_a_quarter_pitch_collimates_a_point_on_its_face(trace):
    quarter = np.pi / 2 / G
    rays = bundle(np.zeros(3), slopes=(np.array([0.0, 1e-4, 2e-4]), 0.0))
    traced = trace(system(selfoc(N0, G), quarter), rays)
    np.testing.assert_allclose(traced.u, 0.0, rtol=0, atol=1e-11)
    np.testing.assert_allclose(traced.x[0], np.array([0.0, 1e-4, 2e-4]) / (N0 * G), rtol=1e-6)
    np.testing.assert_allclose(np.ptp(traced.path), 0.0, rtol=0, atol=1e-9)  # a plane wave leaves


def test_a_rod_images_a_near_object_as_its_matrix_says(trace):
    """(y, n u) goes through [[cos, sin / (n0 g)], [-n0 g sin, cos]] of g L."""
    length, distance, w = 45.0, 8.0, N0 * G
    cos, sin = np.cos(G * length), np.sin(G * length)
    matrix = np.array([[cos, sin / w], [-w * sin, cos]]) @ np.array([[1.0, distance], [0.0, 1.0]])
    image = -matrix[0, 1] / matrix[1, 1]
    assert image > 0
    optics = replace(
        system(selfoc(N0, G), length, gap=image, object_distance=distance, fields=np.array([[0.0, 1e-4]])),
        pupil=Pupil("object_na", 1e-4),
    )
    magnification = matrix[0, 0] + image * matrix[1, 0]
    assert paraxial(optics).magnification == pytest.approx(magnification, rel=1e-12)
    traced = trace(optics, bundle(np.full(3, 1e-4), slopes=([-1e-4, 0.0, 1e-4], 0.0), z=-distance))
    np.testing.assert_allclose(traced.x[0], magnification * 1e-4, rtol=1e-6)


def test_wavefront_of_a_quarter_pitch_lens_is_that_of_its_paths():
    """The focus lies on the rear face: OPD = chief path less the ray's to the sphere, by the closed form."""
    quarter = np.pi / 2 / G
    lens = system(selfoc(N0, G), quarter)
    points = sunflower(0.0, 1.0, 60)
    prepared = prepare_system(lens, points.x, points.y, points.weight, 11)
    found = measure_system(prepared, rest_states(lens), NUMPY)
    place, direction, path = rod_in_closed_form(bundle(points.x, points.y), quarter)
    radius = prepared.sphere_radius
    cosine = np.sqrt(1 - np.sum(direction**2, axis=0))
    unit = np.stack([*direction, cosine])
    spot = np.stack([*place, np.zeros(60)])
    along = np.sum(spot * unit, axis=0)
    back = -along - np.sign(radius) * np.sqrt(along**2 - np.sum(spot**2, axis=0) + radius**2)
    opd = (N0 * quarter - radius - path - back) / WAVE
    opd -= opd.mean()
    np.testing.assert_allclose(found.rms_raw[0], np.sqrt(np.mean(opd**2)), rtol=1e-6)
    assert found.lost[0] == 0


def test_glass_of_the_catalogue_on_the_axis_keeps_its_dispersion():
    medium = GradientIndex("rod", glass("N-BK7"), (-0.005,))
    first, second = (pack(system(medium, 5.0), wave).elements[0] for wave in (486e-6, 656e-6))
    assert first.index == refractive_index(glass("N-BK7"), 486e-6) > second.index


def test_an_axial_gradient_keeps_the_transverse_ray_vector(trace):
    rays = bundle([1.0, -1.0], slopes=(0.3, -0.2))
    traced = trace(system(axial((1.5, 0.02, -0.001), 0.05), 10.0), rays)
    np.testing.assert_allclose([traced.u[0], traced.v[0]], rays.direction[:2], rtol=1e-12)
    # Snell's law layer by layer: dx/dz = p / sqrt(n² - p² - q²).
    p, q = rays.direction[:2, 0]
    z, weight = np.polynomial.legendre.leggauss(40)
    z, weight = 5 * (z + 1), 5 * weight
    n = 1.5 + 0.02 * z - 0.001 * z**2
    root = np.sqrt(n**2 - p**2 - q**2)
    np.testing.assert_allclose(traced.x[0] - rays.position[0], np.sum(weight * p / root), rtol=1e-10)
    np.testing.assert_allclose(traced.path[0], np.sum(weight * n**2 / root), rtol=1e-10)


def test_first_order_of_radial_and_axial_gradients_is_that_of_narrow_rays(trace):
    medium = GradientIndex("both", constant(1.5), (-0.004, 1e-6), (0.03, 0.002))
    optics = system(medium, 12.0, (Conic(40.0), Conic(-60.0)))
    optics = system(medium, 12.0, (Conic(40.0), Conic(-60.0)), gap=paraxial(optics).back_focus)
    traced = trace(optics, bundle([1e-3]))
    assert paraxial(optics).focal_length == pytest.approx(-1e-3 / traced.u[0, 0], rel=1e-7)
    np.testing.assert_allclose(traced.x, 0.0, rtol=0, atol=1e-9)


def test_higher_radial_terms_against_an_adaptive_integrator(trace):
    rays = bundle([2.0], [-1.0], slopes=(0.15, 0.1))
    traced = trace(system(selfoc(1.5, 0.1, (0.7, -0.4), 0.05), 30.0), rays)

    def n(x, y):
        r2 = 0.01 * (x**2 + y**2)
        return 1.5 * np.sqrt(1 - r2 + 0.7 * r2**2 - 0.4 * r2**3)

    def rate(s, state):
        """d/ds (n dr/ds) = grad n as it stands, with the gradient by central differences."""
        x, y, _, *vector = state
        h = 1e-5
        gradient = [(n(x + h, y) - n(x - h, y)) / (2 * h), (n(x, y + h) - n(x, y - h)) / (2 * h), 0.0]
        return [*(np.array(vector) / n(x, y)), *gradient]

    def reached(s, state):
        return state[2] - 30.0

    reached.terminal = True
    across = rays.direction[:2, 0]
    start = [2.0, -1.0, 0.0, *across, np.sqrt(n(2.0, -1.0) ** 2 - across @ across)]
    ended = solve_ivp(rate, (0, 60), start, method="DOP853", rtol=1e-11, atol=1e-12, events=reached)
    truth = ended.y_events[0][0]
    np.testing.assert_allclose([traced.x[0, 0], traced.y[0, 0]], truth[:2], rtol=0, atol=1e-8)
    np.testing.assert_allclose([traced.u[0, 0], traced.v[0, 0]], truth[3:5], rtol=0, atol=1e-8)


def uniform(element):
    """The same element before a medium with a gradient of nothing, in steps of 0.7 mm."""
    return replace(element, gradient=Gradient((0.0,), (), 0.7))


def test_a_uniform_gradient_is_a_sequence_of_homogeneous_media(trace_all):
    """With a mirror, a stop and an aspheric face inside; moved and turned."""
    rays = bundle([0.0, 4.0, -6.0], [1.0, -3.0, 2.0], slopes=(0.1, -0.05), z=-5.0)
    elements = (
        Element(curvature=1 / 30.0, conic=-0.5, action="refract", index=1.7),
        Element(),
        Element(curvature=1 / 80.0, even=(1e-4,), action="reflect"),
        Element(curvature=-1 / 50.0, action="refract", index=1.33),
        Element(),
    )
    poses = np.zeros((2, 5, 12))
    poses[:, :, [0, 4, 8]] = 1.0
    poses[:, :, 11] = [0.0, -3.0, -9.0, 12.0, 4.0]
    poses[1, :4, :9] = cardan(np.array([[0.02, -0.01, 0.3]] * 4)).reshape(4, 9)
    poses[1, 1, 9] = 0.4
    bent = (uniform(elements[0]), *elements[1:])
    truth, found = (trace_all(Sequence(which), rays, Moving(poses)) for which in (elements, bent))
    assert (truth.status == OK).all()
    for name in ("x", "y", "path", "u", "v"):
        np.testing.assert_allclose(getattr(found, name), getattr(truth, name), rtol=1e-13, atol=1e-12)


def test_a_rod_moves_with_the_surface_that_begins_it(trace):
    """Shifted and turned by its first surface as a rigid body: the light moved back sees the rod at rest."""
    rod = system(selfoc(N0, G), 25.0)
    rays = bundle([0.5, -1.0], [1.5, 0.2], slopes=(0.02, 0.01), z=-3.0)
    turn, shift = cardan(np.array([0.01, -0.02, 0.03])), np.array([0.2, -0.1, 0.3])
    moved = tuple(
        Surface(s.name, s.shape, turn @ s.position + shift, turn @ s.rotation, s.action, s.medium)
        for s in rod.surfaces
    )
    back = Rays(turn.T @ (rays.position - shift[:, None]), turn.T @ rays.direction, rays.path)
    found = trace(replace(rod, surfaces=moved), rays)
    truth = trace(rod, back)
    for name in ("x", "y", "u", "v", "path"):
        np.testing.assert_allclose(getattr(found, name), getattr(truth, name), rtol=1e-12, atol=1e-12)


def test_a_face_that_deforms_ends_the_medium(trace, trace_all):
    """A rear face that deforms by a piston is a longer rod."""
    rod = system(selfoc(N0, G), 20.0, gap=5.0)
    rear = replace(rod.surfaces[1], deformation=ZernikeDeformation(1, 5.0))
    bent = replace(rod, surfaces=(rod.surfaces[0], rear, rod.surfaces[2]))
    states = rest_states(bent, 2)
    states.deformations[1][:, 0] = [0.0, 0.7]
    rays = bundle([1.0, -2.0], slopes=(0.02, 0.01))
    found = trace_all(pack(bent, WAVE), rays, moving(bent, states))
    for instant, longer in enumerate((rod, system(selfoc(N0, G), 20.7, gap=4.3))):
        truth = trace(longer, rays)
        np.testing.assert_allclose(found.x[instant], truth.x[0], rtol=0, atol=1e-11)
        np.testing.assert_allclose(found.path[instant], truth.path[0], rtol=0, atol=1e-11)


def test_a_ray_does_not_depend_on_its_neighbors(trace):
    rod = system(selfoc(N0, G), 50.0, (PLANE, Conic(80.0)))
    rays = bundle([0.5, 3.0, -2.0], slopes=(0.1, 0.0))
    whole = trace(rod, rays)
    for one in range(3):
        alone = Rays(rays.position[:, [one]], rays.direction[:, [one]], rays.path[[one]])
        single = trace(rod, alone)
        assert (single.x[0, 0], single.path[0, 0]) == (whole.x[0, one], whole.path[0, one])


def test_lost_rays_are_data(trace):
    rays = bundle([0.0, 50.0, np.nan])  # n² < 0 beyond r = 20
    traced = trace(system(selfoc(N0, G), 5.0), rays)
    assert traced.status.tolist() == [[OK, MISS, MISS]]
    assert traced.surface[0, 1] == 1
    # The rear surface stands before the front one: rays never get there, and do not go on for ever.
    assert trace(system(selfoc(N0, G), -5.0), rays).status.tolist() == [[MISS] * 3]


def test_total_reflection_at_the_rear_face(trace):
    """A ray that starts 15 mm high crosses the axis where outside it would need a sine of n0 g x = 1.2."""
    crossing = np.sqrt(1 - (G * 15.0) ** 2) * np.pi / 2 / G
    traced = trace(system(selfoc(N0, G), crossing), bundle([1.0, 15.0]))
    assert traced.status.tolist() == [[OK, TOTAL_REFLECTION]]
    assert traced.surface[0, 1] == 1


def test_the_table_of_a_system_says_where_the_index_varies():
    assert "The index varies behind front" in info(system(selfoc(N0, G), 20.0, gap=5.0))
    assert "varies" not in info(system(glass("N-BK7"), 20.0, (Conic(50.0), PLANE), 60.0))


@pytest.mark.parametrize(
    ("medium", "message"),
    [
        (GradientIndex("rod", AIR), "no gradient"),
        (GradientIndex("rod", AIR, (np.nan,)), "not finite"),
        (GradientIndex("rod", AIR, (-1e-3,), (), 0.0), "must be positive"),
        (GradientIndex("rod", AIR, (-1e-3,), (), np.nan), "must be positive"),
        (GradientIndex("rod", AIR, (), (-1.0,)), "not real"),
    ],
)
def test_a_medium_without_a_trace_is_refused(medium, message):
    with pytest.raises(UserError, match=message):
        paraxial(system(medium, 5.0))


def test_a_step_far_shorter_than_needed_is_refused():
    with pytest.raises(UserError, match="take a longer one"):
        pack(system(selfoc(N0, G, step=1e-7), 5.0), WAVE)


def test_an_image_inside_a_gradient_is_refused():
    rod = system(selfoc(N0, G), 5.0)
    inside = replace(rod, surfaces=(rod.surfaces[0], rod.surfaces[2]))
    with pytest.raises(UserError, match="ends it"):
        pack(inside, WAVE)


@pytest.mark.parametrize("strength", [5e3, 1e300])
def test_a_medium_that_throws_all_light_away_is_refused(strength):
    steep = system(GradientIndex("x", constant(1.6), (strength,)), 20.0)
    with pytest.raises(UserError, match=r"x rises so steeply off the axis .* 20 mm of it throw light exp\("):
        info(steep)


@pytest.mark.parametrize("medium", [luneburg(1e-300), selfoc(1.6, 1e200), selfoc(1e200, 0.05)])
def test_numbers_beyond_a_float_are_refused(medium):
    with pytest.raises(UserError, match="not finite"):
        info(system(medium, 20.0))


def test_a_medium_that_takes_too_many_steps_is_refused():
    medium = GradientIndex("x", constant(1.6), (-1e6,))
    with pytest.raises(UserError, match=r"steps of 2e-05 mm through 20 mm of a medium .* 50000 at most"):
        pack(system(medium, 20.0), WAVE)
