"""What every surface, batch and array owes the sequential trace, on every device."""

from dataclasses import replace

import numpy as np
import pytest
from sequential_cases import IMAGE, NAMES, collimated, from_point, paraboloids, shifts

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.trace.sequence import Element, Grid, Moving, Polynomial, Rays, Ring, Sequence
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.kernels.trace.sequential_numpy import sag_and_slopes
from wavequake.kernels.trace.status import OK


def surfaces():
    """One element of each kind, all bent enough to need several steps; with its moving parts."""
    random = np.random.default_rng(7)
    monomials, others = 2.0 * random.normal(size=(2, 28)) / (1.0 + np.arange(28))
    high = random.normal(size=300) / (1.0 + np.arange(300.0)[::-1]) ** 1.5
    nodes = random.normal(size=(21, 17))
    grid = Grid(-80.0, -90.0, 10.0, 9.0, nodes)
    bent = Element(1.0 / 400.0, -0.7)
    return {
        "plane": (Element(), None, None),
        "conic": (bent, None, None),
        "even": (replace(bent, even=(1e-4, -2e-8, 1e-13)), None, None),
        "polynomial": (replace(bent, polynomial=Polynomial(6, 90.0, monomials)), None, None),
        "ring": (replace(bent, polynomial=Polynomial(23, 120.0, high, Ring(0.2))), None, None),
        "grid": (replace(bent, grid=grid), None, None),
        "moving": (
            replace(bent, even=(1e-4,), deformation_degree=6, deformation_radius=90.0),
            np.stack([monomials, others]),
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
    # Beyond its ring a polynomial of high degree is steep, and differences err with it.
    np.testing.assert_allclose(slope_x, (right - left) / (2 * h), rtol=1e-7, atol=2e-8)
    np.testing.assert_allclose(slope_y, (up - down) / (2 * h), rtol=1e-7, atol=2e-8)


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
    np.testing.assert_allclose(hit[0], traced.x, rtol=0, atol=1e-12)
    np.testing.assert_allclose(hit[1], traced.y, rtol=0, atol=1e-12)
    sag, slope_x, slope_y = sag_and_slopes(element, traced.x, traced.y, deformation, grid)
    np.testing.assert_allclose(hit[2], sag, rtol=0, atol=3e-12)
    # The change of direction is along the normal, and the light's component along it turns around.
    w = traced.w_sign * np.sqrt(1.0 - traced.u**2 - traced.v**2)
    change = np.stack([traced.u, traced.v, w]) - rays.direction[:, None]
    normal = np.stack([-slope_x, -slope_y, np.ones_like(sag)]) / np.sqrt(1.0 + slope_x**2 + slope_y**2)
    np.testing.assert_allclose(np.cross(change, normal, axis=0), 0.0, rtol=0, atol=1e-13)
    before = np.sum(rays.direction[:, None] * normal, axis=0)
    np.testing.assert_allclose(np.sum(change * normal, axis=0), -2.0 * before, rtol=0, atol=1e-13)


@pytest.mark.parametrize("device", **NAMES)
@pytest.mark.parametrize("away", [10.0, 1e5])
@pytest.mark.parametrize("incidence", [0.0, 30.0, 60.0])
def test_a_piston_of_a_sphere_is_the_sphere_elsewhere(device, incidence, away):
    """Also far along the light, whose lateral steps are as long as the piston."""
    angle, piston = np.radians(incidence), 1e-3
    direction = np.array([np.sin(angle), 0.0, np.cos(angle)])
    position = np.array([[-3.0, 0.0, 4.0], [0.0, 2.0, -5.0], [0.0, 0.0, 0.0]]) - away * direction[:, None]
    rays = Rays(position, np.repeat(direction[:, None], 3, axis=1), np.zeros(3))
    sphere = Element(1.0 / 100.0, 0.0, "refract", 1.5)
    poses = np.zeros((1, 2, 12))
    poses[..., [0, 4, 8]], poses[:, 1, 11] = 1.0, -150.0
    lifted = replace(sphere, deformation_degree=0, deformation_radius=100.0)
    heights = (np.full((1, 1), piston), None)
    found = trace_sequence(Sequence((lifted, Element())), rays, Moving(poses, heights), device)
    poses[:, :, 11] += [-piston, piston]
    expected = trace_sequence(Sequence((sphere, Element())), rays, Moving(poses), NUMPY)
    assert (found.status == OK).all()
    for name in ("path", "x", "y", "u"):
        difference = np.abs(getattr(found, name) - getattr(expected, name)).max()
        assert difference < 2e-14 * max(away, 1e3), name


@pytest.mark.parametrize("device", **NAMES)
def test_a_grid_continues_with_a_constant_beyond_its_edge(device):
    nodes = np.full((6, 6), 2.5)
    element = Element(grid=Grid(-5.0, -5.0, 2.0, 2.0, nodes))
    traced = trace_sequence(Sequence((element,)), collimated(), Moving(shifts(0.0)), device)
    np.testing.assert_allclose(traced.path, 22.5, rtol=0, atol=1e-13)


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


def test_instants_at_rest_are_as_if_there_were_no_figure():
    """Of several instants only some deform: each is what it is alone, to the last bit."""
    element, deformation, grid = surfaces()["moving"]
    x, y = np.random.default_rng(6).uniform(-100.0, 100.0, (2, 3, 20))
    some = np.stack([0.0 * deformation[0], deformation[0], 0.0 * deformation[0]])
    together = np.stack(sag_and_slopes(element, x, y, some, grid))
    rest = np.stack(sag_and_slopes(element, x, y, None, grid))
    np.testing.assert_array_equal(together[:, [0, 2]], rest[:, [0, 2]])
    alone = np.stack(sag_and_slopes(element, x[1:2], y[1:2], some[1:2], grid))
    np.testing.assert_array_equal(together[:, 1:2], alone)
    assert np.abs(together[0, 1] - rest[0, 1]).max() > 0.0


@pytest.mark.parametrize("device", **NAMES)
@pytest.mark.parametrize("even", [(), (1e-9,)])
@pytest.mark.parametrize("sense", [1, -1])
def test_light_from_the_side_meets_a_sphere_in_the_sense_that_the_element_says(device, even, sense):
    angle = np.radians(100.0)
    direction = sense * np.array([0.0, np.sin(angle), np.cos(angle)])
    place = np.array([[3.0, -4.0], [-30.0, -20.0], [8.0, 6.0]]) - 200.0 * direction[:, None]
    rays = Rays(place, np.repeat(direction[:, None], 2, axis=1), np.zeros(2))
    sphere = Element(1.0 / 50.0, even=even, sense=sense)
    traced = trace_sequence(Sequence((sphere,)), rays, Moving(shifts(0.0)), device)
    assert (traced.status == OK).all()
    # From outside it enters at the first of both places on its way, from inside it leaves at the second one.
    center = np.array([[0.0], [0.0], [50.0]])
    along = direction @ (center - place)
    half = np.sqrt(2500.0 - (np.sum((center - place) ** 2, axis=0) - along**2))
    tolerance = 2e-2 if even else 1e-12
    np.testing.assert_allclose(traced.path[0], along - sense * half, rtol=0, atol=tolerance)
