"""CODE V's sequence files against the same lens as a .zmx file."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.optics.media.glasses import glass
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.segments.kinematics import cardan
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.zemax.codev import read_seq, sequence_file
from wavequake.optics.zemax.read import parse_zmx, system_of

SEQ = """RDM;LEN ! radii from here on
TITLE 'A doublet; with a stop'
EPD 10.0
DIM M
WL 656.3 587.6 &
   486.1
REF 2
WTW 1 2 1
XAN 0.0 0.0
YAN 0.0 3.0
VUY 0.0 0.2
VLY 0.0 0.4
SO 0.0 0.1e14
S 61.5 6.0 NBK7_SCHOTT
  CIR 8.0
S -43.5 2.5 'SF5_SCHOTT'
  CCY 0; THC 0
S -124.0 3.0
  CON
  K -0.5
S 0.0 1.5 517.642
  ASP
  A 1.0e-6; B 2e-9
S 0.0 80.0
  STO
SI 0.0 -0.1
GO
"""
ZMX = """NAME A doublet; with a stop
ENPD 10
WAVM 1 0.6563 1
WAVM 2 0.5876 1
WAVM 3 0.4861 1
PWAV 2
FTYP 0 0 2 3 0 0 0
YFLN 0 3
VDYN 0 0.1
VCYN 0 0.3
SURF 0
  DISZ INFINITY
SURF 1
  CURV 0.016260162601626018
  DISZ 6
  GLAS N-BK7 0 0
  CLAP 0 8
SURF 2
  CURV -0.022988505747126436
  DISZ 2.5
  GLAS SF5 0 0
SURF 3
  CURV -0.008064516129032258
  CONI -0.5
  DISZ 3
SURF 4
  TYPE EVENASPH
  PARM 2 1e-6
  PARM 3 2e-9
  DISZ 1.5
  GLAS ___BLANK 1 0 1.517 64.2 0
SURF 5
  DISZ 80
  STOP
SURF 6
  DISZ -0.1
"""


def read(text):
    return system_of(sequence_file(text, "lens.seq"))


def test_a_sequence_is_the_lens_that_a_zmx_file_says(tmp_path):
    path = tmp_path / "lens.seq"
    path.write_text(SEQ)
    ours, theirs = read_seq(path), parse_zmx(ZMX, "lens.zmx")
    assert (ours.name, ours.stop, ours.pupil) == (theirs.name, theirs.stop, theirs.pupil)
    assert ours.note == theirs.note == ""
    for one, other in zip(ours.surfaces, theirs.surfaces, strict=True):
        assert (one.shape, one.action, one.medium, one.opening) == (
            other.shape,
            other.action,
            other.medium,
            other.opening,
        )
        np.testing.assert_array_equal(one.position, other.position)
    np.testing.assert_array_equal(ours.fields, theirs.fields)
    np.testing.assert_allclose(ours.vignetting, theirs.vignetting, rtol=0, atol=1e-15)
    np.testing.assert_allclose(ours.wavelengths, theirs.wavelengths, rtol=1e-15)
    assert paraxial(ours).focal_length == pytest.approx(paraxial(theirs).focal_length, rel=1e-14)


def test_curvatures_units_and_mirrors():
    text = "RDM N\nDIM I\nFNO 8\nWL 500\nYIM 0 1\nSO 0 1e13\nS -0.01 -50 REFL\nSI 0 0\n"
    mirror = read(text)  # the first surface is the stop by default
    assert mirror.surfaces[0].action == "reflect"
    assert mirror.surfaces[0].shape.radius == pytest.approx(-2540)
    assert paraxial(mirror).focal_length == pytest.approx(1270)
    assert np.tan(mirror.fields[1, 1]) == pytest.approx(25.4 / 1270)
    assert read(text.replace("FNO 8", "EPD 2")).pupil.value == pytest.approx(50.8)


def test_glasses_may_leave_out_hyphens_and_maker():
    text = "RDM\nEPD 5\nWL 500\nSO 0 1e13\nS 50 3 {}\nS -50 40\nSI 0 0\n"
    for word, name in {"SLAH53_OHARA": "OHARA:S-LAH53", "BAF2_HOYA": "HOYA:BAF2", "N-BK7": "N-BK7"}.items():
        assert read(text.format(word)).surfaces[0].medium == glass(name)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("  K -0.5", "  K -0.5\n  GLB 3.0", r"line 21 \(GLB\): GLB changes the light"),
        ("  STO", "  GRT\n  STO", r"line 25 \(GRT\): surface 5 is a grating without a positive spacing"),
        ("  STO", "  DIF GRT\n  GRS 1e-3; GRY 0\n  STO", r"grooves in no direction"),
        ("  STO", "  DIF GRT\n  GRS 1e-3; GRZ 1\n  STO", r"grooves that are no sections along its axis"),
        ("  STO", "  DIF HOE\n  STO", r"line 25 \(DIF\): the diffractive surface DIF HOE is not supported"),
        ("  STO", "  DIF DOE\n  HCO C1 1e-3\n  STO", r"without a wavelength of its paths"),
        ("  STO", "  DIF DOE\n  HCT XY\n  STO", r"phase of type HCT XY is not supported"),
        ("  STO", "  DIF DOE\n  HCO 1\n  STO", r"HCO needs a coefficient from C1 to C100"),
        ("  STO", "  DIF DOE\n  HX1 1\n  STO", r"HX1 makes a hologram of two points"),
        ("RDM;", "", r"line 14 \(S\): the file does not say whether it gives radii"),
        ("GO", "ZOO 2\nZOO THI S1 1 2 3", "THI has 3 values for 2 zoom positions"),
        ("GO", "ZOO 2\nZOO GLA S1 'NBK7' 'NSF6'", "the zoom position changes GLA"),
        ("GO", "ZOO 2\nZOO THI S9 1 2", "there is no surface 9"),
        ("GO", "ZOO 2\nZOO YAN 1 2", "nothing does not say which it is; F1"),
        ("GO", "ZOO 2\nZOO YAN F0 1 2", "F0 does not say which it is; F1"),
        ("GO", "ZOO 2\nZOO STO S1 S2", "the zoom position changes STO"),
        ("REF 2", "REF 2\nPUI 0.135", r"line 8 \(PUI\): the apodization of the pupil"),
        ("NBK7_SCHOTT", "UNOBTAINIUM_SCHOTT", r"line 14 \(GLAS\): surface 1: There is no glass"),
        ("WL 656.3 587.6 &\n   486.1\n", "", "no wavelength"),
        ("DIM M", "DIM K", "the unit 'K' is not known"),
        ("YAN 0.0 3.0", "YOB 0.0 3.0", "fields in several ways: AN, OB"),
        ("S 61.5 6.0", "S 61.5 x", "'x' is not a number"),
    ],
)
def test_what_is_not_supported_is_refused_by_line(old, new, match):
    with pytest.raises(UserError, match=match):
        read(SEQ.replace(old, new))


def test_what_is_not_understood_is_named():
    assert "WARP (line 7)" in read(SEQ.replace("REF 2", "WARP 9\nREF 2")).note


def folded(body):
    return f"len\ndim m\nrdm n\nso 0. 1e+11\n{body}epd 1; wl 555\nyan 0\n"


THREE_MIRRORS = """RDM Y
SO 0 1e11
S 0 300.000000
S -1058.98937 -276.006853 REFL
  CON
  K -1.314566
  DAR
  YDE 48.695345; ADE 8.438645
  REX 75.734236; REY 78.538674; ADY 99.602384
S 0 -0.981318
  STO
  DAR
  YDE 11.444717; ADE 10.219900
S -324.06500 319.160560  REFL
  CON
  K 0.889123
  DAR
  YDE 17.561821; ADE 9.661580
  REX 24.789115; REY 24.791683; ADY -6.213535
S -453.96516 -321.621031  REFL
  ASP
  K 0.226106; A 0.368950E-10
  DAR
  YDE 67.500535; ADE 9.514418
  REX 66.581268; REY 65.453521; ADY -112.354230
SI 0 15.407921
  YDE -47.681342; ADE 8.716957
EPD 100.0
DIM M
WL 500.0
YAN 0.0
"""
# Files of ray-optics (codev/tests, BSD-3-Clause), and where ray-optics 0.9.8 says that a ray along z through
# (0.1, 0.3) before the first surface ends, with y of its direction there.
TILTED = {
    "tilt": (
        folded("s 0 100\ns 0 100\nade 45\ns 0 100\nade 45\nrev\ns 0 100\nsi 0 0\n"),
        0.1, -70.41067811865474, 0.0,
    ),
    "bend": (
        folded(
            "s 0 5\ns 0 -5 refl\nade 60\nben\ns 0 5 refl\nade -60\nben\ns 0 -5 refl\nade -45\nben\nsi 0 0\n"
        ),
        0.1, 0.3, 0.0,
    ),
    "decenter": (
        folded(
            "s 0 0\ns 0 100\nyde 25\ns 0 100\nyde -75\nade 30\ns 0 10\nrev\nade 30\n"
            "s 0 -100 refl\nben\nade 45\ns 0 -100\nsi 0 0\n"
        ),
        0.1, 0.3, 0.0,
    ),
    "return": (
        folded("s 0 10\ns 0 10\nade 45\ndar\nyde 1\ns 0 10\nade 45\nyde 1\ndar\ns 0 10\nsi 0 0\n"),
        0.1, 0.3, 0.0,
    ),
    "folded lenses": (
        folded(
            "s 0 5\ns 0 -2.25 refl\nade 60\nben\ns -.67 -.3 nbk7_schott\ns 0. -0.05\ns 0. -.2 nbk7_schott\n"
            "s -.77095 -2.25\ns 0 2.25 refl\nade -60\nben\ns -.67 0.2 nbk7_schott\ns 0. 0.05\n"
            "s 0 .3 nbk7_schott\ns -.59225 2.25\ns 0 -5 refl\nade -45\nben\nsi 0 0\n"
        ),
        0.0968409552269853, 0.29052286568095514, -0.0003586268372115782,
    ),
    "three mirrors": (THREE_MIRRORS, -0.004513177536609356, 6.736446666084121, 0.5054254202372304),
}  # fmt: skip


@pytest.mark.parametrize("name", TILTED)
def test_tilted_surfaces_stand_where_another_tracer_has_them(name, tmp_path):
    text, x, y, v = TILTED[name]
    path = tmp_path / "tilted.seq"
    path.write_text(text)
    system = read_seq(path)
    rays = Rays(np.array([[0.1], [0.3], [-1.0]]), np.array([[0.0], [0.0], [1.0]]), np.zeros(1))
    wave = float(system.wavelengths[0])
    found = trace_sequence(pack(system, wave), rays, moving(system, rest_states(system)), NUMPY, True)
    assert [found.x[0, 0], found.y[0, 0]] == pytest.approx([x, y], abs=1e-11)
    assert abs(found.v[0, 0]) == pytest.approx(abs(v), abs=1e-12)


def test_a_rectangle_is_an_aperture_about_its_center(tmp_path):
    path = tmp_path / "three.seq"
    path.write_text(THREE_MIRRORS)
    opening = read_seq(path).surfaces[1].opening
    assert opening.center == (0.0, 99.602384)
    assert max(opening.corners) == (75.734236, 78.538674)


def test_left_handed_shifts_along_z_come_back(tmp_path):
    """Two surfaces that return are where they would be without; a shift along z moves the one between."""
    path = tmp_path / "back.seq"
    moved = "xde 1; yde 2; zde 3; ade 10; bde 20; cde 30\ndar\n"
    path.write_text(folded(f"s 0 5\ns 0 7 nbk7_schott\n{moved}s 0 9\nsi 0 0\n"))
    surfaces = read_seq(path).surfaces
    np.testing.assert_allclose(surfaces[1].position, [1.0, 2.0, 8.0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(surfaces[2].position, [0.0, 0.0, 12.0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(surfaces[2].rotation, np.eye(3), rtol=0, atol=1e-14)
    a, b, c = np.deg2rad([-10.0, -20.0, 30.0])
    np.testing.assert_allclose(surfaces[1].rotation, cardan(np.array([a, b, c])), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("s 0 5\nade 10\nben\ndar\nsi 0 0\n", "DAR stands beside BEN"),
        ("s 0 5 refl\nade 10; yde 1\nben\nsi 0 0\n", "is decentered beside BEN"),
        ("s 0 5 refl\nade 10; cde 1\nben\nsi 0 0\n", "has CDE beside BEN"),
        ("s 0 5\nrex 3\nsi 0 0\n", "without both half widths"),
        ("ade 3\ns 0 5\nsi 0 0\n", "the object cannot be decentered"),
        ("s 0 5\nade x\nsi 0 0\n", "'x' is not a number"),
    ],
)
def test_tilts_without_a_meaning_are_refused(body, message, tmp_path):
    path = tmp_path / "bad.seq"
    path.write_text(folded(body))
    with pytest.raises(UserError, match=message):
        read_seq(path)


# Numbers of KKSDNA.seq, a zoom of four mirrors; on GitHub, in a repository of Optical-DesignerZhu on their
# automated construction.
FOUR_MIRRORS = """rdm;len
epd 20; dim m; wl 587.5618
xan 0 0; yan -3 0
so 0 1e13
s 0 400
s 6845.93 -367.537 refl
k 3.81396
ben
ade 30
s 589.797 361.23 refl
k 9.47672
ben
ade -4.16261
s 105.57 -141.965 refl
k -18.3315
ben
ade 29.95
s 126.216 82.1242 refl
k -1.05622
ben
ade 9.692
s 0 20
sto
si 0 0
zoo 2
zoo epd 20 60
zoo yan f1 -3 -1
zoo thi s2 -367.537 -315.138
zoo thc s2 100 100
zoo thi s3 361.23 309.476
zoo thi s4 -141.965 -153.809
zoo thi s5 82.1242 94.6211
zoo ade s2 30 30
zoo adc s2 100 100
zoo ade s3 -4.16261 -4.865
zoo ade s4 29.95 31.425
zoo ade s5 9.692 8.91938
"""


@pytest.mark.parametrize(("position", "focal_length", "field"), [(None, 100, -3), (1, 100, -3), (2, 300, -1)])
def test_zoom_positions_of_four_mirrors_have_the_focal_lengths_they_were_designed_for(
    tmp_path, position, focal_length, field
):
    path = tmp_path / "zoom.seq"
    path.write_text(FOUR_MIRRORS)
    system = read_seq(path, None, position)
    found = paraxial(system)
    assert abs(found.focal_length) == pytest.approx(focal_length, rel=1e-5)
    assert found.f_number == pytest.approx(5.0, rel=1e-5)
    assert abs(found.defocus) < 1e-4
    assert np.rad2deg(system.fields[0, 1]) == pytest.approx(field)
    assert ("The file has 2 configurations; this is number 1" in system.note) == (position is None)
    for none in (3, 0, -1):
        with pytest.raises(UserError, match=f"has 2 zoom positions; there is no number {none}"):
            read_seq(path, None, none)


def test_a_zoom_position_is_the_lens_with_its_numbers_in_place(tmp_path):
    """Of the lens, of fields and surfaces: their own line, commands behind it, one that was not there."""
    zooms = (
        "ZOO 2; ZOO EPD 10 12; ZOO YAN F2 3 4; ZOO VUY F2 0.2 0.1; ZOO RDY S1 61.5 62; ZOO THI S5 80 81\n"
        "ZOO K S3 -0.5 -0.6; ZOO A S4 1e-6 2e-6; ZOO K S4 0 0.1; ZOO CIR S1 8 9; ZOO WTW 1 1\n"
    )
    changed = SEQ
    for one, other in (
        ("EPD 10.0", "EPD 12"),
        ("YAN 0.0 3.0", "YAN 0 4"),
        ("VUY 0.0 0.2", "VUY 0 0.1"),
        ("S 61.5 6.0", "S 62 6.0"),
        ("S 0.0 80.0", "S 0 81"),
        ("K -0.5", "K -0.6"),
        ("A 1.0e-6; B 2e-9", "A 2e-6; B 2e-9; K 0.1"),
        ("CIR 8.0", "CIR 9"),
    ):
        assert changed.count(one) == 1
        changed = changed.replace(one, other)
    (tmp_path / "zoom.seq").write_text(SEQ.replace("GO\n", zooms))
    (tmp_path / "plain.seq").write_text(changed)
    ours, theirs = read_seq(tmp_path / "zoom.seq", None, 2), read_seq(tmp_path / "plain.seq")
    assert [(one.shape, one.opening) for one in ours.surfaces] == [
        (o.shape, o.opening) for o in theirs.surfaces
    ]
    np.testing.assert_array_equal(ours.surfaces[-1].position, theirs.surfaces[-1].position)
    np.testing.assert_array_equal(ours.fields, theirs.fields)
    np.testing.assert_array_equal(ours.vignetting, theirs.vignetting)
    assert ours.pupil == theirs.pupil


@pytest.mark.parametrize(("mode", "line"), [("RDM", 50.0), ("RDM N", 0.02)])
@pytest.mark.parametrize("zoom", ["RDY S1 50 80", "CUY S1 0.02 0.0125"])
def test_a_zoom_position_gives_radii_and_curvatures_whichever_lines_of_surfaces_give(
    tmp_path, mode, line, zoom
):
    lens = f"DIM M; EPD 5; WL 550; YAN 0; SO 0 1e13; S1 {line} 5 NBK7_SCHOTT; STO; S 0 90; SI 0 0"
    (tmp_path / "zoom.seq").write_text(f"{mode}; LEN; {lens}; ZOO 2; ZOO {zoom}; GO\n")
    radii = [read_seq(tmp_path / "zoom.seq", None, one).surfaces[0].shape.radius for one in (1, 2)]
    assert radii == pytest.approx([50.0, 80.0])


GRATING = """RDM;LEN
DIM {unit}
EPD 1.0
WL 500
SO 0.0 0.1e14
S {radius} {distance} {glass}
  DIF GRT
  GRO {order}; GRS {spacing}{more}
  STO
SI 0.0 0.0
"""


@pytest.mark.parametrize("glass", ["", "REFL"])
@pytest.mark.parametrize(
    ("more", "turned"),
    [("", 0.0), ("; GRX 3; GRY 4; GRZ 0", np.arctan2(3, 4)), ("; GRX 1; GRY 0", np.pi / 2)],
)
@pytest.mark.parametrize(("unit", "mm"), [("M", 1.0), ("I", 25.4)])
def test_gratings_bend_light_by_their_order(glass, more, turned, unit, mm):
    """sin = order wavelength / spacing along the vector across the grooves."""
    distance = -100.0 if glass else 100.0
    words = {"radius": 0.0, "distance": distance / mm, "glass": glass, "unit": unit, "more": more}
    system = read(GRATING.format(order=-2, spacing=1 / 300 / mm, **words))
    x, y = np.array([0.1, -0.2]), np.array([0.3, 0.05])
    start = Rays(np.stack([x, y, [-5.0, -5.0]]), np.array([[0.0], [0.0], [1.0]]) * np.ones(2), np.zeros(2))
    found = trace_sequence(pack(system, 500e-6), start, moving(system, rest_states(system)), NUMPY)
    away = 100.0 * np.tan(np.arcsin(-2 * 500e-6 * 300.0))
    np.testing.assert_allclose(found.x[0], x + away * np.sin(turned), rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.y[0], y + away * np.cos(turned), rtol=0, atol=1e-11)


def test_a_grating_without_an_order_is_refused():
    words = {"radius": 0.0, "distance": 9.0, "glass": "", "unit": "M", "spacing": 0.01, "more": ""}
    text = GRATING.format(order=1, **words).replace("GRO 1; ", "")
    with pytest.raises(UserError, match=r"is a grating without an order \(GRO\)"):
        read(text)


def test_a_grating_on_an_asphere_keeps_its_powers():
    text = GRATING.format(
        radius=50.0, distance=30, glass="N-BK7", unit="M", order=1, spacing=0.01, more="; ASP; A 1e-6"
    )
    surface = read(text).surfaces[0]
    np.testing.assert_allclose(surface.shape.coefficients, [0.0, 1e-6], rtol=1e-15)
    np.testing.assert_allclose(surface.phase.polynomial, [0.0, 2 * np.pi / 0.01], rtol=1e-15)


@pytest.mark.parametrize(("unit", "mm"), [("M", 1.0), ("I", 25.4)])
def test_diffractive_lenses_focus_by_their_paths(unit, mm):
    """A path C1 r^2 at its wavelength is a lens of f = -1 / (2 C1), shorter for longer waves."""
    text = GRATING.format(radius=0.0, distance=80 / mm, glass="", unit=unit, order=1, spacing=1, more="")
    text = text.replace("DIF GRT", "DIF DOE").replace("GRO 1; GRS 1", f"HWL 400; HCT R; HCO C1 {-mm / 200!r}")
    assert paraxial(read(text)).focal_length == pytest.approx(100.0 * 400 / 500, rel=1e-12)


def test_a_public_hybrid_lens_focuses_where_its_file_has_the_image():
    """Number 65988 of a catalogue, a test of ray-optics (CODV_65988.seq, BSD): E48R has the index 1.53116."""
    text = """RDM;LEN
EPD 12.0
DIM M
WL 587.5618
XAN 0.0
SO 0.0 0.1e14
S 9.93 3.7 1.53116:56.0
  STO
  CIR 6.0
  ASP
  K -0.71
  A -0.1581980090969e-4; B -0.2770951746068999e-6; C -0.1216086045095e-8; D 0.0
  DIF DOE
  HOR 1.0
  HWL 587.5618; HCT R
  HCO C1 -0.001807322521767816; HCC C1 100
S -48.3 12.94603127272
SI 0.0 0.0
"""
    system = read(text)
    assert paraxial(system).back_focus == pytest.approx(12.94603127272, abs=1e-5)
    y = np.linspace(0.5, 5.5, 6)
    rays = Rays(np.stack([0 * y, y, 0 * y - 1.0]), np.array([[0.0], [0.0], [1.0]]) * np.ones(6), np.zeros(6))
    found = trace_sequence(pack(system, 587.5618e-6), rays, moving(system, rest_states(system)), NUMPY)
    assert np.abs(found.y).max() < 3e-5
