from dataclasses import replace
from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.optics.media.glasses import Medium, constant
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.shapes.forms.toroid import Toroid
from wavequake.optics.shapes.shapes import Conic, EvenAsphere, GridDeformation, ZernikeDeformation
from wavequake.optics.systems.kinematics import Break, SurfaceRow, rest_states, sequential
from wavequake.optics.systems.paraxial import entrance_pupil_center, paraxial
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface
from wavequake.optics.wavefronts.wavefront import measure_system, prepare_system

GLASS = Medium("glass", "constant", (1.5,))
WATER = Medium("water", "constant", (1.33,))


def lens(r1, r2, thickness, to_image, stop=0, pupil=None, rows=(), after=(), **options):
    surfaces = sequential(
        [
            *rows,
            SurfaceRow("front", Conic(r1), thickness, "refract", GLASS),
            SurfaceRow("back", Conic(r2), to_image, "refract"),
            *after,
            SurfaceRow("image"),
        ]
    )
    return OpticalSystem("lens", surfaces, stop, pupil or Pupil("entrance_diameter", 10.0), **options)


radii = st.floats(30.0, 300.0).flatmap(lambda r: st.sampled_from([r, -r]))


@settings(deadline=None)
@given(radii, radii, st.floats(0.1, 20.0))
def test_thick_lens_is_the_lensmaker_s(r1, r2, thickness):
    n = 1.5
    power = (n - 1) * (1 / r1 - 1 / r2 + (n - 1) * thickness / (n * r1 * r2))
    if abs(power) < 1e-4:
        return
    data = paraxial(lens(r1, r2, thickness, 100.0))
    assert data.focal_length == pytest.approx(1 / power, rel=1e-12)
    assert data.back_focus == pytest.approx((1 - (n - 1) * thickness / (n * r1)) / power, rel=1e-9)
    assert data.front_focus == pytest.approx(-(1 + (n - 1) * thickness / (n * r2)) / power, rel=1e-9)
    assert data.front_principal == pytest.approx(-(n - 1) * thickness / (n * r2) / power, rel=1e-9, abs=1e-9)
    assert data.rear_principal == pytest.approx(-(n - 1) * thickness / (n * r1) / power, rel=1e-9, abs=1e-9)


@settings(deadline=None)
@given(st.floats(20.0, 500.0).filter(lambda d: abs(d - 100.0) > 1.0))
def test_thin_lens_images_by_equation_3_35(distance):
    data = paraxial(lens(100.0, -100.0, 0.0, 100.0, object_distance=distance))
    image = 1 / (1 / 100.0 - 1 / distance)
    assert data.focal_length == pytest.approx(100.0)
    assert data.image_distance == pytest.approx(image, rel=1e-12)
    assert data.magnification == pytest.approx(-image / distance, rel=1e-12)
    assert data.defocus == pytest.approx(100.0 - image, rel=1e-9, abs=1e-9)


@settings(deadline=None)
@given(
    st.floats(500.0, 5000.0),
    st.floats(0.5, 0.95),
    st.floats(1.5, 8.0).filter(lambda m: abs(m - 1) > 0.1),
)
def test_cassegrain_pairs_have_the_focal_length_of_the_mirror_formula(f1, share, magnification):
    # The secondary stands at `share` of the primary's focal length and magnifies the rest.
    gap, rest = share * f1, (1 - share) * f1
    f2 = 1 / (1 / rest - 1 / (rest * magnification))
    rows = [
        SurfaceRow("M1", Conic(-2 * f1), -gap, "reflect"),
        SurfaceRow("M2", Conic(-2 * f2), gap + 100.0, "reflect"),
        SurfaceRow("image"),
    ]
    system = OpticalSystem("pair", sequential(rows), 0, Pupil("f_number", 12.0))
    data = paraxial(system)
    assert data.focal_length == pytest.approx(f1 * magnification, rel=1e-9)
    assert data.back_focus == pytest.approx(rest * magnification, rel=1e-9)
    assert data.entrance_pupil_diameter == pytest.approx(f1 * magnification / 12.0, rel=1e-9)
    assert data.entrance_pupil == 0.0
    # The exit pupil is the image of M1 by M2, as of an object at the distance `gap`.
    virtual = 1 / (-1 / f2 - 1 / gap)
    assert data.exit_pupil == pytest.approx(virtual - (gap + 100.0), rel=1e-9)


def test_immersion_keeps_the_lagrange_invariant():
    surfaces = sequential([SurfaceRow("ball", Conic(50.0), 150.0, "refract", WATER), SurfaceRow("image")])
    system = OpticalSystem(
        "eye", surfaces, 0, Pupil("stop", 5.0), object_distance=400.0, fields=np.array([[0.0, 2.0]])
    )
    data = paraxial(system)
    # n'/s' = n/s + (n' - n)/R with s = -400
    assert data.image_distance == pytest.approx(1.33 / (-1 / 400.0 + 0.33 / 50.0))
    height = 2.0 * data.magnification
    reduced_slope = 1.33 * 5.0 / data.image_distance
    assert abs(data.lagrange) == pytest.approx(abs(height) * reduced_slope)
    assert data.focal_length == pytest.approx(50.0 / 0.33)
    assert data.back_focus == pytest.approx(1.33 * 50.0 / 0.33)


@pytest.mark.parametrize("height", [20.0, 95.3, 190.6])
def test_an_off_axis_paraboloid_has_the_focal_length_of_its_place(height):
    """f + h^2 / (4 f), and the image of a star in the parent's focus, without aberration."""
    parent = 95.3
    turn = np.arctan2(height, parent - height**2 / (4.0 * parent))
    rows = [
        SurfaceRow("stop", thickness=200.0),
        Break(decenter=(0.0, -height, 0.0)),
        SurfaceRow("M", Conic(-2.0 * parent, -1.0), -parent, "reflect"),
        Break(tilt=(float(turn), 0.0, 0.0)),
        SurfaceRow("image"),
    ]
    system = OpticalSystem("off axis", sequential(rows), 0, Pupil("entrance_diameter", 20.0))
    data = paraxial(system)
    assert data.focal_length == pytest.approx(parent + height**2 / (4.0 * parent), rel=1e-10)
    assert data.defocus == pytest.approx(0.0, abs=1e-8)
    rays = sunflower(0.0, 1.0, 200)
    prepared = prepare_system(system, rays.x, rays.y, rays.weight, 11)
    found = measure_system(prepared, rest_states(system), NUMPY)
    assert found.rms[0] < 1e-8
    np.testing.assert_allclose(found.chief[0], 0.0, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("shape", "action"),
    [
        (Conic(60.0), "refract"),
        (Conic(-60.0, 2.0), "refract"),
        (EvenAsphere(-80.0, 0.5, (0.0, 1e-7)), "reflect"),
        (Toroid(70.0, 0.0, 50.0), "refract"),
        (Toroid(-70.0, 0.0, np.inf), "reflect"),
    ],
)
def test_beside_the_vertex_powers_are_those_of_neighboring_rays(shape, action):
    """The mean of what rays beside the axis ray bend by, in the plane of incidence and across it."""
    rows = [
        SurfaceRow("stop", thickness=30.0),
        Break(decenter=(4.0, -12.0, 0.0)),
        SurfaceRow("off", shape, 10.0 if action == "refract" else -10.0, action, constant(1.5)),
        SurfaceRow("image"),
    ]
    system = OpticalSystem("off axis", sequential(rows), 0, Pupil("entrance_diameter", 1.0))
    sequence, rest = pack(system, 550e-6), moving(system, rest_states(system))
    h = 1e-3
    azimuth = np.arange(0.0, 2.0 * np.pi, np.pi / 2.0)
    x, y = h * np.cos(azimuth), h * np.sin(azimuth)
    rays = Rays(np.stack([x, y, 0.0 * x]), np.tile([[0.0], [0.0], [1.0]], (1, 4)), np.zeros(4))
    found = trace_sequence(sequence, rays, rest, NUMPY)
    w = found.w_sign[0] * np.sqrt(1.0 - found.u[0] ** 2 - found.v[0] ** 2)
    d = np.stack([found.u[0], found.v[0], w])
    middle = d.mean(axis=1) / np.linalg.norm(d.mean(axis=1))
    across = np.cross([0.0, 0.0, 1.0], middle)
    across /= np.linalg.norm(across)
    sense = 1.0 if action == "refract" else -1.0  # a mirror turns the plane of incidence over
    before, behind = np.cross(across, [0.0, 0.0, 1.0]), np.cross(across, sense * middle)
    bends = np.array([d[:, 0] - d[:, 2], d[:, 1] - d[:, 3]]) / (2.0 * h)  # by x, by y
    powers = [-before[:2] @ bends @ behind, -across[:2] @ bends @ across]
    index = 1.5 if action == "refract" else 1.0
    assert paraxial(system).focal_length == pytest.approx(1.0 / (index * np.mean(powers)), rel=1e-6)


def test_folds_do_not_matter():
    def rows(fold):
        turn = [Break(tilt=(fold, 0.0, 0.0))]
        return [
            SurfaceRow("M1", Conic(-2000.0), -600.0, "reflect"),
            *turn,
            SurfaceRow("flat", action="reflect"),
            *turn,
            Break(thickness=400.0),
            SurfaceRow("image"),
        ]

    straight, folded = (
        paraxial(OpticalSystem("x", sequential(rows(angle)), 0, Pupil("entrance_diameter", 100.0)))
        for angle in (0.0, 0.6)
    )
    assert folded.focal_length == pytest.approx(1000.0)
    for field in ("back_focus", "defocus", "exit_pupil", "image_na", "rear_principal"):
        assert getattr(folded, field) == pytest.approx(getattr(straight, field), abs=1e-9)


def test_even_asphere_counts_its_quadratic_term():
    surfaces = (
        Surface("M1", EvenAsphere(inf, 0.0, (-1 / 2000.0, 1e-12)), action="reflect"),
        Surface("image", position=np.array([0.0, 0.0, -500.0])),
    )
    data = paraxial(OpticalSystem("x", surfaces, 0, Pupil("entrance_diameter", 10.0)))
    assert data.focal_length == pytest.approx(500.0)
    assert data.defocus == pytest.approx(0.0, abs=1e-9)


def test_afocal_system_has_infinite_data_and_refuses_an_f_number():
    rows = [
        SurfaceRow("a", Conic(-2000.0), -1500.0, "reflect"),
        SurfaceRow("b", Conic(1000.0), 500.0, "reflect"),
        SurfaceRow("image"),
    ]
    data = paraxial(OpticalSystem("mersenne", sequential(rows), 0, Pupil("entrance_diameter", 10.0)))
    assert data.focal_length == inf
    assert data.image_distance in (inf, -inf)
    assert data.image_na == pytest.approx(0.0, abs=1e-15)
    with pytest.raises(UserError, match="afocal"):
        paraxial(OpticalSystem("mersenne", sequential(rows), 0, Pupil("f_number", 10.0)))


@pytest.mark.parametrize(("kind", "value"), [("f_number", 4.0), ("image_na", 0.125), ("object_na", 0.25)])
def test_a_relay_of_two_lenses_is_afocal_and_has_an_f_number(kind, value):
    # The object in the front focus of one thin lens, the stop and the image in the rear foci: magnification
    # -f2 / f1, both pupils at infinity, and the stop's radius is f1 times the NA in the object.
    rows = [
        SurfaceRow("a", Conic(50.0), 0.0, "refract", GLASS),
        SurfaceRow("b", Conic(-50.0), 50.0, "refract"),
        SurfaceRow("stop", thickness=100.0),
        SurfaceRow("c", Conic(100.0), 0.0, "refract", GLASS),
        SurfaceRow("d", Conic(-100.0), 100.0, "refract"),
        SurfaceRow("image"),
    ]
    system = OpticalSystem("4f", sequential(rows), 2, Pupil(kind, value), object_distance=50.0)
    data = paraxial(system)
    assert data.focal_length == inf
    assert data.magnification == pytest.approx(-2.0, rel=1e-12)
    assert (data.object_na, data.image_na) == pytest.approx((0.25, 0.125), rel=1e-12)
    assert data.f_number == pytest.approx(4.0, rel=1e-12)
    assert data.stop_radius == pytest.approx(12.5, rel=1e-12)


def test_small_misalignment_does_not_count():
    aligned = lens(80.0, -120.0, 5.0, 90.0)
    front = replace(aligned.surfaces[0], position=np.array([0.5, -0.3, 0.0]))
    decentered = replace(aligned, surfaces=(front, *aligned.surfaces[1:]))
    assert paraxial(decentered) == paraxial(aligned)


def test_entrance_pupil_follows_a_decentered_stop():
    rows = [
        Break((700.0, 0.0, 0.0)),
        SurfaceRow("stop"),
        Break((-700.0, 0.0, 100.0)),
        SurfaceRow("M1", Conic(-2000.0, -1.0), -1000.0, "reflect"),
        SurfaceRow("image"),
    ]
    system = OpticalSystem("off axis", sequential(rows), 0, Pupil("entrance_diameter", 500.0))
    np.testing.assert_allclose(entrance_pupil_center(system), [700.0, 0.0, 0.0], rtol=0, atol=1e-12)


def test_an_off_axis_mirror_stands_beside_the_axis_or_about_its_parent_s():
    stop, mirror = SurfaceRow("stop"), SurfaceRow("M1", Conic(-2000.0, -1.0), -1000.0, "reflect")
    pupil = Pupil("entrance_diameter", 100.0)
    beside = [stop, Break((0.0, -191.0, 900.0)), mirror, Break((0.0, 191.0, 0.0)), SurfaceRow("image")]
    one = OpticalSystem("x", sequential(beside), 0, pupil)
    assert paraxial(one).focal_length == pytest.approx(1000.0 + 191.0**2 / 4000.0)  # of its place
    about = [Break((0.0, 191.0, 0.0)), stop, Break((0.0, -191.0, 900.0)), mirror, SurfaceRow("image")]
    system = OpticalSystem("x", sequential(about), 0, pupil)
    assert paraxial(system).focal_length == pytest.approx(1000.0)
    rays = sunflower(0.0, 1.0, 60)
    prepared = prepare_system(system, rays.x, rays.y, rays.weight, terms=10)
    # Parallel light fills the disk about (0, 191), and all of it meets in the focus.
    about_stop = prepared.rays.position[:2].T - [0.0, 191.0]
    np.testing.assert_allclose(about_stop, 50.0 * np.stack([rays.x, rays.y], axis=1), rtol=0, atol=1e-6)
    at_rest = measure_system(prepared, rest_states(system), NUMPY)
    same = measure_system(prepare_system(one, rays.x, rays.y, rays.weight, 10), rest_states(one), NUMPY)
    assert same.rms_raw[0] < 1e-8
    assert same.spot_rms[0] < 1e-9
    np.testing.assert_allclose(at_rest.chief, 0.0, rtol=0, atol=1e-9)
    assert at_rest.spot_rms[0] < 1e-9
    assert at_rest.rms_raw[0] < 1e-8


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stop": 7}, "stop of x is surface 7"),
        ({"pupil": Pupil("entrance_diameter", np.nan)}, "must be positive"),
        ({"pupil": Pupil("entrance_diameter", 1.0, 1.0)}, "obscured"),
        ({"pupil": Pupil("image_na", 1.2)}, "less than the index"),
        ({"pupil": Pupil("object_na", 0.2)}, "object of x is at infinity"),
        ({"pupil": Pupil("area", 0.2)}, "'area', which is unknown"),
        ({"primary_wavelength": 3}, "primary wavelength"),
        ({"wavelengths": np.array([np.nan])}, "wavelengths"),
        ({"fields": np.array([[np.inf, 0.0]])}, "fields"),
        ({"object_distance": np.nan}, "object distance"),
        ({"surfaces": ()}, "no surfaces"),
        ({"surfaces": (Surface("bad", action="reflect"),)}, "last surface"),
        ({"surfaces": (Surface("bad", Conic(np.nan)), Surface("image"))}, "surface bad of x"),
        ({"surfaces": (Surface("bad", position=np.array([0, 0, np.nan])), Surface("image"))}, "position"),
        ({"surfaces": (Surface("bad", rotation=2 * np.eye(3)), Surface("image"))}, "rotation"),
        (
            {"surfaces": (Surface("bad", deformation=ZernikeDeformation(0, 1.0)), Surface("image"))},
            "0 Zernike",
        ),
        ({"surfaces": (Surface("bad", deformation=ZernikeDeformation(3, 0.0)), Surface("image"))}, "radius"),
        (
            {"surfaces": (Surface("bad", deformation=ZernikeDeformation(3, 1.0, 1.0)), Surface("image"))},
            "annulus",
        ),
        (
            {"surfaces": (Surface("bad", deformation=GridDeformation(3, 9, 1.0, 1.0)), Surface("image"))},
            "3 rows",
        ),
        ({"surfaces": (Surface("bad", action="absorb"), Surface("image"))}, "absorb"),
        (
            {
                "surfaces": (
                    Surface("M", Conic(-9.0), np.array([10.0, 0, 0]), action="reflect"),
                    Surface("image"),
                )
            },
            "misses the vertex of M by 10 mm, and the surface",
        ),
        (
            {
                "surfaces": (
                    Surface("M", rotation=np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), action="reflect"),
                    Surface("image"),
                )
            },
            "runs along the surface M",
        ),
        ({"wavelengths": np.array([1e300])}, "positive numbers in mm, from 1e-09 to 1e.12"),
        ({"wavelengths": np.array([1e-300])}, "positive numbers in mm, from 1e-09 to 1e.12"),
    ],
)
def test_bad_systems_are_refused(change, message):
    surfaces = (
        Surface("M1", Conic(-100.0), action="reflect"),
        Surface("image", position=np.array([0, 0, -50.0])),
    )
    options = {"name": "x", "surfaces": surfaces, "stop": 0, "pupil": Pupil("entrance_diameter", 10.0)}
    with pytest.raises(UserError, match=message):
        paraxial(OpticalSystem(**{**options, **change}))


def test_a_ball_in_water_has_both_principal_planes_in_its_center():
    ball = (
        Surface("front", Conic(10.0), action="refract", medium=constant(1.5)),
        Surface("back", Conic(-10.0), np.array([0.0, 0.0, 20.0]), action="refract", medium=constant(1.33)),
        Surface("image", position=np.array([0.0, 0.0, 100.0])),
    )
    data = paraxial(OpticalSystem("ball", ball, 0, Pupil("entrance_diameter", 1.0), medium=constant(1.33)))
    assert [data.front_principal, data.rear_principal] == pytest.approx([10.0, -10.0], rel=1e-12)
    # n R / (2 (n - 1)) with n = 1.5 / 1.33, from the center; reduced by the index of water.
    ratio = 1.5 / 1.33
    assert data.back_focus + 10.0 == pytest.approx(ratio * 10.0 / (2 * (ratio - 1)), rel=1e-12)
    assert data.front_focus - 10.0 == pytest.approx(-ratio * 10.0 / (2 * (ratio - 1)), rel=1e-12)


def test_an_exit_pupil_in_glass_is_the_image_of_the_stop():
    """n'/s' = n/s + (n' - n)/R with s = -30, R = 50, n' = 1.5: s' = -450/7, seen from the focus at 150."""
    surfaces = (
        Surface("stop", position=np.array([0.0, 0.0, -30.0])),
        Surface("front", Conic(50.0), action="refract", medium=constant(1.5)),
        Surface("image", position=np.array([0.0, 0.0, 150.0])),
    )
    data = paraxial(OpticalSystem("immersed", surfaces, 0, Pupil("entrance_diameter", 6.0)))
    assert data.exit_pupil == pytest.approx(-450.0 / 7.0 - 150.0, rel=1e-12)
    assert data.exit_pupil_diameter == pytest.approx(6.0 * (450.0 / 7.0) / 30.0 / 1.5, rel=1e-12)
    assert data.image_na == pytest.approx(1.5 * 3.0 / 150.0, rel=1e-12)
