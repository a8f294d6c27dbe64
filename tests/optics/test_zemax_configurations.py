"""Configurations of lens files: two perfect lenses at three distances, and what is refused."""

import numpy as np
import pytest

import wavequake as wq
from wavequake.errors import UserError
from wavequake.optics.systems.file import SystemSection, build
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.zemax.read import parse_zmx

GAPS = (25.0, 35.0, 50.0)
FIRST, SECOND = 100.0, -80.0


def behind(operands):
    """The lines of the editor: name, index, value in each configuration."""
    return "".join(
        f"{name} {index} {k} {value} 0 0 0 1 1 1.0 0.0 0\n"
        for name, index, values in operands
        for k, value in enumerate(values, start=1)
    )


OPERANDS = (
    ("MOFF", 0, ('""', '""', '""')),
    ("THIC", 1, GAPS),
    ("APER", 0, (10.0, 12.0, 14.0)),
    ("YFIE", 2, (1.0, 2.0, 3.0)),
    ("FVCY", 2, (0.0, 0.1, 0.2)),
    ("WAVE", 1, (0.5, 0.55, 0.6)),
)
LENS = """MODE SEQ
NAME zoom
UNIT MM
ENPD 12
FTYP 0 0 2 1
XFLN 0 0
YFLN 0 2
VCYN 0 0.1
WAVM 1 0.55 1
PWAV 1
SURF 0
  DISZ INFINITY
SURF 1
  STOP
  TYPE PARAXIAL
  PARM 1 100
  DISZ 35
SURF 2
  TYPE PARAXIAL
  PARM 1 -80
  DISZ 10
  MAZH 0 ZONE
SURF 3
  DISZ 0
MNUM 3 2
"""


def text(zone="0", operands=OPERANDS):
    return LENS.replace("ZONE", zone) + behind(operands) + "EFFL 0 1 0 0 0 0\n"


@pytest.mark.parametrize("zone", ["0", "0.7"])
@pytest.mark.parametrize("number", [1, 3])
def test_each_configuration_is_the_system_of_its_numbers(number, zone):
    system = parse_zmx(text(zone), "zoom.zmx", configuration=number)
    data, gap = paraxial(system), GAPS[number - 1]
    focal = 1.0 / (1.0 / FIRST + 1.0 / SECOND - gap / (FIRST * SECOND))
    assert data.focal_length == pytest.approx(focal, rel=1e-12)
    assert system.surfaces[-1].position[2] - gap == pytest.approx(focal * (1.0 - gap / FIRST), rel=1e-9)
    assert data.entrance_pupil_diameter == (10.0, 12.0, 14.0)[number - 1]
    np.testing.assert_allclose(system.fields[1], [0.0, np.deg2rad((1.0, 2.0, 3.0)[number - 1])])
    assert system.wavelengths[0] == pytest.approx((0.5e-3, 0.55e-3, 0.6e-3)[number - 1])
    shares = [one[3] for one in system.vignetting] or [0.0, 0.0]
    assert shares == [0.0, (0.0, 0.1, 0.2)[number - 1]]
    assert system.name == f"zoom, configuration {number}"
    assert system.note == ""


def test_the_configuration_in_which_it_was_saved_is_that_of_the_file():
    plain, chosen = parse_zmx(text(), "zoom.zmx"), parse_zmx(text(), "zoom.zmx", configuration=2)
    assert paraxial(plain).entrance_pupil_diameter == paraxial(chosen).entrance_pupil_diameter == 12.0
    assert plain.surfaces[1].position[2] == chosen.surfaces[1].position[2] == 35.0
    assert "3 configurations; this is number 2, in which it was saved" in plain.note


def test_studies_and_commands_name_a_configuration(tmp_path, wavequake):
    path = tmp_path / "zoom.zmx"
    path.write_text(text())
    assert wq.load_system(path, {"configuration": 3}).surfaces[1].position[2] == 50.0
    section = SystemSection(file_text=text(), configuration=1)
    assert build(section).surfaces[1].position[2] == 25.0
    assert section.model_dump()["configuration"] == 1
    assert "configuration" not in SystemSection(file_text=text()).model_dump()
    code, out, err = wavequake("info", path, "configuration=3")
    assert code == 0, err
    assert "zoom, configuration 3" in out


def test_a_value_that_the_saved_configuration_does_not_have_is_taken_all_the_same():
    """The surface is 35 mm from the next one in the file, which was saved in number 2."""
    system = parse_zmx(text("0", (("THIC", 1, (25.0, 99.0, 99.0)),)), "zoom.zmx", configuration=3)
    assert system.surfaces[1].position[2] == 99.0


def test_one_of_thousands_of_configurations():
    gaps = [20.0 + 0.001 * k for k in range(5000)]
    lens = text("0", (("THIC", 1, gaps),)).replace("MNUM 3 2", "MNUM 5000 2")
    assert parse_zmx(lens, "zoom.zmx", configuration=4999).surfaces[1].position[2] == gaps[4998]


def test_other_surfaces_of_the_editor_are_changed():
    operands = (
        ("CRVT", 1, (0.01, 0.02, 0.03)),
        ("CONN", 1, (-1.0, 0.0, -2.0)),
        ("SDIA", 1, (3.0, 4.0, 5.0)),
        ("THIC", 0, (1e10, 1e10, 80.0)),
    )
    lens = text("0", operands).replace(
        "TYPE PARAXIAL\n  PARM 1 100", "TYPE STANDARD\n  CURV 0.02\n  GLAS N-BK7"
    )
    system = parse_zmx(lens.replace("YFLN 0 2", "YFLN 0 0"), "zoom.zmx", configuration=1)
    assert (system.surfaces[0].shape.radius, system.surfaces[0].shape.conic) == (100.0, -1.0)
    assert np.isinf(system.object_distance)
    near = parse_zmx(lens.replace("YFLN 0 2", "YFLN 0 0"), "zoom.zmx", configuration=3)
    assert near.object_distance == 80.0


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        (text(), "zoom.zmx has 3 configurations; there is no number 4"),
        (text("0", ()), "does not say what its 3 configurations change"),
        (text("0", (("GLSS", 1, ("A", "B", "A")),)), "line 26 .GLSS.: the configuration changes GLSS"),
        (text("0", (("THIC", 9, (1, 2, 3)),)), "there is no surface 9"),
        (text("0", (("WAVE", 7, (1, 2, 3)),)), "there is no wavelength 7"),
        (text("0", (("YFIE", 0, (1, 2, 3)),)), "there is no field 0"),
        (text("0", (("THIC", 1, ("x", 2, 3)),)), "'x' is not a number"),
        (
            text()
            .replace("  PARM 1 100\n", "  PARM 1 100\n  CURV 0.0 6 1 1 0\n")
            .replace("THIC 1", "THIC 2"),
            "solve or pickup",
        ),
        (text().replace("MAZH 0 0", "PZUP 1 1 0"), "surface 2 has a number that a solve or pickup found"),
        (text("0").replace("MAZH 0 0", "MAZH 3 0"), "solved for a paraxial height other than 0"),
        (text("1e300"), r"solved for the zone 1e\+300; zones are between -1 and 1"),
        (
            text("0", (*OPERANDS, ("THIC", 1, (26, 35, 50)))),
            "line 44 .THIC.: THIC 1 has another value in line 29",
        ),
        (
            text().replace("THIC 1 3", "THIC 1 4"),
            "line 29 .THIC.: THIC must have a line for each of configur",
        ),
        (text().replace("THIC 1 2 35.0 0 0 0 1 1 1.0 0.0 0\n", ""), "THIC must have a line for each of"),
        (text().replace("MNUM 3 2", "MNUM 2 2"), "line 29 .THIC.: THIC must have a line for each of"),
        (text() + "MNUM 2 1\n", "line 45 .MNUM.: the number of configurations is given twice"),
        *(
            (
                text().replace("MNUM 3 2", f"MNUM {count} {saved}"),
                f"cannot have {count} configurations and be",
            )
            for count, saved in ((3, 0), (3, 4), (0, 0), (-3, 2))
        ),
    ],
)
def test_what_a_configuration_needs_and_has_not_is_told(lens, message):
    with pytest.raises(UserError, match=message):
        parse_zmx(lens, "zoom.zmx", configuration=4 if "number 4" in message else 1)


@pytest.mark.parametrize("given", ["two", 0, -1])
def test_a_configuration_is_a_number_from_1(given, tmp_path):
    path = tmp_path / "zoom.zmx"
    path.write_text(text())
    with pytest.raises(UserError, match="must be a number from 1"):
        wq.load_system(path, {"configuration": given})
    with pytest.raises(ValueError, match="configuration"):
        SystemSection(file_text=text(), configuration=given)


def test_only_lens_files_have_configurations():
    with pytest.raises(ValueError, match="configuration is that of a lens file; give file"):
        SystemSection(name="double-gauss", configuration=2)
