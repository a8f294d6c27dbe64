"""What every surface owes: rays end on it, from either side, and its normal turns them.

The surface's heights and slopes are those of `shape_sag`, which shares no code with what the trace packs
(splines of SciPy, Zernike recurrences, powers as they are written).
"""

from itertools import product

import numpy as np
import pytest

from wavequake.kernels.device.devices import list_devices
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.kernels.trace.status import OK
from wavequake.optics.media.glasses import AIR, constant
from wavequake.optics.rays.packing import moving, pack
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
from wavequake.optics.systems.system import OpticalSystem, Pupil, States, Surface

RNG = np.random.default_rng(11)
SHAPES = {
    "plane": Conic(),
    "sphere": Conic(300.0),
    "conic": Conic(-250.0, -1.7),
    "oblate": Conic(260.0, 0.6),
    "even asphere": EvenAsphere(300.0, 0.4, (1e-5, -2e-8, 3e-12)),
    "extended polynomial": ExtendedPolynomial(-400.0, 0.2, tuple(RNG.normal(size=20) * 0.05), 60.0),
    "circular Zernike": ZernikeSag(500.0, -0.5, tuple(RNG.normal(size=45) * 2e-3), 70.0),
    "annular Zernike": ZernikeSag(-500.0, -0.5, tuple(RNG.normal(size=45) * 2e-3), 70.0, 0.3),
    "grid": GridSag(-700.0, 0.0, RNG.normal(size=(15, 12)) * 5e-3, 12.0, 10.0),
    "grid on an asphere": GridSag(
        *(-700.0, -0.4, RNG.normal(size=(9, 9)) * 5e-3, 20.0, 18.0),
        even=(1e-5, -2e-8),
        zernike=tuple(RNG.normal(size=11) * 2e-3),
        pupil_radius=70.0,
    ),
    "fine Zernike": ZernikeSag(500.0, -0.5, tuple(RNG.normal(size=325) * 2e-4), 70.0),
}
FORMS = {
    "rigid": None,
    "Zernike": ZernikeDeformation(28, 70.0),
    "annular": ZernikeDeformation(21, 70.0, 0.25),
    "fine annular": ZernikeDeformation(240, 70.0, 0.1),
    "grid": GridDeformation(9, 11, 16.0, 20.0),
    "Zernike and grid": ZernikeDeformation(15, 70.0, 0.0, GridDeformation(8, 8, 20.0, 20.0)),
}
DEVICES = list_devices()
# Each shape and each deformation on every device, all pairs in NumPy: a kernel takes a while to build.
EACH = [*product(SHAPES, ["rigid"]), *product(["annular Zernike"], FORMS)]
CASES = [
    (shape, form, action, device)
    for shape, form, action in product(SHAPES, FORMS, ("reflect", "refract"))
    for device in DEVICES
    if device.kind == "numpy" or (action == "reflect" and (shape, form) in EACH)
]


def size_of(form):
    return (form.size,) if isinstance(form, ZernikeDeformation) else (form.rows, form.columns)


def surface_and_slopes(shape, form, numbers, x, y):
    """Return height and slopes (T, N) by the formulas of the shapes."""
    total = np.stack(shape_sag(shape, x, y))
    if form is not None:
        pairs = zip(numbers, np.moveaxis(np.stack([x, y]), 1, 0), strict=True)
        total = total + np.stack([deformation_sag(form, one, *at) for one, at in pairs], axis=1)
    return total


@pytest.mark.parametrize(
    ("shape", "form", "action", "device"), CASES, ids=lambda one: getattr(one, "kind", one)
)
def test_rays_end_on_the_surface_and_obey_its_law(shape, form, action, device):
    form, shape = FORMS[form], SHAPES[shape]
    random = np.random.default_rng(3)
    numbers = None if form is None else random.normal(size=(2, *size_of(form))) * 2e-3
    for sense in (1.0, -1.0):
        one = Surface("surface", shape, action=action, medium=constant(1.4), deformation=form)
        system = OpticalSystem("one", (one, Surface("image")), 0, Pupil("entrance_diameter", 1.0))
        states = States(np.zeros((2, 2, 6)), (numbers, None), np.zeros((2, 2)))
        x, y = random.uniform(-45.0, 45.0, (2, 24))
        u, v = random.uniform(-0.15, 0.15, (2, 24))
        d = np.stack([u, v, sense * np.sqrt(1.0 - u**2 - v**2)])
        rays = Rays(np.stack([x, y, np.zeros(24)]) - 80.0 * d, d, np.zeros(24))
        sequence, light = pack(system, 550e-6), moving(system, states)
        first = type(sequence)(sequence.elements[:1], sequence.index)
        part = type(light)(light.poses[:, :1], light.deformations[:1], light.grids[:1])
        traced = trace_sequence(first, rays, part, device)
        assert (traced.status == OK).all()
        # On the ray, at its path length, and on the surface.
        hit = rays.position[:, None] + traced.path * d[:, None]
        z, slope_x, slope_y = surface_and_slopes(shape, form, numbers, traced.x, traced.y)
        np.testing.assert_allclose(hit, np.stack([traced.x, traced.y, z]), rtol=0, atol=5e-12)
        # Reflection and refraction change the optical ray vector n d along the normal only.
        normal = np.stack([-slope_x, -slope_y, np.ones_like(z)]) / np.sqrt(1.0 + slope_x**2 + slope_y**2)
        after = np.stack([traced.u, traced.v, traced.w_sign * np.sqrt(1.0 - traced.u**2 - traced.v**2)])
        index = 1.4 if action == "refract" else 1.0
        turn = index * after - d[:, None]
        np.testing.assert_allclose(np.cross(turn, normal, axis=0), 0.0, rtol=0, atol=2e-12)
        side = np.sign(np.sum(after * normal, axis=0) * np.sum(d[:, None] * normal, axis=0))
        assert (side == (1.0 if action == "refract" else -1.0)).all()


@pytest.mark.parametrize(
    ("shape", "device"),
    [(s, d) for s in SHAPES for d in DEVICES if d.kind == "numpy" or s in ("plane", "even asphere")],
    ids=lambda one: getattr(one, "kind", one),
)
def test_light_that_leaves_glass_at_a_flat_angle_is_totally_reflected(shape, device):
    """Inside of n = 1.5 the limit is asin(1 / 1.5) = 41.8 degrees to the normal of any shape."""
    one = Surface("surface", SHAPES[shape], action="refract", medium=AIR)
    system = OpticalSystem(
        "one", (one, Surface("image")), 0, Pupil("entrance_diameter", 1.0), medium=constant(1.5)
    )
    point = np.array([3.0, -7.0])
    z, slope_x, slope_y = (float(value) for value in shape_sag(SHAPES[shape], *point))
    normal = np.array([-slope_x, -slope_y, 1.0]) / np.sqrt(1.0 + slope_x**2 + slope_y**2)
    across = np.cross(normal, [0.3, 1.0, 0.2])
    across /= np.linalg.norm(across)
    limit = np.arcsin(1.0 / 1.5)
    d = np.stack([np.cos(a) * normal + np.sin(a) * across for a in (limit - 1e-6, limit + 1e-6)], axis=1)
    rays = Rays(np.array([[*point, z]]).T - 5.0 * d, d, np.zeros(2))
    still = States(np.zeros((1, 2, 6)), (None, None), np.zeros((1, 2)))
    sequence, light = pack(system, 550e-6), moving(system, still)
    first = type(sequence)(sequence.elements[:1], sequence.index)
    traced = trace_sequence(first, rays, type(light)(light.poses[:, :1]), device)
    assert traced.status.tolist() == [[0, 3]]
    assert traced.surface.tolist() == [[-1, 0]]
