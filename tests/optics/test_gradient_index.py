import numpy as np
import pytest
from scipy.integrate import solve_ivp

from wavequake.errors import UserError
from wavequake.kernels.sequence import MISS, OK, TOTAL_REFLECTION, Element, Moving, Rays, Sequence
from wavequake.kernels.sequential_numpy import trace_sequence_numpy
from wavequake.optics.gradient_index import (
    GradientMedium,
    axial,
    luneburg,
    radial,
    trace_gradient,
    trace_gradient_lens,
)
from wavequake.optics.shapes import Conic

PLANE = Conic()
N0, G = 1.6, 0.05  # a quarter of its pitch is 31.4 mm


def bundle(x, y=0.0, z=0.0, slopes=(0.0, 0.0)):
    x = np.atleast_1d(np.asarray(x, dtype=float))
    position = np.stack([x, np.broadcast_to(y, x.shape), np.broadcast_to(z, x.shape)]).astype(float)
    direction = np.stack(
        [np.broadcast_to(slopes[0], x.shape), np.broadcast_to(slopes[1], x.shape), np.ones_like(x)]
    )
    return Rays(position, direction / np.linalg.norm(direction, axis=0), np.zeros_like(x))


def selfoc(rays, z):
    """The closed form in n² = n0² (1 - g² r²): x = A sin(w t + phase) in both planes, z = T_z t."""
    n2 = N0**2 * (1 - G**2 * np.sum(rays.position[:2] ** 2, axis=0))
    vector = np.sqrt(n2) * rays.direction
    w = N0 * G
    t = (z - rays.position[2]) / vector[2]
    cos, sin = np.cos(w * t), np.sin(w * t)
    place = rays.position[:2] * cos + vector[:2] / w * sin
    speed = vector[:2] * cos - w * rays.position[:2] * sin
    # The integral of n² = n0² - w² r² along the way, with x = x0 cos + (v/w) sin.
    x0, v = rays.position[:2], vector[:2] / w
    squares = (x0**2 + v**2) / 2 * t + (x0**2 - v**2) * np.sin(2 * w * t) / (4 * w) + x0 * v * sin**2 / w
    path = N0**2 * t - w**2 * np.sum(squares, axis=0)
    direction = np.stack([*speed, vector[2]])
    return place, direction / np.linalg.norm(direction, axis=0), path


def test_selfoc_rays_are_sinusoids():
    rays = bundle([0.0, 1.0, -2.0, 3.0], [0.5, 0.0, 1.0, -2.0], slopes=(0.1, -0.05))
    traced = trace_gradient(radial(N0, G), rays, PLANE, 100.0, 0.1)
    place, direction, path = selfoc(rays, 100.0)
    np.testing.assert_allclose(traced.position[:2], place, atol=1e-10)
    np.testing.assert_allclose(traced.position[2], 100.0, atol=1e-11)
    np.testing.assert_allclose(traced.direction, direction, atol=1e-11)
    np.testing.assert_allclose(traced.path, path, rtol=1e-12)
    assert (traced.status == OK).all()


def test_a_quarter_pitch_focuses_a_paraxial_bundle():
    pitch = 2 * np.pi / G
    traced = trace_gradient(radial(N0, G), bundle([1e-3, 2e-3, 4e-3]), PLANE, pitch / 4, 0.2)
    np.testing.assert_allclose(traced.position[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(traced.direction[0], -G * np.array([1e-3, 2e-3, 4e-3]), rtol=1e-6)
    np.testing.assert_allclose(traced.path - traced.path[0], 0.0, atol=1e-11)  # equal paths to the focus


@pytest.mark.parametrize("what", ["position", "direction", "path"])
def test_the_order_of_convergence_is_four(what):
    rays = bundle([2.0, -3.0], [1.0, 0.5], slopes=(0.1, 0.2))
    place, direction, path = selfoc(rays, 60.0)
    truth = {"position": np.stack([*place, [60.0] * 2]), "direction": direction, "path": path}[what]
    errors = [
        np.abs(getattr(trace_gradient(radial(N0, G), rays, PLANE, 60.0, step), what) - truth).max()
        for step in (4.0, 2.0, 1.0, 0.5)
    ]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders[-1] == pytest.approx(4.0, abs=0.25)
    assert orders.min() > 3.5


def test_a_luneburg_lens_focuses_parallel_rays_on_its_far_side():
    """Every ray ends at the antipode; the path from the plane before the lens is R (1 + pi / 2) for all."""
    R = 10.0
    x, y = np.array([0.0, 1.0, -4.0, 7.0, 9.0]), np.array([0.0, 2.0, 3.0, -4.0, 1.0])
    rays = bundle(x, y, -np.sqrt(R**2 - x**2 - y**2))
    traced = trace_gradient(luneburg(R), rays, Conic(-R), R, 0.02)
    np.testing.assert_allclose(traced.position, np.array([0, 0, R])[:, None] * np.ones(5), atol=1e-9)
    from_plane = traced.path + rays.position[2] + R
    np.testing.assert_allclose(from_plane, R * (1 + np.pi / 2), rtol=1e-12)
    # A ray at the height h arrives under the angle asin(h / R).
    np.testing.assert_allclose(traced.direction[:2], -np.stack([x, y]) / R, atol=1e-10)


def test_stated_accuracy_per_number_of_steps():
    R = 10.0
    x = np.array([2.0, 5.0, 8.0])
    rays = bundle(x, 0.0, -np.sqrt(R**2 - x**2))
    for steps, bound in ((10, 1e-5), (100, 1e-9), (1000, 1e-13)):
        traced = trace_gradient(luneburg(R), rays, Conic(-R), R, 2 * R * np.pi / 4 / steps)
        miss = np.linalg.norm(traced.position - np.array([[0], [0], [R]]), axis=0).max()
        path = np.abs(traced.path + rays.position[2] + R - R * (1 + np.pi / 2)).max()
        assert max(miss, path) / (2 * R) < bound
        assert 0.5 * steps < traced.steps < 2 * steps


def test_a_fish_eye_turns_rays_on_circles():
    """n = n0 / (1 + r²/a²) images each point of the sphere r = a to its antipode (Maxwell)."""
    a, n0 = 5.0, 2.0

    def squared(p):
        return (n0 / (1 + np.sum(p**2, axis=0) / a**2)) ** 2

    def half_gradient(p):
        return -2 * n0**2 / a**2 * p / (1 + np.sum(p**2, axis=0) / a**2) ** 3

    rays = bundle(np.zeros(4), 0.0, -a, slopes=(np.array([0.0, 0.3, -0.8, 1.5]), 0.2))
    traced = trace_gradient(GradientMedium("fish eye", squared, half_gradient), rays, Conic(-a), a, 0.01)
    np.testing.assert_allclose(traced.position, np.array([0, 0, a])[:, None] * np.ones(4), atol=1e-8)
    np.testing.assert_allclose(traced.path, n0 * a * np.pi / 2, rtol=1e-10)


def test_an_axial_gradient_keeps_the_transverse_ray_vector():
    medium = axial((1.5, 0.02, -0.001))
    rays = bundle([1.0, -1.0], slopes=(0.3, -0.2))
    traced = trace_gradient(medium, rays, PLANE, 10.0, 0.05)
    index = 1.5 + 0.2 - 0.1
    np.testing.assert_allclose(index * traced.direction[:2], 1.5 * rays.direction[:2], rtol=1e-12)
    # Snell's law layer by layer: dx/dz = p / sqrt(n² - p² - q²).
    p, q = 1.5 * rays.direction[:2, 0]
    z, weight = np.polynomial.legendre.leggauss(40)
    z, weight = 5 * (z + 1), 5 * weight
    n = 1.5 + 0.02 * z - 0.001 * z**2
    np.testing.assert_allclose(
        traced.position[0] - rays.position[0], np.sum(weight * p / np.sqrt(n**2 - p**2 - q**2)), rtol=1e-10
    )
    np.testing.assert_allclose(traced.path, np.sum(weight * n**2 / np.sqrt(n**2 - p**2 - q**2)), rtol=1e-10)


def test_higher_radial_terms_against_an_adaptive_integrator():
    medium = radial(1.5, 0.1, (0.7, -0.4))
    rays = bundle([2.0], [-1.0], slopes=(0.15, 0.1))
    traced = trace_gradient(medium, rays, PLANE, 30.0, 0.05)

    def n(x, y):
        r2 = 0.01 * (x**2 + y**2)
        return 1.5 * np.sqrt(1 - r2 + 0.7 * r2**2 - 0.4 * r2**3)

    def rate(s, state):
        """d/ds (n dr/ds) = grad n as it stands, with the gradient by central differences."""
        x, y, _, *vector = state
        h = 1e-5
        gradient = np.array(
            [(n(x + h, y) - n(x - h, y)) / (2 * h), (n(x, y + h) - n(x, y - h)) / (2 * h), 0.0]
        )
        return [*(np.array(vector) / n(x, y)), *gradient]

    def reached(s, state):
        return state[2] - 30.0

    reached.terminal = True
    start = [2.0, -1.0, 0.0, *(n(2.0, -1.0) * rays.direction[:, 0])]
    truth = solve_ivp(rate, (0, 60), start, method="DOP853", rtol=1e-11, atol=1e-12, events=reached).y_events[
        0
    ][0]
    np.testing.assert_allclose(traced.position[:, 0], truth[:3], atol=1e-8)
    np.testing.assert_allclose(traced.direction[:, 0], truth[3:] / n(truth[0], truth[1]), atol=1e-8)


def test_a_uniform_medium_gives_straight_lines():
    rays = bundle([1.0, -2.0], [0.5, 3.0], slopes=(0.2, -0.1))
    traced = trace_gradient(radial(1.5, 0.0), rays, Conic(-40.0, 0.5), 12.0, 0.7)
    way = (traced.position[2] - rays.position[2]) / rays.direction[2]
    np.testing.assert_allclose(traced.position, rays.position + way * rays.direction, atol=1e-13)
    np.testing.assert_allclose(traced.path, 1.5 * way, rtol=1e-13)
    np.testing.assert_allclose(traced.direction, rays.direction, atol=1e-15)


@pytest.mark.parametrize("end", [PLANE, Conic(30.0, -0.4), Conic(-25.0, -1.8)])
def test_rays_end_on_the_surface(end):
    rays = bundle([0.0, 1.0, -2.0, 3.5], [1.0, 0.0, 2.0, -1.0], slopes=(0.05, -0.1))
    x, y, z = trace_gradient(radial(N0, G), rays, end, 40.0, 0.9).position
    c = 1 / end.radius
    implicit = c * (x**2 + y**2 + (1 + end.conic) * (z - 40) ** 2) - 2 * (z - 40)  # Störkle 2018, Eq. 3.16
    np.testing.assert_allclose(implicit, 0.0, atol=1e-11)


def test_rays_do_not_depend_on_their_neighbors():
    rays = bundle([0.5, 3.0, -2.0], slopes=(0.1, 0.0))
    whole = trace_gradient(radial(N0, G), rays, Conic(80.0), 50.0, 0.5)
    for one in range(3):
        alone = Rays(rays.position[:, [one]], rays.direction[:, [one]], rays.path[[one]])
        single = trace_gradient(radial(N0, G), alone, Conic(80.0), 50.0, 0.5)
        np.testing.assert_array_equal(single.position[:, 0], whole.position[:, one])
        np.testing.assert_array_equal(single.path[0], whole.path[one])


def test_lost_rays_are_data():
    rays = bundle([0.0, 50.0, np.nan])  # n² < 0 beyond r = 20
    traced = trace_gradient(radial(N0, G), rays, PLANE, 5.0, 0.5)
    assert traced.status.tolist() == [OK, MISS, MISS]
    assert np.isnan(traced.position[:, 1:]).all()
    away = trace_gradient(radial(N0, G), rays, PLANE, -5.0, 0.5, max_steps=20)
    assert away.status.tolist() == [MISS] * 3
    assert away.steps == 20


@pytest.mark.parametrize("step", [0.0, -1.0, np.nan, np.inf])
def test_a_step_is_a_positive_length(step):
    with pytest.raises(UserError, match="positive step"):
        trace_gradient(radial(N0, G), bundle([0.0]), PLANE, 1.0, step)


def test_a_lens_of_a_uniform_medium_is_a_sequence_of_two_surfaces():
    rays = bundle([0.0, 4.0, -6.0], [1.0, -3.0, 2.0], -5.0, slopes=(0.1, -0.05))
    lens = trace_gradient_lens(
        radial(1.7, 0.0), rays, (Conic(30.0, -0.5), Conic(-50.0)), 8.0, 0.5, (1.0, 1.33)
    )
    elements = (
        Element(curvature=1 / 30.0, conic=-0.5, action="refract", index=1.7),
        Element(curvature=-1 / 50.0, action="refract", index=1.33),
    )
    poses = np.array([[[1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0], [1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, -8.0]]])
    truth = trace_sequence_numpy(Sequence(elements), rays, Moving(poses))
    np.testing.assert_allclose(lens.position[0], truth.x[0], atol=1e-12)
    np.testing.assert_allclose(lens.position[1], truth.y[0], atol=1e-12)
    np.testing.assert_allclose(lens.direction[:2], np.stack([truth.u[0], truth.v[0]]), atol=1e-13)
    np.testing.assert_allclose(lens.path, truth.path[0], rtol=1e-13)


def test_a_rod_lens_has_its_paraxial_focus():
    """A plane rod of length L focuses at cot(g L) / (n0 g) behind its rear face."""
    length = 20.0
    height = 1e-4
    lens = trace_gradient_lens(radial(N0, G), bundle([height], 0.0, -1.0), (PLANE, PLANE), length, 0.1)
    distance = -lens.position[0] / lens.direction[0] * lens.direction[2]
    np.testing.assert_allclose(distance, 1 / (N0 * G * np.tan(G * length)), rtol=1e-8)


def test_total_reflection_at_the_rear_face():
    rays = bundle([0.0, 0.0], slopes=(np.array([0.0, 1.0]), 0.0))
    lens = trace_gradient_lens(radial(1.5, 0.0), rays, (PLANE, PLANE), 2.0, 0.1, (1.5, 1.0))
    assert lens.status.tolist() == [OK, TOTAL_REFLECTION]
    assert np.isnan(lens.path[1])
