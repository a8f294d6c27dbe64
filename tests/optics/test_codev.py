"""CODE V's sequence files against the same lens as a .zmx file."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.optics.media.glasses import glass
from wavequake.optics.shapes.sag import shape_sag
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


SOLVED = """RDM;LEN
EPD 20.0
DIM M
WL 500.0
SO 0.0 0.1e14
S 50.000000025 5.0 BK7_SCHOTT
  STO
S 1175.711073142907 96.57283085039869
  CUY UMY -0.1
  THI HMY 0.0
SI 0.0 0.0
"""


def test_solves_stand_as_the_numbers_that_they_gave(tmp_path):
    # The marginal ray, 10 mm high, leaves with the slope -0.1, and meets the axis on the image.
    (tmp_path / "singlet.seq").write_text(SOLVED)
    data = paraxial(read_seq(tmp_path / "singlet.seq"))
    assert data.focal_length == pytest.approx(100.0, rel=1e-12)
    assert data.defocus == pytest.approx(0.0, abs=1e-10)
    for other in ("THI S1 8.0", "THI SO 200.0", "RDY SI -50.0", "THI SA 1.0", "THI NAN"):
        (tmp_path / "singlet.seq").write_text(SOLVED.replace("THI HMY 0.0", other))
        with pytest.raises(UserError, match=f"{other[:3]} changes the light"):
            read_seq(tmp_path / "singlet.seq")


@pytest.mark.parametrize("unit", ["M", "I"])
def test_aspheres_have_powers_up_to_the_twentieth(tmp_path, unit):
    mm = {"M": 1.0, "I": 25.4}[unit]
    given = {"A": 1e-3, "G": 2e-9, "H": -3e-10, "J": 4e-11}
    powers = "; ".join(f"{key} {value}" for key, value in given.items())
    text = SOLVED.replace("DIM M", f"DIM {unit}").replace("  STO\n", f"  STO\n  {powers}\n")
    (tmp_path / "asphere.seq").write_text(text)
    shape = read_seq(tmp_path / "asphere.seq").surfaces[0].shape
    r = 1.5  # units of the file
    height = 0.0 + sum(value * r ** (4 + 2 * "ABCDEFGHJ".index(key)) for key, value in given.items())
    conic = r**2 / 50.000000025 / (1.0 + np.sqrt(1.0 - (r / 50.000000025) ** 2))
    assert float(shape_sag(shape, r * mm, 0.0)[0]) == pytest.approx(mm * (height + conic), rel=1e-12)
