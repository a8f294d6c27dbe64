from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.media.glasses import AIR, glass, refractive_index
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.segments.kinematics import cardan
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.shapes.shapes import (
    Opening,
    ZernikeSag,
)
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import Pupil, require_system
from wavequake.optics.zemax.export import zmx_text
from wavequake.optics.zemax.read import parse_zmx, read_zmx
from wavequake.optics.zemax.surfaces import cardan_angles

COOKE = Path(__file__).parents[1] / "data" / "cooke_triplet.zmx"


def lens(*surfaces, header=""):
    """The text of a file with an object at infinity, these rows and an image."""
    rows = ["  DISZ INFINITY", *surfaces, "  DISZ 0"]
    top = header or "ENPD 10\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0\nYFLN 0"
    return top + "\n" + "\n".join(f"SURF {i}\n{row}" for i, row in enumerate(rows)) + "\n"


def read(*surfaces, header=""):
    return parse_zmx(lens(*surfaces, header=header), "lens.zmx")


def test_a_published_lens():
    system = read_zmx(COOKE)
    assert system.name == "Cooke triplet f/5"
    assert [surface.name for surface in system.surfaces] == [
        *("front", "surface 2", "surface 3", "surface 4", "surface 5", "surface 6", "image")
    ]
    assert [surface.action for surface in system.surfaces] == ["refract"] * 6 + ["pass"]
    glass_names = [surface.medium.name for surface in system.surfaces[:6]]
    assert glass_names == ["N-SK16", "air", "F2", "air", "N-SK16", "air"]
    assert system.stop == 3
    assert system.pupil == Pupil("entrance_diameter", 10.0)
    assert np.isinf(system.object_distance)
    np.testing.assert_array_equal(np.rad2deg(system.fields), [[0, 0], [0, 14], [0, 20]])
    np.testing.assert_array_equal(system.wavelengths, [480e-6, 550e-6, 650e-6])
    assert system.primary_wavelength == 1
    assert system.surfaces[0].shape.radius == pytest.approx(22.01356, abs=1e-5)
    assert system.surfaces[0].opening == Opening(outer=9.5)
    assert system.surfaces[1].opening is None  # a semi-diameter without an aperture stops no light
    assert system.surfaces[-1].position[2] == pytest.approx(
        3.258956 + 6.007551 + 0.9999746 + 4.750409 + 2.952076 + 42.20778
    )


def test_the_lens_has_its_published_focal_length():
    """The paraxial marginal ray through the imported surfaces leaves as from 50 mm."""
    system = read_zmx(COOKE)
    wavelength = system.wavelengths[system.primary_wavelength]
    height, slope, index, z = 5.0, 0.0, 1.0, 0.0
    for surface in system.surfaces[:-1]:
        height += slope / index * (surface.position[2] - z)
        z = surface.position[2]
        after = refractive_index(surface.medium, wavelength)
        slope -= height * (after - index) / surface.shape.radius
        index = after
    assert -5.0 / slope == pytest.approx(50.0, abs=0.01)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-8", "utf-8-sig", "latin-1"])
def test_encodings(tmp_path, encoding):
    path = tmp_path / "lens.zmx"
    text = COOKE.read_text().replace("Cooke triplet", "Störkle's triplet").replace("\n", "\r\n")
    data = text.encode(encoding)
    path.write_bytes(b"\xff\xfe" + data if encoding == "utf-16-le" else data)
    assert read_zmx(path).name == "Störkle's triplet f/5"


@pytest.mark.parametrize(("unit", "scale"), [("CM", 10.0), ("IN", 25.4), ("METER", 1000.0)])
def test_units_scale_every_length(unit, scale):
    rows = [
        "  TYPE EVENASPH\n  CURV 0.01\n  CONI -0.5\n  PARM 1 1e-4\n  PARM 2 2e-6"
        "\n  DISZ 3\n  CLAP 1 5 0\n  STOP",
        "  TYPE XPOLYNOM\n  XDAT 1 3\n  XDAT 2 4\n  XDAT 3 0.1\n  XDAT 5 0.3\n  DISZ 2",
        "  TYPE COORDBRK\n  PARM 1 0.5\n  PARM 2 -0.25\n  DISZ 1",
    ]
    header = f"UNIT {unit} X W\nENPD 10\nFTYP 1 0 1 1\nXFLN 0\nYFLN 2\nWAVM 1 0.5 1"
    text = lens(*rows, header=header).replace("INFINITY", "7")
    ours = parse_zmx(text, "lens.zmx")
    mm = parse_zmx(text.replace(f"UNIT {unit}", "UNIT MM"), "lens.zmx")
    asphere, polynomial = ours.surfaces[0].shape, ours.surfaces[1].shape
    r = 4.0
    sag = sum(c * r ** (2 * k) for k, c in enumerate(mm.surfaces[0].shape.coefficients, start=1))
    scaled = sum(c * (scale * r) ** (2 * k) for k, c in enumerate(asphere.coefficients, start=1))
    assert scaled == pytest.approx(scale * sag, rel=1e-13)  # the same surface, drawn larger
    assert asphere.radius == pytest.approx(100 * scale)
    assert polynomial.normalization_radius == pytest.approx(4 * scale)
    assert polynomial.coefficients == pytest.approx((0.1 * scale, 0, 0.3 * scale))
    assert ours.surfaces[0].opening == Opening(outer=5 * scale, inner=1 * scale)
    assert ours.object_distance == pytest.approx(7 * scale)
    assert ours.pupil.value == pytest.approx(10 * scale)
    np.testing.assert_allclose(ours.fields, [[0, 2 * scale]])
    np.testing.assert_allclose(ours.surfaces[2].position, [0.5 * scale, -0.25 * scale, 6 * scale])


def test_mirrors_keep_the_medium_and_the_axis():
    system = read(
        "  COMM primary\n  CURV -0.001\n  CONI -1\n  DISZ -400\n  GLAS MIRROR 0 0\n  STOP",
        "  COMM secondary\n  CURV -0.003\n  DISZ 500\n  GLAS MIRROR 0 0",
        "  COMM window\n  DISZ 5\n  GLAS N-BK7 0 0",
        "  COMM dummy\n  DISZ 5\n  GLAS N-BK7 0 0",
        "  COMM rear\n  DISZ 5",
        "  COMM free\n  DISZ 5",
    )
    assert [surface.action for surface in system.surfaces] == [
        *("reflect", "reflect", "refract", "pass", "refract", "pass", "pass")
    ]
    assert [surface.position[2] for surface in system.surfaces] == [0, -400, 100, 105, 110, 115, 120]
    assert system.surfaces[2].medium == glass("N-BK7")
    assert system.surfaces[4].medium == AIR


def test_a_fold_mirror_turns_the_axis():
    """Two breaks of 45 degrees about x: light along z leaves along y, and the image stands 10 mm along it."""
    fold = "  TYPE COORDBRK\n  PARM 3 45\n  DISZ {}"
    system = read("  DISZ 20\n  STOP", fold.format(0), "  DISZ 0\n  GLAS MIRROR", fold.format(-10))
    mirror, image = system.surfaces[1:]
    normal = mirror.rotation[:, 2]
    incoming = np.array([0.0, 0.0, 1.0])
    outgoing = incoming - 2 * (incoming @ normal) * normal
    np.testing.assert_allclose(image.position - mirror.position, 10 * outgoing, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.abs(image.rotation[:, 2] @ outgoing), 1.0)


@given(st.lists(st.floats(-80, 80), min_size=5, max_size=5))
def test_a_break_of_opposite_numbers_and_order_undoes_a_break(numbers):
    there = "".join(f"\n  PARM {k} {value!r}" for k, value in enumerate(numbers, start=1))
    back = "".join(f"\n  PARM {k} {-value!r}" for k, value in enumerate(numbers, start=1))
    system = read(
        f"  TYPE COORDBRK{there}\n  DISZ 0",
        "  DISZ 0\n  STOP",
        f"  TYPE COORDBRK{back}\n  PARM 6 1\n  DISZ 0",
    )
    np.testing.assert_allclose(
        system.surfaces[0].rotation, cardan(np.deg2rad(numbers[2:])), rtol=0, atol=1e-13
    )
    np.testing.assert_allclose(system.surfaces[1].rotation, np.eye(3), rtol=0, atol=1e-13)
    np.testing.assert_allclose(system.surfaces[1].position, 0, rtol=0, atol=1e-11)


@given(st.lists(st.floats(-np.pi, np.pi), min_size=3, max_size=3))
def test_cardan_angles_give_the_rotation_back(angles):
    rotation = cardan(np.array(angles))
    np.testing.assert_allclose(cardan(np.array(cardan_angles(rotation))), rotation, rtol=0, atol=1e-8)


def test_standard_zernike_terms_are_nolls():
    rows = "\n".join(f"  XDAT {k} {v}" for k, v in [(1, 4), (2, 5.0), (4, 0.2), (6, 0.3)])
    system = read(f"  TYPE SZERNSAG\n  STOP\n{rows}\n  DISZ 1")
    assert system.surfaces[0].shape == ZernikeSag(np.inf, 0.0, (0.0, 0.2, 0.0, 0.3), 5.0)


def test_fringe_zernike_terms_are_converted():
    """Fringe 4, 8 and 9 as written by Wyant and Creath: 2r^2 - 1, (3r^2 - 2) r sin, 6r^4 - 6r^2 + 1."""
    values = {4: 0.3, 8: -0.2, 9: 0.1}
    rows = "\n".join(f"  XDAT {k + 2} {v}" for k, v in values.items())
    shape = read(f"  TYPE FZERNSAG\n  STOP\n  XDAT 1 9\n  XDAT 2 2.0\n{rows}\n  DISZ 1").surfaces[0].shape
    x, y = np.array([0.3, -0.6, 0.1]), np.array([0.2, 0.5, -0.9])
    t = x**2 + y**2
    expected = 0.3 * (2 * t - 1) - 0.2 * (3 * t - 2) * y + 0.1 * (6 * t**2 - 6 * t + 1)
    ours = annular_zernike(x, y, len(shape.coefficients)) @ np.array(shape.coefficients)
    np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize(("kind", "astigmatism"), [("SZERNSAG", 6), ("FZERNSAG", 5)])
def test_zernike_terms_over_an_even_asphere(kind, astigmatism):
    """Heights as written out: conic, powers of the radius (as of a mirror of a public file), astigmatism."""
    powers = {2: -1.782e-8, 3: 1.508e-12, 4: -1.362e-16, 5: 1.015e-20, 6: -3.996e-25, 8: 2e-34}
    norm, term = 75.0, 1.5e-4
    text = "\n".join(
        [f"  TYPE {kind}\n  STOP\n  CURV -6.6e-4\n  CONI -1.6\n  XDAT 1 8\n  XDAT 2 {norm}"]
        + [f"  PARM {k} {value!r}" for k, value in powers.items()]
        + [f"  XDAT {2 + astigmatism} {term!r}\n  DISZ 1"]
    )
    x, y = np.random.default_rng(0).uniform(-53.0, 53.0, (2, 60))
    square = x**2 + y**2
    c, k = -6.6e-4, -1.6
    wanted = c * square / (1.0 + np.sqrt(1.0 - (1.0 + k) * c**2 * square))
    wanted += sum(value * square**power for power, value in powers.items())
    if kind == "SZERNSAG":
        wanted += term * np.sqrt(6.0) * (x**2 - y**2) / norm**2
    else:
        wanted += term * (x**2 - y**2) / norm**2
    found = read(text).surfaces[0].shape
    np.testing.assert_allclose(shape_sag(found, x, y)[0], wanted, rtol=0, atol=1e-14)
    inch = (
        read(text, header="UNIT IN X W\nENPD 1\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0\nYFLN 0").surfaces[0].shape
    )
    np.testing.assert_allclose(shape_sag(inch, 25.4 * x, 25.4 * y)[0], 25.4 * wanted, rtol=0, atol=1e-12)


def test_the_37th_fringe_term_is_that_of_twelfth_degree():
    """As printed by Wyant and Creath: 924 r^12 - 2772 r^10 + 3150 r^8 - 1680 r^6 + 420 r^4 - 42 r^2 + 1."""
    rows = "  XDAT 1 37\n  XDAT 2 2.0\n  XDAT 6 0.3\n  XDAT 39 -0.2"
    shape = read(f"  TYPE FZERNSAG\n  STOP\n{rows}\n  DISZ 1").surfaces[0].shape
    t = np.array([0.0, 0.2, 0.7, 1.0])
    highest = np.polynomial.Polynomial([1, -42, 420, -1680, 3150, -2772, 924])(t)
    ours = annular_zernike(np.sqrt(t), 0 * t, len(shape.coefficients)) @ np.array(shape.coefficients)
    np.testing.assert_allclose(ours, 0.3 * (2 * t - 1) - 0.2 * highest, rtol=0, atol=1e-12)
    with pytest.raises(UserError, match="38 terms; a surface of the type FZERNSAG has at most 37"):
        read("  TYPE FZERNSAG\n  STOP\n  XDAT 1 38\n  XDAT 2 2.0\n  DISZ 1")


@pytest.mark.parametrize(
    "line",
    [
        *("MAZH 0 0", "PZUP 1 -1 0 0", "PPAR 1 1 1 0 0", "PKUP 1 1 1 0 0"),
        *("VDSZ 1 -1 0 0", "VPAR 1", "VCON"),
        *("MEMA 25 1 0 0 1", "OEMA 2.14 0 0 0 1"),
    ],
)
def test_a_solve_a_variable_or_an_edge_leaves_the_lens_as_the_file_has_it(line):
    surfaces = ["  STOP\n  CURV 0.02\n  CONI -0.5\n  DISZ 4\n  GLAS N-BK7", "  CURV -0.02\n  DISZ 48"]
    marked = [surfaces[0], f"{surfaces[1]}\n  {line}"]
    assert zmx_text(read(*marked)) == zmx_text(read(*surfaces))


STOP = "  STOP\n  DISZ 1"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (lens("  TYPE HOLOGRM1\n" + STOP), r"line 8 \(TYPE\): surface 1 is of the type HOLOGRM1"),
        (lens("  TYPE FRESNELS\n" + STOP), "FRESNELS, which is not supported"),
        (lens("  TYPE GRINSUR7\n" + STOP), "GRINSUR7, which is not supported"),
        (lens(STOP).replace("DISZ INFINITY", "DISZ 9\n  CURV 0.1"), "the object is no plane"),
        (lens(STOP).replace("DISZ INFINITY", "TYPE GRINSUR2\n  PARM 2 2"), "the object is no plane"),
        (lens(STOP + "\n  GLAS UNOBTAINIUM 0 0"), r"surface 1: There is no glass 'UNOBTAINIUM'"),
        (lens(STOP + "\n  GLAS ___BLANK 1 0 1.6 -40"), "an Abbe number from 5 to 200 .* not 1.6, -40 and 0"),
        (lens(STOP + "\n  UDAP 0 foo.uda"), r"line 10 \(UDAP\): surface 1 has an aperture of another form"),
        (lens(STOP + "\n  CLAP 0 5 0\n  OBDC 1 x"), "'x' is not a number"),
        (lens(STOP + "\n  CLAP 5 2 0"), "must increase"),
        (lens(STOP + "\n  SPID -1 4 0"), "not a positive number"),
        (lens(STOP + "\n  SPID 1 0 0"), "0 is not a number of things"),
        (lens(STOP + "\n  PARM 1 0.5"), "parameter 1 of the type STANDARD must be 0"),
        (lens("  TYPE EVENASPH\n  PARM 9 1\n" + STOP), "parameter 9"),
        (lens("  TYPE SZERNSAG\n  PARM 9 1e-5\n  XDAT 1 1\n  XDAT 2 1\n" + STOP), "parameter 9"),
        (lens("  TYPE SZERNSAG\n  XDAT 1 1\n" + STOP), "positive normalization radius"),
        (lens("  CURV nan\n" + STOP), "'nan' is not a finite number"),
        (lens("  CURV x\n" + STOP), "'x' is not a number"),
        (lens("  DISZ INFINITY\n  STOP"), "surface 1 has an infinite thickness"),
        (lens("  DISZ 1"), "exactly one surface with STOP .* none"),
        (lens(STOP, STOP), "exactly one surface with STOP .* surface 1, surface 2"),
        (lens(STOP, "  TYPE COORDBRK").removesuffix("SURF 3\n  DISZ 0\n"), "cannot be a coordinate break"),
        (lens(STOP).replace("ENPD 10", "UNIT FT"), "the unit 'FT' is not supported"),
        (lens(STOP).replace("ENPD 10", "MODE NSC"), "the mode 'NSC'"),
        (lens(STOP).replace("ENPD 10", "ENPD 10\nVCYN 1"), "leaves no light"),
        (lens(STOP).replace("ENPD 10", "PWAV 1"), "needs one of ENPD, FNUM, OBNA, FLOA .* none"),
        (lens(STOP).replace("ENPD 10", "ENPD -1"), "must be positive"),
        (lens(STOP).replace("ENPD 10", "ENPD 10\nPWAV 2"), "1 wavelengths, not 2"),
        (lens(STOP).replace("ENPD 10", "FLOA"), "has no semi-diameter"),
        (lens(STOP).replace("FTYP 0", "FTYP 7"), "fields of type 7 are not known"),
        (lens(STOP).replace("FTYP 0", "FTYP 3").replace("YFLN 0", "YFLN 1"), "no focal length"),
        (lens(STOP).replace("FTYP 0", "FTYP 1").replace("YFLN 0", "YFLN 1"), "the object is at infinity"),
        (lens(STOP).replace("WAVM 1 0.55 1\n", ""), "no wavelength"),
        (lens(STOP).replace("WAVM 1 0.55", "WAVM 1 -0.55"), "wavelength -0.55 um is not positive"),
        (lens(STOP).replace("SURF 1", "SURF 4"), "counted from 0"),
        ("not a lens file", "0 SURF lines"),
        ("", "no sequential lens file"),
    ],
)
def test_what_is_not_supported_is_refused_by_name(text, match):
    with pytest.raises(UserError, match=match):
        parse_zmx(text, "lens.zmx")


def test_a_missing_file(tmp_path):
    with pytest.raises(UserError, match=r"none\.zmx cannot be read"):
        read_zmx(tmp_path / "none.zmx")


TOKENS = ["", "0", "-1", "1e300", "1e400", "nan", "x", "INFINITY", "MIRROR", "___BLANK 1 0 1.5", "3.5", "é"]
ODD = lens(
    "  TYPE XPOLYNOM\n  XDAT 1 3\n  XDAT 2 4\n  XDAT 3 0.1\n  SPID 1 4 0\n  DISZ 2",
    "  TYPE FZERNSAG\n  XDAT 1 3\n  XDAT 2 4\n  XDAT 3 0.1\n  CLAP 1 4 0\n  DISZ 2",
    "  TYPE COORDBRK\n  PARM 1 0.5\n  PARM 3 25\n  PARM 6 1\n  DISZ 1",
    "  TYPE EVENASPH\n  PARM 1 0.5\n  PARM 3 25\n  DISZ 1\n  SQAP 1 2 0\n  STOP",
    "  TYPE GRINSUR3\n  PARM 1 0.5\n  PARM 2 1.5\n  PARM 3 1e-3\n  PARM 5 1e-5\n  DISZ 1",
    "  TYPE GRINSUR2\n  PARM 1 0.5\n  PARM 2 2\n  PARM 3 1e-3\n  PARM 8 1e-5\n  DISZ 1",
    "  TYPE GRID_SAG\n  GDAT 5 5 1 1 0 0\n  DISZ 1"
    + "".join(f"\n  GARR {k} {1e-3 * k} 0 0 0 0" for k in range(1, 26)),
    header="UNIT CM\nFLOA\nFTYP 0 0 1 1 0 0 0\nWAVL 0.5 0.6\nPWAV 1",
)


@settings(max_examples=300, deadline=None)
@given(
    st.sampled_from([COOKE.read_text(), ODD.replace("STOP", "STOP\n  DIAM 3")]),
    st.integers(0, 200),
    st.integers(0, 12),
    st.sampled_from(TOKENS),
)
def test_a_damaged_file_is_read_or_refused_but_never_breaks(text, line, word, token):
    lines = text.splitlines()
    whole = lines[line % len(lines)]
    words = whole.split()
    words[word % len(words)] = token
    lines[line % len(lines)] = whole[: len(whole) - len(whole.lstrip())] + " ".join(words)
    try:
        system = parse_zmx("\n".join(lines), "lens.zmx")
    except UserError:
        return
    require_system(system)


NEWTON = """MODE SEQ
ENPD 200
FTYP 0 0 1 1 0 0 0
YFLN 0
WAVM 1 0.55 1
SURF 0
  DISZ INFINITY
SURF 1
  COMM M1
  CURV -5.0E-4
  CONI -1
  DISZ -800
  GLAS MIRROR 0 0
  STOP
SURF 2
  TYPE COORDBRK
  PARM 3 30
  PARM 4 20
  DISZ 0
SURF 3
  COMM fold
  DISZ 0
  GLAS MIRROR 0 0
SURF 4
  TYPE COORDBRK
  DISZ 0
  PARM 3 {x}
  PARM 4 {y}
  PARM 5 {z}
SURF 5
  COMM image
  DISZ 0
"""


def test_a_folded_telescope_focuses_on_its_image():
    """A parabola of 1000 mm, a flat 800 mm before it, the image where the reflection sends the axis."""
    normal = cardan(np.deg2rad([30.0, 20.0, 0.0]))[:, 2]
    arm = np.array([0.0, 0.0, -1.0]) + 2 * normal[2] * normal  # the axis after the flat
    x, y, z = np.rad2deg(cardan_angles(cardan(np.deg2rad([30.0, 20.0, 0.0])).T))
    system = parse_zmx(NEWTON.format(x=x, y=y, z=z), "newton.zmx")
    image = system.surfaces[-1]
    np.testing.assert_allclose(image.position, [0, 0, -800], rtol=0, atol=1e-12)
    system = replace(
        system, surfaces=(*system.surfaces[:2], replace(image, position=image.position + 200 * arm))
    )
    radius, angle = np.linspace(10, 100, 5), np.linspace(0, 6, 5)
    position = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(5, -900.0)])
    rays = Rays(position, np.array([[0.0], [0.0], [1.0]]) * np.ones(5), np.zeros(5))
    for one in (system, parse_zmx(zmx_text(system), "copy.zmx")):
        traced = trace_sequence_numpy(pack(one, 550e-6), rays, moving(one, rest_states(one)))
        np.testing.assert_allclose(np.stack([traced.x[0], traced.y[0]]), 0.0, rtol=0, atol=1e-10)
        np.testing.assert_allclose(traced.path[0], 900 + 1000, rtol=1e-13)
