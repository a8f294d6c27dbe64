"""The sequential trace against closed forms of geometrical optics, on every device."""

from dataclasses import replace

import numpy as np
import pytest
from sequential_cases import IMAGE, NAMES, collimated, from_point, paraboloids, shifts, turned

from wavequake.kernels.trace.sequence import Element, Moving, Polynomial, Rays, Region, Sequence
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.kernels.trace.status import DIVERGED, MISS, OK, TOTAL_REFLECTION, VIGNETTED


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
        np.testing.assert_allclose(traced.path, 1020.0 - radius, rtol=0, atol=2e-12)
    moving = replace(moving, spheres=np.array([[0.0, 500.0, 0.0, 100.0]]))
    traced = trace_sequence(Sequence((mirror, IMAGE)), collimated(), moving, device)
    assert (traced.status == MISS).all()
    assert (traced.surface == 2).all()
    # A sphere that is not about the image: the distance from the image is that along the ray.
    moving = replace(moving, spheres=np.array([[1.0, -2.0, 3.0, 50.0]]))
    traced = trace_sequence(Sequence((mirror, IMAGE)), collimated(), moving, device)
    d = np.stack([traced.u, traced.v, -np.sqrt(1.0 - traced.u**2 - traced.v**2)])
    point = (traced.path - 1020.0) * d - np.reshape([1.0, -2.0, 3.0], (3, 1, 1))
    np.testing.assert_allclose(np.linalg.norm(point, axis=0), 50.0, rtol=0, atol=1e-11)
    assert (traced.path < 1020.0).all()


@pytest.mark.parametrize("device", **NAMES)
def test_an_ellipsoid_brings_light_from_one_focus_to_the_other(device):
    a, e = 500.0, 0.4
    mirror = Element(-1.0 / (a * (1 - e * e)), -e * e, "reflect")
    near, far = a * (1 - e), a * (1 + e)
    rays = from_point([0.0, 0.0, -near], 1.2)
    traced = trace_sequence(Sequence((mirror, IMAGE)), rays, Moving(shifts(0.0, -far)), device)
    assert np.hypot(traced.x, traced.y).max() < 2e-12 * a
    np.testing.assert_allclose(traced.path, 2 * a, rtol=0, atol=2e-12)


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
    np.testing.assert_allclose(traced.path, 1000.0 - p + q, rtol=0, atol=3e-12)
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
    np.testing.assert_allclose(traced.path, before * (400.0 - from_) + after * to, rtol=0, atol=1e-11)


@pytest.mark.parametrize("device", **NAMES)
def test_an_ellipsoid_of_glass_focuses_collimated_light(device):
    n, radius = 1.6, 60.0
    glass = Element(1.0 / radius, -1.0 / n**2, "refract", n)
    focus = n * radius / (n - 1.0)
    rays = collimated(radius=40.0)
    traced = trace_sequence(Sequence((glass, IMAGE)), rays, Moving(shifts(0.0, focus)), device)
    assert np.hypot(traced.x, traced.y).max() < 1e-11
    np.testing.assert_allclose(traced.path, 20.0 + n * focus, rtol=0, atol=3e-12)


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


@pytest.mark.parametrize("device", **NAMES)
def test_a_turn_by_nothing_changes_no_bit(device):
    """So results do not depend on which program traces them."""
    element = Element(
        -1 / 400, -0.4, action="reflect", polynomial=Polynomial(3, 90.0, 1e-3 * np.arange(10.0))
    )
    moving, rays = Moving(shifts(0.0, (1.0, -2.0, -200.0))), collimated(angle=0.01)
    found = [
        trace_sequence(Sequence((element, IMAGE), turning=turning), rays, moving, device)
        for turning in (False, True)
    ]
    assert np.isfinite(found[0].path).all()
    for name in ("path", "x", "y", "u", "v", "w_sign", "status"):
        np.testing.assert_array_equal(getattr(found[0], name), getattr(found[1], name))
