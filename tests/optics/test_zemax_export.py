"""Systems written as lens files (.zmx) are read back as they were."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.catalog.names import optical_system, system_names
from wavequake.optics.media.glasses import AIR, constant, glass, glasses
from wavequake.optics.media.gradients import selfoc
from wavequake.optics.rays.aiming import pupil_rays
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.segments.kinematics import cardan
from wavequake.optics.shapes.phases import Diffraction
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.shapes.shapes import (
    Conic,
    EvenAsphere,
    ExtendedPolynomial,
    GridSag,
    Opening,
    ZernikeDeformation,
    ZernikeSag,
)
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface
from wavequake.optics.zemax.export import write_zmx, zmx_text
from wavequake.optics.zemax.read import parse_zmx, read_zmx
from wavequake.optics.zemax.surfaces import ellipse, spider

COOKE = Path(__file__).parents[1] / "data" / "cooke_triplet.zmx"

numbers = st.floats(-10, 10).map(lambda value: round(value, 6))
lengths = st.floats(0.5, 1e5)
radii = st.one_of(st.just(np.inf), lengths, lengths.map(lambda value: -value))
coefficients = st.lists(st.floats(-1e-3, 1e-3), max_size=8).map(tuple)
# A file has as many powers as it has parameters: zeros behind the last one do not come back.
powers = coefficients.filter(lambda found: not found or found[-1] != 0.0)
shapes = st.one_of(
    st.builds(Conic, radii, numbers),
    st.builds(EvenAsphere, radii, numbers, powers),
    st.builds(ExtendedPolynomial, radii, numbers, coefficients, lengths),
    st.builds(ZernikeSag, radii, numbers, coefficients, lengths),
)
openings = st.one_of(
    st.none(),
    st.builds(Opening, outer=st.floats(2, 50)),
    st.builds(Opening, outer=st.floats(2, 50), center=st.tuples(numbers, numbers)),
    st.builds(Opening, outer=st.floats(2, 50), inner=st.floats(0.1, 1)),
    st.builds(Opening, inner=st.floats(0.1, 1)),
    st.tuples(st.floats(0.1, 2), st.integers(1, 6)).map(lambda a: Opening(arms=spider(*a))),
    lengths.map(lambda a: Opening(corners=((-a, -2 * a), (a, -2 * a), (a, 2 * a), (-a, 2 * a)))),
)
media = st.one_of(st.sampled_from(sorted(glasses())).map(glass), st.floats(1.1, 4.0).map(constant))


@st.composite
def systems(draw):
    count = draw(st.integers(1, 5))
    medium = draw(st.one_of(st.just(AIR), media))
    before, z, surfaces = AIR, 0.0, []
    for index in range(count + 1):
        image = index == count
        action = "pass" if image else draw(st.sampled_from(["reflect", "refract", "pass"]))
        before = medium if index == 0 and action == "reflect" else before
        # A file cannot tell a surface between equal media from one that does nothing.
        after = draw(media.filter(lambda one, old=before: one != old)) if action == "refract" else AIR
        before = after if action == "refract" else before
        tilt = draw(st.one_of(st.just((0.0, 0.0, 0.0)), st.tuples(*[st.floats(-1.5, 1.5)] * 3)))
        shift = draw(st.one_of(st.just((0.0, 0.0)), st.tuples(numbers, numbers)))
        surfaces.append(
            Surface(
                f"part {index}",
                draw(shapes),
                np.array([*shift, z]),
                cardan(np.array(tilt)),
                action,
                after,
                draw(openings),
            )
        )
        z += draw(st.floats(-100, 100))
    infinite = draw(st.booleans())
    kinds = ["entrance_diameter", "stop", "f_number"] if infinite else ["stop", "f_number"]
    pairs = st.lists(st.tuples(numbers, numbers), min_size=1, max_size=4)
    waves = draw(st.lists(st.floats(400e-6, 1000e-6), min_size=1, max_size=4))
    return OpticalSystem(
        name="a random system",
        surfaces=tuple(surfaces),
        stop=draw(st.integers(0, count - 1)),
        pupil=Pupil(draw(st.sampled_from(kinds)), draw(st.floats(0.01, 0.9))),
        object_distance=np.inf if infinite else draw(lengths),
        fields=np.array(draw(pairs)) * (0.01 if infinite else 1.0),
        wavelengths=np.array(waves),
        primary_wavelength=draw(st.integers(0, len(waves) - 1)),
        medium=medium if surfaces[0].action == "reflect" else AIR,
    )


def same_shape(one, other):
    """Radii pass through curvatures, which costs the last bit; all other numbers come back as they are."""
    close = one.radius == other.radius or abs(one.radius / other.radius - 1) < 1e-15
    return close and replace(one, radius=1.0) == replace(other, radius=1.0)


@settings(max_examples=60, deadline=None)
@given(systems())
def test_what_is_written_is_read_back(system):
    again = parse_zmx(zmx_text(system), "lens.zmx")
    for ours, theirs in zip(system.surfaces, again.surfaces, strict=True):
        assert same_shape(ours.shape, theirs.shape)
        np.testing.assert_allclose(theirs.position, ours.position, rtol=1e-12, atol=1e-11)
        np.testing.assert_allclose(theirs.rotation, ours.rotation, rtol=0, atol=1e-14)
        # The opening of the stop loses nothing to the beam's radius.
        for name in ("name", "action", "medium", "opening", "deformation"):
            assert getattr(theirs, name) == getattr(ours, name)
    np.testing.assert_allclose(again.fields, system.fields, rtol=1e-15)
    np.testing.assert_array_equal(again.wavelengths, system.wavelengths)
    for name in ("name", "stop", "pupil", "object_distance", "primary_wavelength", "telecentric", "medium"):
        assert getattr(again, name) == getattr(system, name)


def test_a_written_file_is_read_back(tmp_path):
    path = write_zmx(read_zmx(COOKE), tmp_path / "copy.zmx")
    assert path.read_bytes()[:2] in (b"\xff\xfe", b"\xfe\xff")
    assert zmx_text(read_zmx(path)) == zmx_text(read_zmx(COOKE))
    assert [entry.name for entry in tmp_path.iterdir()] == ["copy.zmx"]
    with pytest.raises(UserError, match="cannot be written"):
        write_zmx(read_zmx(COOKE), tmp_path / "missing" / "copy.zmx")


def simple(**changes):
    first = replace(Surface("first", Conic(100.0)), **changes)
    return OpticalSystem("simple", (first, Surface("image")), 0, Pupil("entrance_diameter", 10.0))


def test_annular_zernike_sag_is_written_by_circular_polynomials():
    """They span the same polynomials, so the surface is the same everywhere, also inside of the hole."""
    rng = np.random.default_rng(3)
    shape = ZernikeSag(-300.0, -1.2, tuple(rng.normal(0, 1e-3, 45)), 20.0, 0.4)
    again = parse_zmx(zmx_text(simple(shape=shape)), "lens.zmx").surfaces[0].shape
    assert (again.obscuration, again.pupil_radius, again.conic) == (0.0, 20.0, -1.2)
    x, y = rng.uniform(-14, 14, (2, 200))
    np.testing.assert_allclose(shape_sag(again, x, y), shape_sag(shape, x, y), rtol=0, atol=1e-13)
    empty = ZernikeSag(np.inf, 0.0, (), 20.0, 0.4)
    assert parse_zmx(zmx_text(simple(shape=empty)), "lens.zmx").surfaces[0].shape.coefficients == ()


@settings(max_examples=30)
@given(
    st.integers(1, 231),
    st.floats(0.05, 0.68),
    st.integers(0, 99),
    st.sampled_from([-900.0, np.inf]),
    st.data(),
)
def test_annular_sags_are_the_same_surface_after_a_round_trip(terms, obscuration, seed, radius, data):
    """Sag and slopes over the glass, to what the size of the circular coefficients leaves of 16 digits."""
    coefficients = np.random.default_rng(seed).normal(0, 1e-4, terms)
    shape = ZernikeSag(radius, -0.7, tuple(coefficients.tolist()), 20.0, obscuration)
    text = zmx_text(simple(shape=shape))
    assert "NOTE 0 Annular Zernike polynomials of first are written as the equal sums of circular" in text
    again = parse_zmx(text, "lens.zmx").surfaces[0].shape
    assert again.obscuration == 0.0
    rho = 20.0 * np.linspace(obscuration, 1.0, 12)
    theta = data.draw(st.floats(0, 6)) + np.arange(12.0)
    before, after = (shape_sag(one, rho * np.cos(theta), rho * np.sin(theta)) for one in (shape, again))
    size = np.abs(again.coefficients).sum()
    np.testing.assert_allclose(after[0], before[0], rtol=0, atol=1e-13 * size + 1e-14)
    np.testing.assert_allclose(after[1:], before[1:], rtol=0, atol=1e-12 * size + 1e-14)


@pytest.mark.parametrize(("obscuration", "loss"), [(0.4, 4e-14), (0.5, 3e-13), (0.6, 7e-12), (0.7, 2e-10)])
def test_stated_loss_of_annular_sags_written_as_circular_ones(obscuration, loss):
    rho, theta = np.repeat(20.0 * np.linspace(obscuration, 1.0, 9), 20), np.tile(np.arange(20.0), 9)
    x, y = rho * np.cos(theta), rho * np.sin(theta)
    losses = []
    for seed in range(15):
        coefficients = np.random.default_rng(seed).normal(0, 1e-4, 231)
        shape = ZernikeSag(np.inf, 0.0, tuple(coefficients.tolist()), 20.0, obscuration)
        again = parse_zmx(zmx_text(simple(shape=shape)), "lens.zmx").surfaces[0].shape
        before, after = (shape_sag(one, x, y)[0] for one in (shape, again))
        losses.append(np.abs(after - before).max() / np.abs(before).max())
    assert np.median(losses) < 2.0 * loss


def test_rings_too_narrow_for_circular_polynomials_are_refused():
    ones = tuple([1e-4] * 153)
    with pytest.raises(
        UserError, match=r"first of simple .* 153 terms over .* of obscuration 0.9: .* rounding"
    ):
        zmx_text(simple(shape=ZernikeSag(-900.0, 0.0, ones, 20.0, 0.9)))
    assert "NOTE" not in zmx_text(simple(shape=ZernikeSag(-900.0, 0.0, ones, 20.0)))


@pytest.mark.parametrize(
    ("system", "match"),
    [
        (
            simple(shape=GridSag(np.inf, 0.0, np.zeros((4, 7)), 1.0, 1.0)),
            "grid of first of simple has 4 rows and 7 columns; a lens file holds 5",
        ),
        (simple(shape=EvenAsphere(np.inf, 0.0, (0.0,) * 9)), "more than 8 terms"),
        (
            simple(shape=ZernikeSag(np.inf, 0.0, (0.0,) * 232, 9.0)),
            "sag of 232 terms; .* more than 231 terms",
        ),
        (simple(shape=ExtendedPolynomial(np.inf, 0.0, (0.0,) * 231)), "231 terms; .* more than 230 terms"),
        (simple(deformation=ZernikeDeformation(5, 10.0)), "a deformation"),
        (simple(opening=Opening(outer=5.0, arms=((0.3, 0.1),))), "no spider of equal ones"),
        (simple(opening=Opening(arms=((0.0, 0.1), (np.pi, 0.2)))), "no spider of equal ones"),
        (simple(opening=Opening(corners=((0.0, 0.0), (2.0, 0.0), (0.5, 0.5), (0.0, 2.0)))), "with a dent"),
        (
            simple(
                shape=GridSag(np.inf, 0.0, np.zeros((5, 5)), 1.0, 1.0),
                opening=Opening(corners=((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))),
            ),
            "a GridSag with an opening",
        ),
        (simple(name="two\nlines"), "one line"),
        (simple(shape=Conic(np.nan)), "finite numbers only"),
        (replace(simple(), fields=np.zeros((13, 2))), "13 fields"),
    ],
)
def test_what_the_format_cannot_hold_is_refused_by_name(system, match):
    with pytest.raises(UserError, match=match):
        zmx_text(system)


@pytest.mark.parametrize(
    "shape",
    [
        ZernikeSag(-90.0, 0.0, tuple(1e-9 * np.arange(231.0)), 20.0),
        ZernikeSag(-90.0, 0.0, tuple(1e-9 * np.arange(231.0)), 20.0, 0.3),
        ExtendedPolynomial(-90.0, 0.0, tuple(1e-9 * np.arange(230.0)), 20.0),
    ],
)
def test_the_longest_lists_of_coefficients_come_back_and_longer_ones_are_refused(shape):
    text = zmx_text(simple(shape=shape))
    again = parse_zmx(text, "lens.zmx").surfaces[0].shape
    count = len(shape.coefficients)
    assert len(again.coefficients) == count
    x, y = np.random.default_rng(4).uniform(-14, 14, (2, 50))
    np.testing.assert_allclose(shape_sag(again, x, y), shape_sag(shape, x, y), rtol=0, atol=1e-12)
    longer = text.replace(f"XDAT 1 {count}.0 ", f"XDAT 1 {count + 1}.0 ")
    with pytest.raises(UserError, match=f"has {count + 1} terms; .* at most {count}"):
        parse_zmx(longer, "lens.zmx")


@pytest.mark.parametrize("name", sorted({*system_names()} - {"hsc"}))
def test_every_bundled_system_comes_back_with_its_light(name):
    """The same rays take the same ways through what is written and read, and first-order data are equal."""
    system = optical_system(name)
    again = parse_zmx(zmx_text(system), "lens.zmx")
    for ours, theirs in zip(system.surfaces, again.surfaces, strict=True):
        assert same_shape(ours.shape, theirs.shape)
        assert (theirs.name, theirs.action, theirs.medium) == (ours.name, ours.action, ours.medium)
    mine, other = vars(paraxial(system)), vars(paraxial(again))
    assert other == pytest.approx(mine, rel=1e-9, abs=1e-9)
    shift = np.array([[0.0], [0.0], [system.surfaces[0].position[2]]])
    points = sunflower(system.pupil.obscuration, 1.0, 40)
    for wavelength in system.wavelengths:
        for field in system.fields:
            rays = pupil_rays(system, field, wavelength, points.x, points.y)
            moved = replace(rays, position=rays.position - shift)
            truth, found = (
                trace_sequence_numpy(pack(one, wavelength), light, moving(one, rest_states(one)))
                for one, light in ((system, rays), (again, moved))
            )
            np.testing.assert_array_equal(found.status, truth.status)
            for key in ("x", "y", "path"):
                np.testing.assert_allclose(getattr(found, key), getattr(truth, key), rtol=1e-13, atol=1e-9)


def polygon(count, turn):
    """Return the corners of a regular polygon."""
    angles = turn + 2.0 * np.pi * np.arange(count) / count
    return tuple(zip((6.0 * np.cos(angles)).tolist(), (6.0 * np.sin(angles)).tolist(), strict=True))


RECTANGLE = ((6.0, -5.0), (6.0, 5.0), (-6.0, 5.0), (-6.0, -5.0))


@pytest.mark.parametrize(
    "opening",
    [
        Opening(6.0, 2.0, arms=spider(0.7, 3)),
        Opening(inner=2.0, corners=RECTANGLE),
        Opening(inner=2.0, corners=RECTANGLE, arms=spider(0.5, 4)),
        Opening(corners=RECTANGLE),
        Opening(6.0, 2.0, arms=spider(0.7, 3), center=(1.0, -2.0)),
        Opening(inner=2.0, corners=RECTANGLE, center=(1.0, -2.0)),
        Opening(corners=((-1.0, -4.0), (6.0, 1.0), (-3.0, 5.0))),
        Opening(corners=polygon(6, 0.3), center=(0.4, -1.1)),
        Opening(inner=1.0, corners=polygon(5, 0.1), arms=spider(0.5, 3)),
        Opening(corners=ellipse(6.0, 3.5), center=(1.0, -0.5)),
    ],
)
@pytest.mark.parametrize(
    "shape",
    [
        EvenAsphere(-90.0, -0.5, (1e-4, 1e-6)),
        ZernikeSag(-90.0, -0.5, (0.0, 0.0, 1e-4, 0.0, 3e-3, -2e-3, 0.0, 0.0, 2e-3, 0.0, 1e-3), 12.0),
    ],
    ids=["asphere", "zernike"],
)
def test_several_apertures_of_a_surface_stand_on_equal_ones_before_it(opening, shape):
    """A turned mirror behind a lens: the same rays arrive, on the same ways."""
    glass_plate = Surface("plate", position=np.array([0.0, 0.0, -9.0]), action="refract", medium=glass("F2"))
    turn = cardan(np.array([0.2, -0.1, 0.3]))
    mirror = Surface(
        "mirror",
        shape,
        np.array([0.3, 0.1, 0.0]),
        turn,
        "reflect",
        opening=opening,
    )
    image = Surface("image", position=np.array([0.0, 0.0, -4.0]))
    system = OpticalSystem("ring", (glass_plate, mirror, image), 1, Pupil("entrance_diameter", 20.0))
    again = parse_zmx(zmx_text(system), "lens.zmx")
    assert again.stop == len(again.surfaces) - 2
    assert again.surfaces[again.stop].name == "mirror"
    x, y = np.random.default_rng(8).uniform(-8, 8, (2, 500))
    rays = Rays(np.stack([x, y, 0 * x - 20]), np.array([[0.0], [0.0], [1.0]]) * np.ones(500), np.zeros(500))
    moved = replace(rays, position=rays.position + np.array([[0.0], [0.0], [9.0]]))
    truth, found = (
        trace_sequence_numpy(pack(one, 550e-6), light, moving(one, rest_states(one)))
        for one, light in ((system, rays), (again, moved))
    )
    assert 50 < np.count_nonzero(truth.status) < 450
    np.testing.assert_array_equal(found.status, truth.status)
    for key in ("x", "y", "path"):
        np.testing.assert_allclose(getattr(found, key), getattr(truth, key), rtol=1e-12, atol=1e-10)


def test_a_grating_with_several_apertures_diffracts_once():
    grooves = Diffraction(1.0, 50.0)
    opening = Opening(corners=polygon(6, 0.3))
    again = parse_zmx(zmx_text(simple(action="reflect", phase=grooves, opening=opening)), "lens.zmx")
    *others, mirror, _ = again.surfaces
    assert len(others) == 3
    assert [one.phase for one in others] == [None] * 3
    assert mirror.phase == grooves


def test_vignetting_factors_come_back():
    factors = ((0.0, 0.1, 0.2, 0.3, 0.25), (0.0, 0.0, 0.0, 0.0, 0.0))
    system = replace(simple(), fields=np.array([[0.0, 0.0], [0.0, 0.1]]), vignetting=factors)
    np.testing.assert_allclose(parse_zmx(zmx_text(system), "lens.zmx").vignetting, factors, rtol=1e-15)


def test_several_apertures_behind_a_gradient_are_refused():
    inside = simple(action="refract", medium=selfoc(1.6, 0.01))
    rear = Surface(
        "rear", position=np.array([0, 0, 5.0]), action="refract", opening=Opening(5.0, arms=spider(0.1, 2))
    )
    image = Surface("image", position=np.array([0, 0, 9.0]))
    with pytest.raises(UserError, match="rear has several apertures and SELFOC before it"):
        zmx_text(replace(inside, surfaces=(inside.surfaces[0], rear, image)))


def test_an_obscured_pupil_is_a_dark_center_of_the_stop():
    again = parse_zmx(zmx_text(replace(simple(), pupil=Pupil("stop", 5.0, 0.2))), "lens.zmx")
    assert again.surfaces[0].opening == Opening(inner=1.0)
    beside = replace(simple(opening=Opening(outer=6.0, center=(1.0, 0.0))), pupil=Pupil("stop", 5.0, 0.2))
    dark, last = parse_zmx(zmx_text(beside), "lens.zmx").surfaces[:2]
    assert (dark.opening, last.opening) == (Opening(inner=1.0), Opening(outer=6.0, center=(1.0, 0.0)))
    ring = simple(opening=Opening(outer=6.0, inner=2.0))
    again = parse_zmx(zmx_text(replace(ring, pupil=Pupil("stop", 5.0, 0.2))), "lens.zmx")
    assert again.surfaces[0].opening == Opening(outer=6.0, inner=2.0)


def test_an_aperture_in_the_image_is_its_f_number():
    lens = simple(action="refract", medium=glass("N-BK7"))
    lens = replace(lens, pupil=Pupil("image_na", 0.2), object_distance=500.0)
    assert parse_zmx(zmx_text(lens), "lens.zmx").pupil == Pupil("f_number", 2.5)
