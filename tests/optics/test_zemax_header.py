"""What the header of a lens file says beside the lens."""

from pathlib import Path

import pytest

from wavequake import load_study
from wavequake.errors import UserError
from wavequake.optics.systems.info import info
from wavequake.optics.zemax.read import parse_zmx, read_zmx
from wavequake.workflows.run import notices

COOKE = Path(__file__).parents[1] / "data" / "cooke_triplet.zmx"
# What a current version writes before the surfaces, as far as it changes no light.
WRITTEN = """VERS 180508 24 104309
NOTE 0 off axis
PFIL 0 0 0
LANG 0
ENVD 20 1 0
GFAC 0 0
GCAT SCHOTT CDGM NOA61
RAIM 0 1 1 1 0 0 0 0 0 1
PUSH 0 0 0 0 0 0
SDMA 0 1 0
OMMA 1 1
ROPD 2
HYPR 0
PICB 1
FWGN 1
VDXN 0
VANN 0
POLS 1 0 1 0 0 1 0
GLRS 1 0
GSTD 0 100.000 100.000 100.000 100.000 100.000 100.000 0 1 1 0 0 1 1 1 1 1 1
NSCD 100 500 0 0.001 10 1e-06 0 0 0 0 0 0 1000000 0 2
COFN QF "COATING.DAT" "SCATTER_PROFILE.DAT" "ABG_DATA.DAT" "PROFILE.GRD"
"""


def lens(header="", behind=""):
    beam = "MODE SEQ\nENPD 10\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0\n"
    rows = "SURF 0\n  DISZ INFINITY\nSURF 1\n  CURV 0.01\n  GLAS N-BK7 0 0\n  DISZ 3\n  STOP\n"
    return parse_zmx(beam + header + rows + "SURF 2\n  DISZ 90\nSURF 3\n" + behind, "lens.zmx")


def test_a_header_as_it_is_written_says_nothing_of_the_light():
    behind = "EFLY 1 12 0 0 0 0 0 0 0 0\nBLNK \nTOL TOFF 0 0\nMNUM 1 1\nMOFF 0 1\nENPD 3 0 0\n"
    assert lens(WRITTEN, behind).note == ""
    assert read_zmx(COOKE).note == ""


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("ENVD x 1 1", "'x' is not a number"),
        ("GFAC -1 1", r"line 5 \(GFAC\): the factor of the Gaussian apodization is -1; it must be 0 to 20"),
        ("GFAC nan 1", r"line 5 \(GFAC\)"),
        ("GFAC 0 7", r"line 5 \(GFAC\): the apodization of the pupil is of type 7"),
    ],
)
def test_what_changes_the_light_is_refused_by_name_and_line(line, match):
    with pytest.raises(UserError, match=match):
        lens(line + "\n")


@pytest.mark.parametrize(
    "line", ["ENVD -80 0 0", "ENVD 2.0E+1 1 1", "ENVD 35", "GFAC 1 0", "GFAC 0 1", "GFAC 0"]
)
def test_what_is_switched_off_or_neutral_passes(line):
    assert lens(line + "\n").note == ""


def test_what_is_not_understood_is_named():
    note = lens("WARP 9\nFOOB 1 2\n").note
    assert "WARP (line 5), FOOB (line 6)." in note
    assert "If they change the light" in note
    assert "X7 (line 12) and 3 more." in lens("".join(f"X{i} 1\n" for i in range(11))).note


def test_info_and_run_print_what_is_not_understood(tmp_path):
    path = tmp_path / "odd.zmx"
    path.write_text("WARP 9\n" + COOKE.read_text())
    assert "WARP (line 1)" in info(read_zmx(path))
    study = tmp_path / "study.toml"
    text = """
[study]
name = "odd"
workflow = "system-disturbance"
[system]
file = "FILE"
[[disturbance]]
name = "shake"
model = "surface-vibration"
of = ["front"]
instants = 4
lines = [{ frequency_hz = 85.0, amplitude = { dy_um = 3.0 } }]
"""
    study.write_text(text.replace("FILE", path.name))
    (notice,) = notices(load_study(study))
    assert "WARP (line 1)" in notice
    study.write_text(text.replace("FILE", str(COOKE)))
    assert list(notices(load_study(study))) == []
