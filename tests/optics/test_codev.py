"""CODE V's sequence files against the same lens as a .zmx file."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.optics.media.glasses import glass
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
        ("  K -0.5", "  K -0.5\n  ADE 3.0", r"line 21 \(ADE\): ADE changes the light"),
        ("  STO", "  GRT\n  STO", r"GRT changes the light"),
        ("RDM;", "", r"line 14 \(S\): the file does not say whether it gives radii"),
        ("REF 2", "REF 2\nZOO 3", "zoom positions"),
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
