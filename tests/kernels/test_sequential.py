"""The sequential trace against closed forms of geometrical optics, on every device."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.devices import NUMPY, Device, list_devices
from wavequake.kernels.sequence import (
    DIVERGED,
    MISS,
    OK,
    TOTAL_REFLECTION,
    VIGNETTED,
    Element,
    Grid,
    Moving,
    Polynomial,
    Rays,
    Region,
    Sequence,
)
from wavequake.kernels.sequential import trace_sequence
from wavequake.kernels.sequential_numpy import sag_and_slopes

OPENCL = [device for device in list_devices() if device.kind != "numpy"]
# Processors also run the variant for GPUs: one ray per work-item, copied buffers.
OPENCL += [Device(device.name, "gpu", device.platform, 1) for device in OPENCL if device.kind == "cpu"]
ALL = [NUMPY, *OPENCL]
NAMES = {"argvalues": ALL, "ids": lambda device: f"{device.kind}-{device.vector_width}"}
IMAGE = Element()


def shifts(*steps):
    """Poses of elements of which each stands `step` (a z, or x, y, z) from the one before; one instant."""
    packed = [
        [*np.eye(3).ravel(), *(-np.broadcast_to(step, 3) * ([0, 0, 1] if np.ndim(step) == 0 else 1))]
        for step in steps
    ]
    return np.array([packed])


def turned(angle, shift=(0.0, 0.0, 0.0)):
    """Pose of an element turned by `angle` about the y axis and then shifted in the frame before."""
    turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    return np.array([*turn.ravel(), *(-turn @ np.asarray(shift))])


def collimated(radius=90.0, z=-20.0, count=37, angle=0.0):
    """Rays along z, or turned by `angle` towards x; their path counts from z."""
    random = np.random.default_rng(2)
    r, phi = radius * np.sqrt(random.uniform(0, 1, count)), random.uniform(0, 2 * np.pi, count)
    direction = np.tile(np.array([[np.sin(angle)], [0.0], [np.cos(angle)]]), (1, count))
    return Rays(np.stack([r * np.cos(phi), r * np.sin(phi), np.full(count, z)]), direction, np.zeros(count))


def from_point(point, half_angle, sense=1.0, count=37):
    """Rays from a point with directions within `half_angle` of the z axis."""
    random = np.random.default_rng(3)
    sine, phi = np.sin(half_angle) * random.uniform(0, 1, count), random.uniform(0, 2 * np.pi, count)
    direction = np.stack([sine * np.cos(phi), sine * np.sin(phi), sense * np.sqrt(1.0 - sine * sine)])
    return Rays(np.tile(np.reshape(point, (3, 1)), (1, count)).astype(float), direction, np.zeros(count))


def paraboloids():
    """The same paraboloid z = -(x^2 + y^2) / (4 f), f = 1000 mm, made in every way."""
    power = -1.0 / 4000.0
    square = np.zeros(6)
    square[[3, 5]] = power * 100.0**2
    chebyshev = np.zeros(6)
    chebyshev[[0, 3, 5]] = power * 100.0**2 * np.array([1.0, 0.5, 0.5])
    place = -120.0 + 8.0 * np.arange(31)
    # The B-spline of x^2 has the coefficients x_k^2 - dx^2 / 3.
    nodes = power * (place[:, None] ** 2 + place**2 - 2.0 * 8.0**2 / 3.0)
    mirror = Element(action="reflect")
    return {
        "conic": (Element(-1.0 / 2000.0, -1.0, "reflect"), None, None),
        "even": (replace(mirror, even=(power,)), None, None),
        "polynomial": (replace(mirror, polynomial=Polynomial(2, 100.0, square)), None, None),
        "chebyshev": (
            replace(mirror, polynomial=Polynomial(2, 100.0, chebyshev, "chebyshev")), None, None
        ),
        "grid": (replace(mirror, grid=Grid(-120.0, -120.0, 8.0, 8.0, nodes)), None, None),
        "moving": (replace(mirror, deformation_degree=2, deformation_radius=100.0), square[None], None),
        "moving chebyshev": (
            replace(mirror, deformation_degree=2, deformation_radius=100.0, deformation_basis="chebyshev"),
            chebyshev[None],
            None,
        ),
        "moving grid": (
            replace(mirror, deformation_grid=Grid(-120.0, -120.0, 8.0, 8.0, np.zeros((4, 4)))),
            None,
            nodes[None],
        ),
        "all together": (
            Element(
                -1.0 / 8000.0, -1.0, "reflect", even=(power / 4,),
                polynomial=Polynomial(2, 100.0, square / 8),
                grid=Grid(-120.0, -120.0, 8.0, 8.0, nodes / 8),
                deformation_degree=2, deformation_radius=100.0, deformation_basis="chebyshev",
                deformation_grid=Grid(-120.0, -120.0, 8.0, 8.0, np.zeros((4, 4))),
            ),
            chebyshev[None] / 8,
            nodes[None] / 8,
        ),
    }  # fmt: skip


@pytest.mark.parametrize("device", **NAMES)
@pytest.mark.parametrize("kind", sorted(paraboloids()))
def test_a_paraboloid_focuses_in_one_point_with_one_path_however_it_is_made(kind, device):
    mirror, deformation, grid = paraboloids()[kind]
    moving = Moving(shifts(0.0, -1000.0), (deformation, None), (grid, None))
    traced = trace_sequence(Sequence((mirror, IMAGE)), collimated(), moving, device)
    assert (traced.status == OK).all()
    assert (traced.surface == -1).all()
    assert np.abs(traced.x).max() < 1e-11
    assert np.abs(traced.y).max() < 1e-11
    assert np.abs(traced.path - 1020.0).max() < 2e-12
    assert (traced.w_sign == -1).all()


@pytest.mark.parametrize("device", **NAMES)
def test_the_sphere_is_met_before_or_behind_the_image(device):
    mirror = Element(-1.0 / 2000.0, -1.0, "reflect")
    for radius in (300.0, -300.0):
        moving = Moving(shifts(0.0, -1000.0), spheres=np.array([[0.0, 0.0, 0.0, radius]]))
        traced = trace_sequence(Sequence((mirror, IMAGE)), collimated(), moving, device)
        np.testing.assert_allclose(traced.path, 1020.0 - radius, atol=2e-12)
    moving = replace(moving, spheres=np.array([[0.0, 500.0, 0.0, 100.0]]))
    traced = trace_sequence(Sequence((mirror, IMAGE)), collimated(), moving, device)
    assert (traced.status == MISS).all()
    assert (traced.surface == 2).all()
    # A sphere that is not about the image: the distance from the image is that along the ray.
    moving = replace(moving, spheres=np.array([[1.0, -2.0, 3.0, 50.0]]))
    traced = trace_sequence(Sequence((mirror, IMAGE)), collimated(), moving, device)
    d = np.stack([traced.u, traced.v, -np.sqrt(1.0 - traced.u**2 - traced.v**2)])
    point = (traced.path - 1020.0) * d - np.reshape([1.0, -2.0, 3.0], (3, 1, 1))
    np.testing.assert_allclose(np.linalg.norm(point, axis=0), 50.0, atol=1e-11)
    assert (traced.path < 1020.0).all()


@pytest.mark.parametrize("device", **NAMES)
def test_an_ellipsoid_brings_light_from_one_focus_to_the_other(device):
    a, e = 500.0, 0.4
    mirror = Element(-1.0 / (a * (1 - e * e)), -e * e, "reflect")
    near, far = a * (1 - e), a * (1 + e)
    rays = from_point([0.0, 0.0, -near], 1.2)
    traced = trace_sequence(Sequence((mirror, IMAGE)), rays, Moving(shifts(0.0, -far)), device)
    assert np.hypot(traced.x, traced.y).max() < 2e-12 * a
    np.testing.assert_allclose(traced.path, 2 * a, atol=2e-12)


@pytest.mark.parametrize("device", **NAMES)
def test_a_hyperboloid_reflects_light_that_aims_at_its_hidden_focus_to_the_other(device):
    # Convex towards -z, light from +z to -z, as at the secondary of a Cassegrain telescope: foci at
    # -p behind the vertex and +q before it.
    p, q = 300.0, 1700.0
    a, e = (q - p) / 2, (q + p) / (q - p)
    mirror = Element(-1.0 / (a * (e * e - 1)), -e * e, "reflect")
    rays = from_point([0.0, 0.0, -p], 0.3, sense=1.0)
    incoming = Rays(rays.position + 1000.0 * rays.direction, -rays.direction, np.zeros(37))
    traced = trace_sequence(Sequence((mirror, IMAGE)), incoming, Moving(shifts(0.0, q)), device)
    assert np.hypot(traced.x, traced.y).max() < 1e-11
    np.testing.assert_allclose(traced.path, 1000.0 - p + q, atol=3e-12)
    assert (traced.w_sign == 1).all()


@pytest.mark.parametrize("device", **NAMES)
@pytest.mark.parametrize(("before", "after"), [(1.0, 1.5), (1.7, 1.0)])
def test_a_sphere_images_its_aplanatic_points_perfectly(before, after, device):
    radius = 50.0 if before < after else -50.0
    from_, to = radius * (1 + after / before), radius * (1 + before / after)
    rays = from_point([0.0, 0.0, from_], 0.5)
    # Light converging to (or diverging from) the first point, from a sphere of 400 mm about it.
    start = Rays(rays.position - 400.0 * rays.direction, rays.direction, np.zeros(37))
    glass = Element(1.0 / radius, 0.0, "refract", after)
    traced = trace_sequence(Sequence((glass, IMAGE), before), start, Moving(shifts(0.0, to)), device)
    assert (traced.status == OK).all()
    assert np.hypot(traced.x, traced.y).max() < 1e-11
    np.testing.assert_allclose(traced.path, before * (400.0 - from_) + after * to, atol=1e-11)


@pytest.mark.parametrize("device", **NAMES)
def test_an_ellipsoid_of_glass_focuses_collimated_light(device):
    n, radius = 1.6, 60.0
    glass = Element(1.0 / radius, -1.0 / n**2, "refract", n)
    focus = n * radius / (n - 1.0)
    rays = collimated(radius=40.0)
    traced = trace_sequence(Sequence((glass, IMAGE)), rays, Moving(shifts(0.0, focus)), device)
    assert np.hypot(traced.x, traced.y).max() < 1e-11
    np.testing.assert_allclose(traced.path, 20.0 + n * focus, atol=3e-12)


@pytest.mark.parametrize("device", **NAMES)
def test_a_tilted_plate_shifts_a_ray_and_keeps_its_direction(device):
    n, thickness, angle = 1.52, 12.0, 0.7
    plate = (Element(action="refract", index=n), Element(action="refract", index=1.0), IMAGE)
    # The plate stands upright; the light is tilted, and so is the image plane, 100 mm on along the light.
    poses = np.stack([shifts(0.0)[0, 0], shifts(thickness)[0, 0], turned(angle, (0.0, 0.0, 100.0))])
    rays = Rays(np.zeros((3, 1)), np.array([[np.sin(angle)], [0.0], [np.cos(angle)]]), np.zeros(1))
    traced = trace_sequence(Sequence(plate), rays, Moving(poses[None]), device)
    inside = np.sqrt(n * n - np.sin(angle) ** 2)
    shift = thickness * np.sin(angle) * (1.0 - np.cos(angle) / inside)
    # Without the plate the ray would meet the image plane at (thickness tan - ...): measure from the axis.
    undisturbed = (np.array([0.0, 0.0, 0.0]) - np.array([0.0, 0.0, thickness + 100.0])) @ [
        np.cos(angle), 0.0, -np.sin(angle)
    ]  # fmt: skip
    assert traced.x[0, 0] == pytest.approx(undisturbed - shift, abs=1e-12)
    assert abs(traced.u[0, 0]) < 1e-15
    assert traced.w_sign[0, 0] == 1
    free = (thickness + 100.0) * np.cos(angle)
    # The optical path of a plate exceeds that of air by t (sqrt(n^2 - sin^2) - cos).
    assert traced.path[0, 0] == pytest.approx(free + thickness * (inside - np.cos(angle)), abs=1e-12)


@pytest.mark.parametrize("device", **NAMES)
def test_a_prism_deviates_by_its_least_angle(device):
    n, apex = 1.7, np.pi / 3
    half = 0.5 * apex
    incidence = np.arcsin(n * np.sin(half))
    # First face turned by +half about y, second by -half; light arrives `incidence` off the first normal.
    faces = (Element(action="refract", index=n), Element(action="refract", index=1.0), IMAGE)
    poses = np.stack([turned(half), turned(-apex, (0.0, 0.0, 5.0)), turned(half)])
    arrival = half - incidence
    rays = Rays(np.zeros((3, 1)), np.array([[np.sin(arrival)], [0.0], [np.cos(arrival)]]), np.zeros(1))
    traced = trace_sequence(Sequence(faces), rays, Moving(poses[None]), device)
    # The frame of the image is again that of the rays.
    deviation = np.arcsin(traced.u[0, 0]) - arrival
    assert abs(deviation) == pytest.approx(2.0 * incidence - apex, abs=1e-14)


@pytest.mark.parametrize("device", **NAMES)
def test_beyond_the_critical_angle_a_ray_is_lost_by_total_reflection(device):
    n = 1.5
    angles = np.arcsin(1.0 / n) + np.array([-1e-6, 1e-6])
    rays = Rays(np.zeros((3, 2)), np.stack([np.sin(angles), np.zeros(2), np.cos(angles)]), np.zeros(2))
    faces = (IMAGE, Element(action="refract", index=1.0), IMAGE)
    traced = trace_sequence(Sequence(faces, n), rays, Moving(shifts(1.0, 1.0, 1.0)), device)
    np.testing.assert_array_equal(traced.status, [[OK, TOTAL_REFLECTION]])
    np.testing.assert_array_equal(traced.surface, [[-1, 1]])
    assert np.isnan([a[0, 1] for a in (traced.path, traced.x, traced.y, traced.u, traced.v)]).all()
    assert traced.w_sign[0, 1] == 0
    assert traced.u[0, 0] == pytest.approx(n * np.sin(angles[0]), abs=1e-15)


@pytest.mark.parametrize("device", **NAMES)
def test_apertures_are_openings_less_what_blocks(device):
    square = Region("polygon", (1.0, 0.0, 6.0, -1.0, 0.0, 6.0, 0.0, 1.0, 6.0, 0.0, -1.0, 6.0))
    strip = Region("polygon", (0.0, 1.0, 0.5, 0.0, -1.0, 0.5, -1.0, 0.0, 0.0), blocks=True)
    hole = Region("circle", (1.0, 0.0, 2.0), blocks=True)
    stop = Element(regions=(square, Region("circle", (0.0, 0.0, 8.0)), hole, strip))
    points = {
        (0.0, 5.9): OK, (0.0, 6.1): VIGNETTED, (5.9, 5.9): VIGNETTED, (5.0, 5.0): OK, (2.9, 0.6): VIGNETTED,
        (3.1, 0.6): OK, (-0.9, 0.0): VIGNETTED, (-1.1, 0.0): OK, (4.0, 0.4): VIGNETTED, (4.0, -0.6): OK,
    }  # fmt: skip
    places = np.array([(*point, -1.0) for point in points]).T
    rays = Rays(places, np.tile([[0.0], [0.0], [1.0]], (1, len(points))), np.zeros(len(points)))
    poses = np.tile(shifts(0.0, 1.0), (3, 1, 1))
    sequence = Sequence((stop, IMAGE))
    traced = trace_sequence(sequence, rays, Moving(poses), device)
    np.testing.assert_array_equal(traced.status, np.tile(list(points.values()), (3, 1)))
    lost = list(points.values()).count(VIGNETTED)
    np.testing.assert_array_equal(traced.vignetted, [3 * lost, 0])
    np.testing.assert_array_equal(traced.surface == 0, traced.status == VIGNETTED)
    through = trace_sequence(sequence, rays, Moving(poses), device, ignore_apertures=True)
    assert (through.status == OK).all()
    np.testing.assert_array_equal(through.vignetted, 0)


@pytest.mark.parametrize("device", **NAMES)
def test_lost_rays_say_why_and_where(device):
    sphere = Element(1.0 / 50.0, 0.0, "reflect")
    # Light at height 60 passes the sphere; a plane that the light runs along is never met.
    traced = trace_sequence(Sequence((sphere, IMAGE)), collimated(90.0), Moving(shifts(0.0, -9.0)), device)
    height = np.hypot(*collimated(90.0).position[:2])
    np.testing.assert_array_equal(traced.status[0], np.where(height > 50.0, MISS, OK))
    np.testing.assert_array_equal(traced.surface[0], np.where(height > 50.0, 0, -1))
    sideways = np.stack([shifts(0.0)[0, 0], turned(np.pi / 2)])
    sideways[1, [0, 8]] = 0.0
    traced = trace_sequence(Sequence((IMAGE, IMAGE)), collimated(), Moving(sideways[None]), device)
    assert (traced.status == MISS).all()
    assert (traced.surface == 1).all()
    # A wall 1 mm wide and 40 mm high across the light, which is all but parallel to it: no single crossing.
    folds = Element(even=(0.5, -1.0))
    rays = Rays(np.array([[-30.0], [0.0], [0.0]]), np.array([[1.0], [0.0], [1e-3]]), np.zeros(1))
    rays = replace(rays, direction=rays.direction / np.linalg.norm(rays.direction, axis=0))
    traced = trace_sequence(Sequence((folds, IMAGE)), rays, Moving(shifts(0.0, 1.0)), device)
    assert traced.status[0, 0] == DIVERGED
    assert traced.surface[0, 0] == 0
    # Poses that are not numbers lose the ray instead of the batch.
    poses = np.concatenate([shifts(0.0, 1.0), np.full((1, 2, 12), np.nan)])
    traced = trace_sequence(Sequence((IMAGE, IMAGE)), collimated(), Moving(poses), device)
    assert (traced.status[0] == OK).all()
    assert (traced.status[1] == MISS).all()


def surfaces():
    """One element of each kind, all bent enough to need several steps; with its moving parts."""
    random = np.random.default_rng(7)
    monomials, chebyshev = 2.0 * random.normal(size=(2, 28)) / (1.0 + np.arange(28))
    high = random.normal(size=231) / (1.0 + np.arange(231.0)) ** 1.5
    nodes = random.normal(size=(21, 17))
    grid = Grid(-80.0, -90.0, 10.0, 9.0, nodes)
    bent = Element(1.0 / 400.0, -0.7)
    return {
        "plane": (Element(), None, None),
        "conic": (bent, None, None),
        "even": (replace(bent, even=(1e-4, -2e-8, 1e-13)), None, None),
        "polynomial": (replace(bent, polynomial=Polynomial(6, 90.0, monomials)), None, None),
        "chebyshev": (replace(bent, polynomial=Polynomial(20, 120.0, high, "chebyshev")), None, None),
        "grid": (replace(bent, grid=grid), None, None),
        "moving": (
            replace(bent, even=(1e-4,), deformation_degree=6, deformation_radius=90.0),
            np.stack([monomials, chebyshev]),
            None,
        ),
        "moving grid": (
            replace(bent, deformation_grid=grid, polynomial=Polynomial(6, 90.0, monomials)),
            None,
            np.stack([nodes, nodes[::-1]]),
        ),
    }


@pytest.mark.parametrize("kind", sorted(surfaces()))
def test_slopes_are_the_derivatives_of_the_sag(kind):
    element, deformation, grid = surfaces()[kind]
    x, y = np.random.default_rng(5).uniform(-100.0, 100.0, (2, 2, 50))
    h = 1e-3
    _, slope_x, slope_y = sag_and_slopes(element, x, y, deformation, grid)
    right, left, up, down = (
        sag_and_slopes(element, x + h * a, y + h * b, deformation, grid)[0]
        for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))
    )
    np.testing.assert_allclose(slope_x, (right - left) / (2 * h), atol=2e-8)
    np.testing.assert_allclose(slope_y, (up - down) / (2 * h), atol=2e-8)


@pytest.mark.parametrize("device", **NAMES)
@pytest.mark.parametrize("sense", [1.0, -1.0])
@pytest.mark.parametrize("kind", sorted(surfaces()))
def test_an_intersection_lies_on_the_surface_and_its_normal_turns_the_light(kind, sense, device):
    element, deformation, grid = surfaces()[kind]
    rays = from_point([10.0, -5.0, -sense * 300.0], 0.25, sense)
    poses = np.tile(shifts(0.0), (2, 1, 1))
    moving = Moving(poses, (deformation,), (grid,))
    traced = trace_sequence(Sequence((replace(element, action="reflect"),)), rays, moving, device)
    assert (traced.status == OK).all()
    hit = rays.position[:, None] + traced.path * rays.direction[:, None]
    np.testing.assert_allclose(hit[0], traced.x, atol=1e-12)
    np.testing.assert_allclose(hit[1], traced.y, atol=1e-12)
    sag, slope_x, slope_y = sag_and_slopes(element, traced.x, traced.y, deformation, grid)
    np.testing.assert_allclose(hit[2], sag, atol=3e-12)
    # The change of direction is along the normal, and the light's component along it turns around.
    w = traced.w_sign * np.sqrt(1.0 - traced.u**2 - traced.v**2)
    change = np.stack([traced.u, traced.v, w]) - rays.direction[:, None]
    normal = np.stack([-slope_x, -slope_y, np.ones_like(sag)]) / np.sqrt(1.0 + slope_x**2 + slope_y**2)
    np.testing.assert_allclose(np.cross(change, normal, axis=0), 0.0, atol=1e-13)
    before = np.sum(rays.direction[:, None] * normal, axis=0)
    np.testing.assert_allclose(np.sum(change * normal, axis=0), -2.0 * before, atol=1e-13)


@pytest.mark.parametrize("device", **NAMES)
def test_a_grid_continues_with_a_constant_beyond_its_edge(device):
    nodes = np.full((6, 6), 2.5)
    element = Element(grid=Grid(-5.0, -5.0, 2.0, 2.0, nodes))
    traced = trace_sequence(Sequence((element,)), collimated(), Moving(shifts(0.0)), device)
    np.testing.assert_allclose(traced.path, 22.5, atol=1e-13)


@pytest.mark.parametrize("device", **NAMES)
def test_an_instants_bits_do_not_depend_on_the_others(device):
    element, deformation, grid = surfaces()["moving grid"]
    poses = np.tile(shifts(0.0, 40.0), (2, 1, 1))
    poses[:, :, 9:] += np.random.default_rng(1).normal(0.0, 0.1, (2, 2, 3))
    rays = from_point([10.0, -5.0, -300.0], 0.25)
    sequence = Sequence((element, IMAGE))
    both = trace_sequence(sequence, rays, Moving(poses, (deformation, None), (grid, None)), device)
    alone = trace_sequence(sequence, rays, Moving(poses[1:], (deformation, None), (grid[1:], None)), device)
    few = Rays(rays.position[:, 3:9].copy(), rays.direction[:, 3:9].copy(), rays.path[3:9])
    part = trace_sequence(sequence, few, Moving(poses, (deformation, None), (grid, None)), device)
    for name in ("path", "x", "y", "u", "v", "status"):
        np.testing.assert_array_equal(getattr(alone, name)[0], getattr(both, name)[1])
        np.testing.assert_array_equal(getattr(part, name), getattr(both, name)[:, 3:9])


@pytest.mark.parametrize("device", **NAMES)
def test_no_rays_and_no_instants_give_empty_results(device):
    none = Rays(np.zeros((3, 0)), np.zeros((3, 0)), np.zeros(0))
    assert trace_sequence(Sequence((IMAGE,)), none, Moving(shifts(0.0)), device).path.shape == (1, 0)
    nothing = Moving(shifts(0.0)[:0])
    assert trace_sequence(Sequence((IMAGE,)), collimated(), nothing, device).path.shape == (0, 37)


@pytest.mark.parametrize(
    ("element", "message"),
    [
        (Element(curvature=np.nan), "surface 1: curvature"),
        (Element(conic=np.inf), "surface 1: conic"),
        (Element(even=(1.0, np.nan)), "surface 1: even"),
        (Element(polynomial=Polynomial(1, 1.0, np.array([0.0, np.nan, 1.0]))), "surface 1: polynomial"),
        (Element(grid=Grid(0.0, 0.0, 1.0, 1.0, np.full((4, 4), np.inf))), "surface 1: grid"),
        (Element(index=0.0), "surface 1: the refractive index"),
        (Element(deformation_degree=0), "surface 1: deformation"),
    ],
)
def test_coefficients_that_are_not_finite_are_refused_by_surface(element, message):
    deformation = np.full((1, 1), np.nan) if element.deformation_degree == 0 else None
    moving = Moving(shifts(0.0, 1.0), (None, deformation))
    with pytest.raises(UserError, match=message):
        trace_sequence(Sequence((IMAGE, element)), collimated(), moving, NUMPY)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": np.zeros((1, 3, 12))}, "moving.poses"),
        ({"spheres": np.zeros((1, 3))}, "moving.spheres"),
        ({"deformations": (None,)}, "moving.deformations"),
        ({"deformations": (np.zeros((1, 3)), None)}, "deformation of element 0"),
        ({"grids": (np.zeros((1, 4, 4)), None)}, "grid of element 0"),
    ],
)
def test_arrays_that_do_not_fit_are_named(change, message):
    with pytest.raises(ValueError, match=message):
        trace_sequence(
            Sequence((IMAGE, IMAGE)), collimated(), replace(Moving(shifts(0.0, 1.0)), **change), NUMPY
        )


@pytest.mark.parametrize("device", **NAMES)
def test_only_what_is_wanted_comes_and_memory_is_used_again(device):
    mirror, deformation, _ = paraboloids()["moving"]
    arguments = (Sequence((mirror, IMAGE)), collimated(), Moving(shifts(0.0, -900.0), (deformation, None)))
    whole = trace_sequence(*arguments, device)
    some = trace_sequence(*arguments, device, outputs=("y", "path"))
    np.testing.assert_array_equal(some.path, whole.path)
    np.testing.assert_array_equal(some.y, whole.y)
    np.testing.assert_array_equal(some.status, whole.status)
    assert some.x.size == some.u.size == some.v.size == some.w_sign.size == 0
    if device != NUMPY:
        some.path[:] = 0.0
        again = trace_sequence(*arguments, device, outputs=("y", "path"), out=some)
        assert again.path is some.path
        np.testing.assert_array_equal(again.path, whole.path)
        with pytest.raises(ValueError, match="out must hold path, x, status and surface"):
            trace_sequence(*arguments, device, outputs=("path", "x"), out=some)
    with pytest.raises(ValueError, match="outputs"):
        trace_sequence(*arguments, device, outputs=("z",))


@pytest.mark.parametrize("device", **NAMES)
@pytest.mark.parametrize("count", [1, 15, 16, 17, 40])
def test_any_number_of_rays_and_a_shared_direction_give_the_same_bits(count, device):
    element, deformation, grid = surfaces()["moving grid"]
    sequence = Sequence((replace(element, action="reflect"), IMAGE))
    moving = Moving(np.tile(shifts(0.0, -50.0), (2, 1, 1)), (deformation, None), (grid, None))
    rays = collimated(angle=0.05, count=40)
    whole = trace_sequence(sequence, rays, moving, device)
    view = Rays(
        rays.position[:, :count],
        np.broadcast_to(rays.direction[:, :1], (3, count)),
        np.broadcast_to(0.0, count),
    )
    part = trace_sequence(sequence, view, moving, device)
    assert (whole.status == OK).all()
    for name in ("path", "x", "y", "u", "v", "w_sign", "status", "surface"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[:, :count])
