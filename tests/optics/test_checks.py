"""What users plausibly give wrongly in Python: text for numbers, lists for arrays, names for systems."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import wavequake as wq
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, choose_device
from wavequake.optics.catalog.names import optical_system, system_names
from wavequake.optics.checks import alike, all_within, array, number, require_fields, whole
from wavequake.optics.derivatives.sensitivity import figure_sensitivity
from wavequake.optics.media.glasses import Medium, constant, glass, refractive_index
from wavequake.optics.media.gradients import axial, luneburg, selfoc
from wavequake.optics.polynomials.indices import nm_to_noll
from wavequake.optics.polynomials.transforms import expansion_matrix, transform_coefficients
from wavequake.optics.polynomials.zernike import annular_zernike, annular_zernike_gradient, noll_to_nm
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.shapes.shapes import (
    Conic,
    EvenAsphere,
    ExtendedPolynomial,
    GridDeformation,
    GridSag,
    Opening,
    ZernikeDeformation,
    ZernikeSag,
)
from wavequake.optics.systems.bodies import rigid_body
from wavequake.optics.systems.kinematics import SurfaceRow, rest_states, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil, Surface
from wavequake.optics.wavefronts.wavefront import measure_system, prepare_system

GREGORIAN = optical_system("gregorian")
PUPIL = sunflower(0.0, 1.0, 60)
RAYS = (PUPIL.x, PUPIL.y, PUPIL.weight)
MIRROR = {"shape": Conic(-1000.0, -1.0), "action": "reflect"}


def mirror(**changes):
    surface = Surface(**{"name": "M1", **MIRROR, **changes})
    image = Surface("image", position=np.array([0.0, 0.0, -500.0]))
    return OpticalSystem("one", (surface, image), 0, Pupil("entrance_diameter", 50.0))


def lens():
    return prepare_system(optical_system("double-gauss"), *RAYS, 6)


def test_every_bundled_system_is_of_the_right_kind():
    for name in system_names():
        require_fields(optical_system(name), name)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"shape": None}, r"the system one: surfaces\[0\].shape is None; it must be a Shape"),
        ({"shape": Conic("flat")}, r"surfaces\[0\].shape.radius is 'flat'; it must be a number"),
        ({"shape": Conic(-1000.0, True)}, "shape.conic is True; it must be a number"),
        ({"shape": EvenAsphere(-1000.0, 0.0, 0.1)}, "coefficients is 0.1; it must be a tuple"),
        ({"shape": EvenAsphere(-1000.0, 0.0, (0.0, "a"))}, r"coefficients\[1\] is 'a'; it must be a number"),
        ({"shape": ZernikeSag(-1000.0, 0.0, (1e-6,), "5")}, "pupil_radius is '5'"),
        ({"shape": GridSag(-1000.0, 0.0, [[0.0] * 5] * 5, 1.0, 1.0)}, "heights is .* a NumPy array"),
        ({"position": (0, 0, 0)}, r"position is \(0, 0, 0\); it must be a NumPy array of numbers"),
        ({"rotation": None}, "rotation is None"),
        ({"rotation": np.full((3, 3), "a")}, "rotation is .*; it must be a NumPy array of numbers"),
        ({"action": None}, "action is None; it must be text"),
        ({"action": "mirror"}, "does 'mirror'; it can reflect, refract or pass"),
        ({"action": "refract", "medium": "N-BK7"}, "medium is 'N-BK7'; it must be a Medium or a Gradient"),
        ({"action": "refract", "medium": 1.5}, "medium is 1.5; it must be a Medium"),
        ({"opening": 25.0}, "opening is 25.0; it must be an Opening or None"),
        ({"opening": Opening("wide")}, "opening.outer is 'wide'"),
        ({"opening": Opening(5.0, 0.0, ((1.0,),))}, r"corners\[0\] is \(1.0,\); it must be a tuple of 2"),
        ({"opening": Opening(5.0, arms=(1.0,))}, r"arms\[0\] is 1.0"),
        ({"opening": Opening(5.0, center=None)}, "center is None"),
        ({"deformation": 5}, "deformation is 5; it must be a ZernikeDeformation or"),
        (
            {"deformation": ZernikeDeformation(5.5, 4.0)},
            "deformation.terms is 5.5; it must be a whole number",
        ),
        ({"deformation": GridDeformation("a", 4, 1.0, 1.0)}, "deformation.rows is 'a'"),
        ({"name": None}, r"surfaces\[0\].name is None; it must be text"),
    ],
)
def test_a_surface_of_another_kind_is_told(changes, words):
    with pytest.raises(UserError, match=words):
        wq.info(mirror(**changes))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"surfaces": GREGORIAN.surfaces[0]}, "surfaces is .*; it must be a tuple"),
        ({"fields": [[0.0, 0.0]]}, "fields is .*; it must be a NumPy array of numbers"),
        ({"fields": np.zeros(2)}, r"must be an array \(fields, 2\)"),
        ({"fields": np.zeros((0, 2))}, "has no field; the axis is the field"),
        ({"wavelengths": 550e-6}, "wavelengths is 0.00055; it must be a NumPy array"),
        ({"wavelengths": np.zeros(0)}, "it has 0"),
        ({"primary_wavelength": "green"}, "primary_wavelength is 'green'"),
        ({"stop": "M1"}, "stop is 'M1'; it must be a whole number"),
        ({"stop": 0.5}, "stop is 0.5; it must be a whole number"),
        ({"object_distance": "far"}, "object_distance is 'far'; it must be a number"),
        ({"pupil": None}, "pupil is None; it must be a Pupil"),
        ({"pupil": Pupil("stop", "1")}, "pupil.value is '1'"),
        ({"medium": "air"}, "medium is 'air'; it must be a Medium"),
    ],
)
def test_a_system_of_another_kind_is_told(changes, words):
    with pytest.raises(UserError, match=words):
        wq.info(replace(GREGORIAN, **changes))


CALLS = {
    "a name for a system": (
        lambda: prepare_system("euv", *RAYS, 6),
        "the system is 'euv'; it must be an Opt",
    ),
    "no system": (lambda: prepare_system(None, *RAYS, 6), "the system is None"),
    "rows of rays": (lambda: prepare_system(GREGORIAN, *np.zeros((3, 2, 5)), 3), r"each must be \(N,\)"),
    "a weight too few": (lambda: prepare_system(GREGORIAN, *RAYS[:2], RAYS[2][1:], 3), r"each must be \(N,"),
    "half a term": (lambda: prepare_system(GREGORIAN, *RAYS, 6.5), "is 6.5; it must be a whole number"),
    "half a field": (lambda: prepare_system(GREGORIAN, *RAYS, 6, 0.5), "index of the field is 0.5"),
    "text for a wavelength": (lambda: prepare_system(GREGORIAN, *RAYS, 6, 0, "550"), "wavelength is '550'"),
    "no ray": (lambda: prepare_system(GREGORIAN, *np.zeros((3, 0)), 3), "0 rays do not determine 3"),
    "a device by name": (
        lambda: measure_system(lens(), rest_states(lens().system), "numpy"),
        "the device is",
    ),
    "no line of sight": (
        lambda: prepare_system(GREGORIAN, *RAYS, 1),
        "terms is 1; it must be from 3 to 2016",
    ),
    "a million terms": (lambda: prepare_system(GREGORIAN, *RAYS, 10**6), "is 1000000; .* from 1 to 2016"),
    "no instants": (lambda: rest_states(GREGORIAN, -1), "instants is -1; it must be at least 0"),
    "states of nothing": (lambda: rest_states("euv"), "the system is 'euv'"),
    "a figure nowhere": (lambda: figure_sensitivity(lens(), [99], 3, NUMPY), "has no surface 99; it has 12"),
    "no figure": (lambda: figure_sensitivity(lens(), [], 3, NUMPY), "give at least one"),
    "no glass": (lambda: glass(None), "the name of a glass is None"),
    "an index by name": (lambda: refractive_index("N-BK7", 550e-6), "the medium is 'N-BK7'; .*glass"),
    "an index as text": (lambda: constant("1.5"), "refractive index is '1.5'; it must be a number"),
    "a formula": (lambda: refractive_index(Medium("x", "cauchy", (1.5,)), 5e-4), "'cauchy' of x is unknown"),
    "no device": (lambda: choose_device(None), "the device is None; it must be text"),
    "rays as text": (lambda: sunflower(0.0, 1.0, "many"), "number of rays is 'many'; it must be a whole"),
    "rays not a number": (lambda: sunflower(0.0, 1.0, float("nan")), "number of rays is nan"),
    "too many rays": (lambda: sunflower(0.0, 1.0, 10**12), "it must be from 1 to 1000000000"),
    "a radius as text": (lambda: sunflower("0", 1.0, 5), "radius of the pupil is '0'"),
    "Noll of text": (lambda: noll_to_nm("4"), "the Noll index is '4'; it must be a whole number"),
    "Noll between": (lambda: noll_to_nm(1.5), "the Noll index is 1.5"),
    "degree as text": (lambda: nm_to_noll("2", 0), "degree of a Zernike polynomial is '2'"),
    "points apart": (lambda: annular_zernike(np.zeros(2), np.zeros(3), 4), r"shapes \(2,\), \(3,\)"),
    "a point": (lambda: annular_zernike_gradient(0.1, 0.2, 4), r"each must be \(N,\)"),
    "points as text": (lambda: annular_zernike("a", "b", 4), "must be an array of numbers, not 'a'"),
    "terms as text": (lambda: expansion_matrix("4", 0.0, 0.3), "Zernike terms is '4'"),
    "a billion terms": (lambda: expansion_matrix(10**9, 0.0, 0.3), "1000000000; it must be from 1 to 2016"),
    "a hole as text": (lambda: transform_coefficients(np.ones(4), 0.0, "x"), "obscuration is 'x'"),
    "no shape": (lambda: shape_sag(None, 0.0, 0.0), "the shape is None"),
    "places apart": (lambda: shape_sag(Conic(1e3), np.zeros(2), np.zeros(3)), "which do not fit"),
    "a body of nothing": (lambda: rigid_body(GREGORIAN, "b", []), r"has the surfaces \[\]"),
    "a body by text": (lambda: rigid_body(GREGORIAN, "b", "M1"), "has the surfaces 'M1'; give a list"),
    "about two": (lambda: rigid_body(GREGORIAN, "b", ["M1"], (1, 2)), "3 finite numbers"),
    "no telescope": (lambda: telescope(None), "There is no telescope None"),
    "gap as text": (lambda: telescope("tmt", gap="x"), "option gap of the telescope tmt is 'x'"),
    "no name": (lambda: optical_system(3), "There is no optical system 3"),
    "no rows": (
        lambda: sequential([1]),
        "row 1 of the prescription is 1; it must be a SurfaceRow or a Break",
    ),
    "far away": (lambda: sequential([SurfaceRow("a", Conic(), "far")]), "thickness is 'far'"),
    "a rod as text": (lambda: selfoc("a", 0.1), "a number of the rod is 'a'"),
    "steps for terms": (lambda: selfoc(1.6, 0.1, 5.0), r"each must be \(N,\)"),
    "no gradient": (lambda: axial(()), "needs at least the index at its vertex"),
    "no lens": (lambda: luneburg(0.0), "must be positive"),
    "to no file": (lambda: wq.write_zmx(GREGORIAN, ""), "is no name of a file"),
    "to nothing": (lambda: wq.write_zmx(GREGORIAN, None), "is no name of a file"),
    "a name to write": (lambda: wq.write_zmx("euv", "a.zmx"), "what is written is 'euv'"),
    "a store by number": (lambda: wq.open_store(3), "The store is 3"),
    "a system for a study": (lambda: wq.load_study(GREGORIAN), "by name or path, not by OpticalSystem"),
    "a system for a name": (lambda: wq.load_system(GREGORIAN), "by name or path, not by OpticalSystem"),
    "sensitivities of it": (lambda: wq.sensitivity(GREGORIAN), "not of OpticalSystem; write_zmx"),
    "figures as text": (lambda: wq.sensitivity("gregorian", mirror_terms="x"), "figure terms is 'x'"),
    "half a figure": (lambda: wq.sensitivity("gregorian", mirror_terms=1.5), "figure terms is 1.5"),
    "overrides": (lambda: wq.load_study("euv", 3), "The overrides are 3; give a mapping or a list"),
    "a key": (lambda: wq.load_study("euv", {3: 4}), "The key 3 is no text"),
    "no array": (lambda: wq.convert_zernike(np.ones(4), "ansi"), "of the kind ndarray; give an xarray"),
    "no plan": (lambda: wq.plan(None), "by name or path, not by NoneType"),
}


@pytest.mark.parametrize("what", CALLS)
def test_one_sentence_says_what_would_be_right(what, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call, words = CALLS[what]
    with pytest.raises(UserError, match=words) as told:
        call()
    assert "\n" not in str(told.value)


def test_lists_of_numbers_are_as_good_as_arrays():
    plain = prepare_system(GREGORIAN, *RAYS, 6)
    listed = prepare_system(GREGORIAN, *(column.tolist() for column in RAYS), np.int64(6))
    assert listed.fit is plain.fit
    expected = [[1.0, 1.0, 0.0, -(3.0**0.5) / 2.0]]
    np.testing.assert_allclose(annular_zernike([0.5], [0], 4), expected, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(transform_coefficients([1, 2], 0.0, 0.0), [1.0, 2.0])
    one_override = wq.load_study("euv", "campaign.cases=3")
    assert one_override.cases == 3


@given(st.one_of(st.text(), st.none(), st.binary(), st.booleans(), st.complex_numbers(), st.lists(st.text())))
def test_what_is_no_number_is_never_taken_for_one(value):
    for check in (number, whole):
        with pytest.raises(UserError, match="it must be a"):
            check(value, "it")
    if value != []:  # no numbers are numbers
        for check in (array, alike):
            with pytest.raises(UserError):
                check(*((value, "it") if check is array else ("they", value)))


@given(st.floats() | st.integers(-(2**50), 2**50))
def test_numbers_of_any_kind_are_kept(value):
    for one in (value, np.float64(value)):
        assert number(one, "it") == pytest.approx(value, nan_ok=True, abs=0, rel=0)
    np.testing.assert_array_equal(array([value], "they"), [float(value)])
    if isinstance(value, int):
        assert whole(np.int64(value), "it") == value


def test_rows_of_different_lengths_are_no_array():
    with pytest.raises(UserError, match="they must be an array of numbers"):
        array([[1.0], [1.0, 2.0]], "they")


BEYOND = "it must be a number of 1.8e308 at most"


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: number(10**400, "it"), "it is 1000.*; " + BEYOND),
        (lambda: number(-(10**5000), "it"), "it is too long to be written; " + BEYOND),
        (lambda: number(Fraction(10**400), "it"), BEYOND),
        (lambda: array([10**400], "they"), "they are .1000.*; each must be a number of 1.8e308 at most"),
        (lambda: array([1.0, 10**5000], "they"), "they are too long to be written; each must be"),
        (lambda: array([10**30, True], "they"), "they must be an array of numbers"),
        (lambda: array([10**30, "1"], "they"), "they must be an array of numbers"),
        (lambda: array([10**30, None], "they"), "they must be an array of numbers"),
        (lambda: array(np.ma.masked_array([1.0, 2.0], [0, 1]), "they"), "they must be .* not a masked one"),
        (lambda: array([[1.0, np.ma.masked]], "they"), "they must be a plain array, not a masked one"),
        (lambda: alike("they", [1.0], np.ma.masked_array([1.0])), "not a masked one"),
        (lambda: wq.info(mirror(shape=Conic(10**400))), r"shape.radius is 1000.*; it must be a number"),
        (lambda: constant(10**400), "refractive index is 1000.*; " + BEYOND),
    ],
)
def test_numbers_too_large_and_masked_arrays_are_told(call, words):
    with pytest.raises(UserError, match=words) as told:
        call()
    assert "\n" not in str(told.value)


@given(st.lists(st.integers(-(10**308), 10**308)))
def test_whole_numbers_beyond_64_bits_are_numbers(values):
    np.testing.assert_array_equal(array(values, "they"), [float(one) for one in values])
    assert [number(one, "it") for one in values] == [float(one) for one in values]
    pair = array([values, values], "they")
    assert (pair.dtype, pair.shape) == (np.float64, (2, len(values)))


def test_long_doubles_beyond_floats_are_told():
    if np.finfo(np.longdouble).max <= np.finfo(np.float64).max:
        pytest.skip("long doubles are doubles on this machine")
    large = np.longdouble("1e4000")
    with pytest.raises(UserError, match=BEYOND):
        number(large, "it")
    with pytest.raises(UserError, match=BEYOND.removeprefix("it ")):
        array([large], "they")
    assert number(np.longdouble("inf"), "it") == array([np.longdouble("inf")], "they")[0] == np.inf


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        (EvenAsphere(-1000.0, 0.0, (1e308, 1e308)), "the surface M1 of one has the curvature inf / mm"),
        (ExtendedPolynomial(-1000.0, 0.0, (0.0, 0.0, 1e300), 1e-3), "has the curvature 1e.306 / mm"),
        (ExtendedPolynomial(-1000.0, 0.0, (0.0, 0.0, 1.0), 1e-200), "normalization radius .* 1e-09 mm at"),
        (ZernikeSag(-1000.0, 0.0, (0.0, 0.0, 0.0, 1e308), 5.0), "has the curvature"),
        (ZernikeSag(-1000.0, 0.0, (0.0, 0.0, 0.0, 1.0), 1e-200), "pupil radius .* 1e-09 mm at"),
        (GridSag(-1000.0, 0.0, np.full((5, 5), 1e308), 1e-3, 1e-3), "has the curvature"),
    ],
)
def test_shapes_beyond_all_bounds_are_told_without_warnings(shape, words):
    with pytest.raises(UserError, match=words):
        wq.info(mirror(shape=shape))


@given(
    values=st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=6),
    limit=st.sampled_from([0.0, 1.0, 1e12, 1.7976931348623157e308]),
)
def test_numbers_within_a_limit_are_told_from_those_beyond(values, limit):
    expected = all(abs(value) <= limit for value in values)
    assert all_within(np.array(values, dtype=float).reshape(-1, 1), limit) is expected
    with np.errstate(over="ignore"):
        rounded = np.array([float(np.float32(value)) for value in values])
        assert all_within(rounded.astype(np.float32), limit) is all(abs(value) <= limit for value in rounded)
    assert not all_within(np.array([2**32]), 1e5)
    assert not all_within(np.array([100], dtype=np.int8), 10)
