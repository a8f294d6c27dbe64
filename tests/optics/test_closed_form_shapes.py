"""Cylinders, toroids, biconics, cones and Forbes' aspheres against their closed forms, and a file of each."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.polynomial import Polynomial

import wavequake as wq
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, list_devices
from wavequake.kernels.trace.sequence import (
    Element,
    Form,
    Moving,
    Rays,
    Ring,
    Sequence,
)
from wavequake.kernels.trace.sequence import (
    Polynomial as Monomials,
)
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.kernels.trace.status import DIVERGED, MISS, OK
from wavequake.optics.media.glasses import glass
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.shapes.forms.biconic import Biconic
from wavequake.optics.shapes.forms.forbes_asphere import ForbesAsphere
from wavequake.optics.shapes.forms.odd_asphere import OddAsphere
from wavequake.optics.shapes.forms.toroid import Toroid
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.shapes.shapes import Conic, EvenAsphere
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil
from wavequake.optics.zemax.read import parse_zmx, read_zmx

LENSES = Path(__file__).parents[1] / "data" / "lenses"
RNG = np.random.default_rng(11)
X, Y = RNG.uniform(-9.0, 9.0, (2, 60))


def test_a_toroid_keeps_its_distance_from_its_axis():
    """Each point stands as far from the axis of the turn as the circle's point of the same y."""
    z, *_ = shape_sag(Toroid(-20.0, 0.0, 35.0), X, Y)
    circle = -20.0 + np.sqrt(20.0**2 - Y**2)
    np.testing.assert_allclose(np.hypot(X, z - 35.0), 35.0 - circle, rtol=0, atol=1e-13)


def test_a_toroid_of_equal_radii_is_a_sphere_along_its_meridians():
    shape = Toroid(30.0, 0.0, 30.0)
    sphere = shape_sag(Conic(30.0), X, 0.0 * X)
    np.testing.assert_allclose(shape_sag(shape, X, 0.0 * X), sphere, rtol=0, atol=1e-13)
    np.testing.assert_allclose(
        shape_sag(shape, 0.0 * Y, Y), shape_sag(Conic(30.0), 0.0 * Y, Y), rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("along", ["x", "y"])
def test_cylinders_are_circles_beside_each_other(along):
    shape = Toroid(12.0, 0.0, np.inf) if along == "y" else Toroid(np.inf, 0.0, 12.0)
    z, slope_x, slope_y = shape_sag(shape, X, Y)
    across, steep, flat = (Y, slope_y, slope_x) if along == "y" else (X, slope_x, slope_y)
    np.testing.assert_allclose(across**2 + (z - 12.0) ** 2, 144.0, rtol=1e-14)
    np.testing.assert_allclose(steep, across / np.sqrt(144.0 - across**2), rtol=1e-13, atol=1e-15)
    assert not flat.any()


def test_a_biconic_is_a_conic_in_each_meridian_and_where_both_are_equal():
    shape = Biconic(-40.0, -0.7, 25.0, 1.3)
    zero = 0.0 * X
    np.testing.assert_allclose(
        shape_sag(shape, zero, Y), shape_sag(Conic(-40.0, -0.7), zero, Y), rtol=0, atol=1e-13
    )
    np.testing.assert_allclose(
        shape_sag(shape, X, zero), shape_sag(Conic(25.0, 1.3), X, zero), rtol=0, atol=1e-13
    )
    same = shape_sag(Biconic(25.0, 1.3, 25.0, 1.3), X, Y)
    np.testing.assert_allclose(same, shape_sag(Conic(25.0, 1.3), X, Y), rtol=0, atol=1e-13)


def test_an_odd_asphere_of_even_powers_is_an_even_one_and_of_the_first_a_cone():
    odd, even = OddAsphere(50.0, -2.0, (0.0, 1e-3, 0.0, -2e-6)), EvenAsphere(50.0, -2.0, (1e-3, -2e-6))
    np.testing.assert_allclose(shape_sag(odd, X, Y), shape_sag(even, X, Y), rtol=0, atol=1e-14)
    z, slope_x, slope_y = shape_sag(OddAsphere(np.inf, 0.0, (0.1,)), X, Y)
    np.testing.assert_allclose(z, 0.1 * np.hypot(X, Y), rtol=1e-15)
    np.testing.assert_allclose(np.hypot(slope_x, slope_y), 0.1, rtol=1e-15)
    assert shape_sag(OddAsphere(np.inf, 0.0, (0.1,)), 0.0, 0.0) == (0.0, 0.0, 0.0)


# Forbes 2007, Eq. 2.9 and 3.9 with their figures: the first polynomials as published, by powers of u^2.
QBFS = (
    Polynomial([1.0]),
    Polynomial([13.0, -16.0]) / np.sqrt(19.0),
    np.sqrt(2.0 / 95.0) * Polynomial([29.0, -100.0, 76.0]),
    np.sqrt(2.0 / 2545.0) * Polynomial([207.0, -1260.0, 2308.0, -1280.0]),
)
QCON = (
    Polynomial([1.0]),
    Polynomial([-5.0, 6.0]),
    Polynomial([15.0, -42.0, 28.0]),
    Polynomial([-35.0, 168.0, -252.0, 120.0]),
)


def test_qcon_is_the_published_polynomial_over_a_conic():
    a = (0.3, -0.2, 0.15, 0.05)
    shape = ForbesAsphere(-40.0, -0.8, a, 14.0, "con")
    w = (X**2 + Y**2) / 14.0**2
    powers = sum(c * q for c, q in zip(a, QCON, strict=True)) * Polynomial([0.0, 0.0, 1.0])
    expected = shape_sag(Conic(-40.0, -0.8), X, Y)[0] + powers(w)
    np.testing.assert_allclose(shape_sag(shape, X, Y)[0], expected, rtol=0, atol=1e-13)
    # The same asphere by even powers of r.
    even = EvenAsphere(-40.0, -0.8, tuple(c / 14.0 ** (2 * k) for k, c in enumerate(powers.coef) if k))
    np.testing.assert_allclose(shape_sag(shape, X, Y), shape_sag(even, X, Y), rtol=0, atol=1e-12)


def test_qbfs_is_the_published_departure_from_a_sphere_along_its_normal():
    a = (0.3, -0.2, 0.15, 0.05)
    shape = ForbesAsphere(-40.0, 0.0, a, 14.0, "bfs")
    w = (X**2 + Y**2) / 14.0**2
    normal = sum(c * q for c, q in zip(a, QBFS, strict=True))(w) * w * (1.0 - w)
    sphere, slope_x, slope_y = shape_sag(Conic(-40.0), X, Y)
    expected = sphere + normal * np.sqrt(1.0 + slope_x**2 + slope_y**2)
    np.testing.assert_allclose(shape_sag(shape, X, Y)[0], expected, rtol=0, atol=1e-13)


def test_slopes_of_qbfs_are_orthonormal_to_high_orders():
    """Forbes 2007, Eq. 2.7: d/du (u^2 (1 - u^2) Q_m) with the weight 1 / (u sqrt(1 - u^2)) ... / pi * 2."""
    count, angles = 25, (np.arange(2000) + 0.5) * np.pi / 4000.0
    u = np.sin(angles)
    slopes = []
    for m in range(count):
        shape = ForbesAsphere(np.inf, 0.0, (0.0,) * m + (1.0,), 1.0, "bfs")
        slopes.append(shape_sag(shape, u, 0.0 * u)[1])
    gram = np.array(slopes) @ np.array(slopes).T * 2.0 / np.pi * (np.pi / 4000.0)
    np.testing.assert_allclose(gram, np.eye(count) * gram[0, 0], atol=1e-9 * gram[0, 0])


def test_a_qbfs_asphere_of_a_catalogue_focuses_as_its_maker_says():
    """ASL5040-UV of Thorlabs: f = 40 mm, numerical aperture 0.65, diffraction-limited at its wavelength."""
    lens = read_zmx(LENSES / "ray_optics_asl5040_uv_zemax_zmx.zmx")
    assert isinstance(lens.surfaces[0].shape, ForbesAsphere)
    data = wq.info(wq.load_system(LENSES / "ray_optics_asl5040_uv_zemax_zmx.zmx"))
    assert "of real rays 0.64994" in data
    height = np.linspace(0.5, 22.8, 30)
    start = np.stack([0.0 * height, height, 0.0 * height - 1.0])
    rays = Rays(start, np.tile([[0.0], [0.0], [1.0]], (1, 30)), np.zeros(30))
    found = trace_sequence(pack(lens, 405e-6), rays, moving(lens, rest_states(lens)), NUMPY, True)
    assert (found.status == OK).all()
    assert np.abs(found.y).max() < 5e-4  # of a lens 45.6 mm wide; a wrong convention leaves 0.1 mm and more
    assert np.ptp(found.path) / 405e-6 < 0.5


FORMS = {
    "radial": Element(0.01, -0.5, form=Form("radial", (0.01, -1e-3, 2e-5))),
    "biconic": Element(0.025, -1.0, form=Form("biconic", (0.04, 0.01, 1.4 * 0.0016, -0.3e-4), near=0.025)),
    "toroid": Element(-0.01, -1.0, form=Form("toroid", (0.03, -0.02, 0.0004, 1e-4, -1e-6), near=-0.01)),
    "cylinder": Element(0.02, -1.0, form=Form("toroid", (0.0, 0.04, 0.0016), near=0.02)),
    "qbfs": Element(
        0.03, -0.4, form=Form("qbfs", (1 / 225.0, -0.4 * 9e-4, 0.6 * 9e-4, 0.2, -0.1, 0.05, 0.01))
    ),
    "qcon": Element(-0.03, 0.5, form=Form("qcon", (1 / 225.0, 0.2, -0.1, 0.05, 0.01))),
}
DEFORMED = {"deformation_degree": 4, "deformation_radius": 15.0, "deformation_basis": Ring()}


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize("action", ["reflect", "refract"])
@pytest.mark.parametrize("deforms", [False, True])
def test_kernels_trace_forms_as_their_twins_in_numpy(name, action, deforms):
    """A ray's point on the surface, its direction behind and its path, also where the surface deforms."""
    element = replace(
        FORMS[name], action=action, index=1.6, polynomial=Monomials(2, 10.0, 1e-3 * np.arange(6.0))
    )
    figures = None
    if deforms:
        element = replace(element, **DEFORMED)
        figures = RNG.normal(size=(3, 15)) * 1e-4
    sequence = Sequence((element, Element()), 1.0)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(0.2), -np.sin(0.2)], [0.0, np.sin(0.2), np.cos(0.2)]])
    poses = np.tile(np.array([[*turn.ravel(), 0.5, -0.3, 10.0], [*np.eye(3).ravel(), 0, 0, -5.0]]), (3, 1, 1))
    poses[:, 0, 9:] += RNG.normal(size=(3, 3)) * 0.1
    x, y = RNG.uniform(-11.0, 11.0, (2, 200))
    d = np.stack([*RNG.uniform(-0.2, 0.2, (2, 200)), np.ones(200)])
    rays = Rays(np.stack([x, y, 0.0 * x - 20.0]), d / np.linalg.norm(d, axis=0), np.zeros(200))
    moves = Moving(poses, (figures, None), (None, None))
    ours = trace_sequence(sequence, rays, moves, NUMPY)
    assert (ours.status == OK).mean() > 0.9
    for device in list_devices():
        theirs = trace_sequence(sequence, rays, moves, device)
        np.testing.assert_array_equal(theirs.status, ours.status)
        for key in ("path", "x", "y", "u", "v"):
            np.testing.assert_allclose(getattr(theirs, key), getattr(ours, key), rtol=0, atol=2e-12)


@pytest.mark.parametrize("device", list_devices(), ids=lambda device: device.kind)
def test_rays_beside_a_cylinder_miss_it(device):
    sequence = Sequence((replace(FORMS["cylinder"], action="reflect"), Element()), 1.0)
    poses = np.array([[[*np.eye(3).ravel(), 0, 0, 10.0], [*np.eye(3).ravel(), 0, 0, 0]]])
    y = np.array([0.0, 24.9, 25.1, 60.0])
    rays = Rays(
        np.stack([200.0 + 0 * y, y, 0 * y - 20.0]), np.tile([[0.0], [0.0], [1.0]], (1, 4)), np.zeros(4)
    )
    status = trace_sequence(sequence, rays, Moving(poses, (None, None), (None, None)), device).status[0]
    assert status[:2].tolist() == [OK, OK]
    assert set(status[2:].tolist()) <= {MISS, DIVERGED}


HEAD = "MODE SEQ\nUNIT {unit}\nENPD 4\nFTYP 0 0 1 1\nXFLN 0\nYFLN 0\nWAVM 1 0.55 1\nPWAV 1\nSURF 0\n"
HEAD += "  DISZ INFINITY\n"
TAIL = "  DISZ 10\n  STOP\n  GLAS N-BK7 0 0 0 0\nSURF 2\n  DISZ 0\n"
TYPES = {
    "TYPE TOROIDAL\n  CURV 0.05\n  PARM 1 30\n  PARM 2 1e-3\n  PARM 3 1e-5": Toroid(
        20.0, 0.0, 30.0, (1e-3, 1e-5)
    ),
    "TYPE TOROIDAL\n  CURV 0.05\n  XDAT 1 0 0 0\n  XDAT 2 100 0 0": Toroid(20.0, 0.0, np.inf),
    "TYPE BICONICX\n  CURV 0.05\n  CONI -1\n  PARM 1 40\n  PARM 2 0.5": Biconic(20.0, -1.0, 40.0, 0.5),
    "TYPE BICONICX\n  CURV 0.05": Biconic(20.0, 0.0, np.inf, 0.0),
    "TYPE ODDASPHE\n  CURV 0.05\n  PARM 1 0.01\n  PARM 3 1e-4": OddAsphere(20.0, 0.0, (0.01, 0.0, 1e-4)),
    "TYPE QED_TYPE\n  CURV 0.05\n  XDAT 1 1\n  XDAT 2 1\n  XDAT 3 15\n  XDAT 4 1": ForbesAsphere(
        20.0, 0.0, (1.0,), 15.0, "con"
    ),
}  # fmt: skip


@pytest.mark.parametrize("text", TYPES)
def test_types_of_lens_files_are_these_shapes_in_any_unit(text):
    found = parse_zmx(HEAD.format(unit="MM") + "SURF 1\n  " + text + "\n" + TAIL, "a.zmx")
    assert found.surfaces[0].shape == TYPES[text]
    inches = parse_zmx(HEAD.format(unit="IN") + "SURF 1\n  " + text + "\n" + TAIL, "a.zmx").surfaces[0].shape
    x, y = RNG.uniform(-4.0, 4.0, (2, 20))
    large = shape_sag(inches, 25.4 * x, 25.4 * y)
    small = shape_sag(TYPES[text], x, y)
    np.testing.assert_allclose(large, [25.4 * small[0], *small[1:]], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("TYPE TOROIDAL\n  PARM 9 1", "parameter 9 of the type TOROIDAL must be 0"),
        ("TYPE TOROIDAL\n  XDAT 1 3 0 0\n  XDAT 2 1 0 0\n  XDAT 4 1e-3 0 0", "extra number 4 .* must be 0"),
        ("TYPE BICONICX\n  PARM 3 1", "parameter 3 of the type BICONICX must be 0"),
        ("TYPE ODDASPHE\n  PARM 1 nan", "'nan' is not a finite number"),
        ("TYPE QED_TYPE\n  XDAT 1 2 0 0\n  XDAT 2 1 0 0\n  XDAT 3 15 0 0", "needs its kind"),
        ("TYPE QED_TYPE\n  XDAT 1 1 0 0\n  XDAT 2 1e9 0 0\n  XDAT 3 15 0 0", "a number of terms up to 100"),
        ("TYPE QED_TYPE\n  XDAT 1 1 0 0\n  XDAT 2 1 0 0\n  XDAT 3 0 0 0", "positive normalization radius"),
    ],
)
def test_numbers_without_a_meaning_are_refused(text, message):
    with pytest.raises(UserError, match=message):
        parse_zmx(HEAD.format(unit="MM") + "SURF 1\n  " + text + "\n" + TAIL, "a.zmx")


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        (Toroid(10.0, 0.0, 0.0), "radius along x of a Toroid is 0.0 mm"),
        (Biconic(10.0, 0.0, np.nan), "along x are nan mm"),
        (OddAsphere(10.0, 0.0, (np.inf,)), "coefficient 0 of a OddAsphere is inf"),
        (ForbesAsphere(10.0, 0.0, (1.0,), 0.0), "normalization radius of a ForbesAsphere is 0.0"),
    ],
)
def test_shapes_that_are_none_are_refused(shape, message):
    with pytest.raises(UserError, match=message):
        shape_sag(shape, 0.0, 0.0)


# A ray through an asphere in front of 5 mm of N-BK7, 40 mm before the image: at 5 degrees, (3.6, -3) mm on
# the stop in the vertex plane. Where it ends and its direction there, by Optiland 0.6.3 (MIT), whose biconic
# is another.
OPTILAND = {
    OddAsphere(40.0, -0.5, (0.0, 1e-4, -2e-5, 3e-7)): (
        1.5828385730813725,
        2.4819964168113726,
        -0.04638089298200057,
        0.12549824541805626,
    ),
    Toroid(50.0, -0.4, 35.0, (1e-4, -2e-6)): (
        1.2790016682562868,
        2.162190299374071,
        -0.05339672649743221,
        0.11820658053055691,
    ),
    ForbesAsphere(40.0, -0.6, (0.3, -0.1, 0.05), 12.0, "bfs"): (
        1.4734714662107817,
        2.573342016959392,
        -0.04889349945139887,
        0.1275497908896856,
    ),
}


@pytest.mark.parametrize("shape", OPTILAND, ids=lambda shape: type(shape).__name__)
def test_a_ray_through_a_lens_ends_where_another_tracer_says(shape):
    rows = (
        SurfaceRow("front", shape, 5.0, "refract", glass("N-BK7")),
        SurfaceRow("back", thickness=40.0, action="refract"),
        SurfaceRow("image"),
    )
    wave = 587.5618e-6
    system = OpticalSystem(
        "lens", sequential(rows), 0, Pupil("entrance_diameter", 12.0), wavelengths=np.array([wave])
    )
    d = np.array([0.0, np.sin(np.deg2rad(5.0)), np.cos(np.deg2rad(5.0))])
    start = np.array([3.6, -3.0, 0.0]) - 20.0 * d
    rays = Rays(start[:, None], d[:, None], np.zeros(1))
    found = trace_sequence(pack(system, wave), rays, moving(system, rest_states(system)), NUMPY)
    ends = [float(one[0, 0]) for one in (found.x, found.y, found.u, found.v)]
    np.testing.assert_allclose(ends, OPTILAND[shape], rtol=0, atol=1e-11)
