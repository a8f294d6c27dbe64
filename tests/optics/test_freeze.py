"""Systems as they stand at an instant, as lens files: the same rays through what moves and deforms."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.kernels.trace.status import OK
from wavequake.optics.rays.aiming import pupil_rays
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.shapes.forms.forbes_asphere import ForbesAsphere
from wavequake.optics.shapes.forms.odd_asphere import OddAsphere
from wavequake.optics.shapes.forms.toroid import Toroid
from wavequake.optics.shapes.sag import deformation_sag, shape_sag
from wavequake.optics.shapes.shapes import (
    Conic,
    EvenAsphere,
    ExtendedPolynomial,
    GridDeformation,
    GridSag,
    ZernikeDeformation,
    ZernikeSag,
)
from wavequake.optics.systems import on_grid
from wavequake.optics.systems.freeze import frozen
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil
from wavequake.optics.zemax.export import zmx_text
from wavequake.optics.zemax.read import parse_zmx

WAVELENGTH = 550e-6
RNG = np.random.default_rng(3)
GRID = GridDeformation(9, 7, 2.0, 1.5)  # 12 mm by 12 mm
ROUGH = RNG.normal(0.0, 1e-4, (9, 7))
FIGURE = RNG.normal(0.0, 1e-4, 15)
CIRCLE, RING = ZernikeDeformation(15, 6.0), ZernikeDeformation(15, 6.0, 0.3)
BOTH = replace(CIRCLE, residual=GRID)
FORMS = {
    "grid": (GRID, ROUGH),
    "polynomials": (CIRCLE, FIGURE),
    "ring": (RING, FIGURE),
    "both": (BOTH, np.concatenate([FIGURE, ROUGH.ravel()])),
}
EVEN = EvenAsphere(-120.0, -0.7, (1e-5, 2e-6, -1e-8))
ON_GRID = GridSag(-120.0, -0.7, ROUGH[::-1] / 3.0, GRID.dx, GRID.dy)
KEPT = {  # shapes that hold the deformation as it is
    "conic": Conic(-120.0, -0.7),
    "asphere": EVEN,
    "Zernike": ZernikeSag(-120.0, -0.7, tuple(FIGURE[::-1] / 2.0), 6.0),
    "grid": ON_GRID,
}
SAMPLED = {  # heights on a finer grid, to 2e-9 mm
    "toroid": Toroid(-120.0, -0.7, -90.0, (1e-5,)),
    "Forbes": ForbesAsphere(-120.0, -0.7, (2e-3, 1e-3), 6.5, "con"),
    "polynomial": ExtendedPolynomial(-120.0, -0.7, (1e-4, 2e-4, 1e-3, -2e-3, 5e-4), 6.0),
    "other grid": GridSag(-120.0, -0.7, 1e-4 * RNG.normal(size=(5, 5)), 3.0, 3.0),
}


def system_of(shape, form):
    rows = [SurfaceRow("M1", shape, -100.0, "reflect"), SurfaceRow("image")]
    system = OpticalSystem("mirror", sequential(rows), 0, Pupil("entrance_diameter", 10.0))
    first, *others = system.surfaces
    return replace(system, surfaces=(replace(first, deformation=form), *others))


def traced(system, states):
    x, y = np.random.default_rng(2).uniform(-3.5, 3.5, (2, 60))
    rays = Rays(np.stack([x, y, 0 * x - 20]), np.array([[0.0], [0.0], [1.0]]) * np.ones(60), np.zeros(60))
    return traced_rays(system, states, rays)


def traced_rays(system, states, rays):
    """Places and paths at the image, and directions."""
    found = trace_sequence_numpy(pack(system, WAVELENGTH), rays, moving(system, states), True)
    assert (found.status == OK).all()
    return np.array([found.x, found.y, found.path])[:, 0], np.array([found.u, found.v])[:, 0]


def through_a_file(shape, form, numbers):
    """What rays do in the case, and in its lens file at rest."""
    system = system_of(shape, form)
    states = rest_states(system)
    case = replace(states, deformations=(numbers[None], *states.deformations[1:]))
    again = parse_zmx(zmx_text(frozen(system, case)), "case.zmx")
    return traced(system, case), traced(again, rest_states(again)), again.surfaces[0].shape


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("shape", KEPT)
def test_shapes_that_hold_a_deformation_send_light_to_the_same_place(shape, form):
    """Of figures of 100 nm to rounding; a grid under a grid keeps its nodes."""
    (ours, _), (theirs, _), _ = through_a_file(KEPT[shape], *FORMS[form])
    plain = system_of(KEPT[shape], None)
    assert np.abs(ours - traced(plain, rest_states(plain))[0]).max() > 1e-4
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-12)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("shape", SAMPLED)
def test_other_shapes_send_light_to_the_same_place_within_1e_5_waves(shape, form):
    """Of wavefronts: paths to the same point of the image, as if each ray's neighborhood were plane."""
    (ours, along), (theirs, _), found = through_a_file(SAMPLED[shape], *FORMS[form])
    assert isinstance(found, GridSag)
    away = theirs - ours
    assert np.abs(away[2] - np.sum(along * away[:2], axis=0)).max() < 1e-5 * WAVELENGTH
    assert np.abs(away[:2]).max() < 2e-6  # slopes of 1e-8


def test_light_that_motion_takes_across_a_surface_still_meets_heights_that_are_right():
    """A toroid that moves by most of its beam's radius: about the beams at rest a grid would end too soon."""
    system = system_of(SAMPLED["toroid"], CIRCLE)
    states = rest_states(system)
    moved = states.surface_motion.copy()
    moved[0, 0, :2] = 4.0, -1.0
    case = replace(states, surface_motion=moved, deformations=(FIGURE[None], None))
    ours, along = traced(system, case)
    again = frozen(system, case)
    away = traced(again, rest_states(again))[0] - ours
    assert np.abs(away[2] - np.sum(along * away[:2], axis=0)).max() < 1e-5 * WAVELENGTH


def test_grids_are_right_along_their_lines_too():
    """Of x^4 - y^4 what a spline is off cancels in the middle of cells, not halfway along their edges."""
    shape = ExtendedPolynomial(-200.0, 0.0, (*[0.0] * 9, 1.0, 0.0, 0.0, 0.0, -1.0), 20.0)
    surface, numbers = system_of(shape, CIRCLE).surfaces[0], FIGURE * 1e-6
    found = on_grid.on_grid(surface, numbers, np.array([20.0, 20.0]))
    x, y = np.meshgrid(*[np.linspace(-20.0, 20.0, 301)] * 2)
    wanted = shape_sag(shape, x, y)[0] + deformation_sag(CIRCLE, numbers, x, y)[0]
    assert np.abs(shape_sag(found, x, y)[0] - wanted).max() <= 1.1 * on_grid.MOST_OFF


def test_a_surface_where_light_comes_to_a_point_has_a_grid():
    surface = system_of(SAMPLED["toroid"], CIRCLE).surfaces[0]
    found = on_grid.on_grid(surface, FIGURE, np.array([1e-17, 0.0]))
    assert min(found.dx, found.dy) > 1e-4


def test_a_surface_that_no_grid_holds_says_so(monkeypatch):
    monkeypatch.setattr(on_grid, "MAX_NODES", 100 * 100)
    tip = OddAsphere(-120.0, 0.0, (1e-3,))  # of a cone
    with pytest.raises(
        UserError, match=r"M1 is a OddAsphere .* mm off with 3185 nodes .* FILE.txt, hold all"
    ):
        through_a_file(tip, *FORMS["grid"])
    half = Toroid(-5.6, 0.0, -5.6)  # whose corners are beyond its rim
    with pytest.raises(UserError, match=r"M1 is a Toroid .* does not reach over the square"):
        through_a_file(half, *FORMS["polynomials"])
    monkeypatch.setattr(on_grid, "MAX_NODES", 60)
    with pytest.raises(UserError, match=r"and the grid needs more than 60 nodes; displacements"):
        through_a_file(SAMPLED["polynomial"], *FORMS["both"])


def test_the_light_of_a_near_object_turns_as_the_system_turns_the_other_way():
    """The same bundle in both frames: the image stands where it does, seen from the image surface."""
    rows = [SurfaceRow("M1", Conic(-120.0), -100.0, "reflect"), SurfaceRow("image")]
    system = OpticalSystem(
        "near",
        sequential(rows),
        0,
        Pupil("entrance_diameter", 10.0),
        fields=np.array([[0.0, 0.0], [2.0, -1.0]]),
        object_distance=300.0,
    )
    states = rest_states(system)
    turned = replace(states, line_of_sight=np.array([[2e-3, -1e-3]]))
    again = parse_zmx(zmx_text(frozen(system, turned)), "case.zmx")
    assert again.object_distance == pytest.approx(300.0, abs=1e-9)
    for field in range(2):
        light = pupil_rays(system, system.fields[field], WAVELENGTH, np.zeros(1), np.zeros(1))
        ours, _ = traced_rays(system, turned, light)
        light = pupil_rays(again, again.fields[field], WAVELENGTH, np.zeros(1), np.zeros(1))
        theirs, _ = traced_rays(again, rest_states(again), light)
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=1e-9)
