"""Fields, vignetting factors, glasses and problems of lens files."""

import math
import re

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import VIGNETTED
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.media.agf import parse_agf
from wavequake.optics.media.glasses import constant, glass, refractive_index
from wavequake.optics.rays.aiming import pupil_rays
from wavequake.optics.rays.field_light import field_light, inside_ellipse
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.systems.info import info
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.zemax.read import parse_zmx
from wavequake.workflows.systems.source import described

LENS = "SURF 1\n  CURV 0.02\n  GLAS {glass}\n  DISZ 4\nSURF 2\n  CURV -0.02\n  DISZ 3\n"
LENS += "SURF 3\n  STOP\n  DISZ 45\n"


def lens(header, glass="N-BK7 0 0", distance="INFINITY", behind=""):
    top = "ENPD 5\nWAVM 1 0.55 1\n" + header
    return f"{top}\nSURF 0\n  DISZ {distance}\n{LENS.format(glass=glass)}SURF 4\n{behind}"


def read(*args, glasses=None, **kwargs):
    return parse_zmx(lens(*args, **kwargs), "lens.zmx", glasses)


def chief_image(system, field):
    wavelength = float(system.wavelengths[0])
    chief = pupil_rays(system, field, wavelength, np.zeros(1), np.zeros(1))
    traced = trace_sequence_numpy(pack(system, wavelength), chief, moving(system, rest_states(system)), True)
    return np.array([traced.x[0, 0], traced.y[0, 0]])


FIELDS = "XFLN 0 0.5 0\nYFLN 0 7 10"


@pytest.mark.parametrize("distance", ["INFINITY", "200"])
def test_real_image_heights_are_where_chief_rays_arrive(distance):
    system = read(f"FTYP 3 0 3 1\n{FIELDS}", distance=distance)
    for field, height in zip(system.fields, [(0, 0), (0.5, 7), (0, 10)], strict=True):
        np.testing.assert_allclose(chief_image(system, field), height, rtol=0, atol=1e-9)


def test_paraxial_image_heights():
    """h' = f tan(field) of a star, and the magnification times the height of a near object."""
    far = read(f"FTYP 2 0 3 1\n{FIELDS}")
    np.testing.assert_allclose(np.tan(far.fields[1:, 1]) * paraxial(far).focal_length, [7, 10], rtol=1e-12)
    near = read(f"FTYP 2 0 3 1\n{FIELDS}", distance="200")
    np.testing.assert_allclose(near.fields[1:, 1] * paraxial(near).magnification, [7, 10], rtol=1e-12)


def test_angles_of_a_near_object_are_at_the_entrance_pupil():
    system = read(f"FTYP 0 0 3 1\n{FIELDS}", distance="200")
    to_pupil = 200 + paraxial(system).entrance_pupil
    np.testing.assert_allclose(system.fields[2], [0, -math.tan(math.radians(10)) * to_pupil], rtol=1e-12)


def test_theodolite_angles():
    """An azimuth about y, then an elevation: direction cosines (sin a cos e, sin e, cos a cos e)."""
    system = read("FTYP 4 0 1 1\nXFLN 20\nYFLN 30")
    a, e = np.deg2rad([20, 30])
    cosines = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    np.testing.assert_allclose(np.tan(system.fields[0]), cosines[:2] / cosines[2], rtol=1e-12)


def test_an_aperture_of_the_object_is_that_of_its_real_ray():
    """n sin(theta) 0.2 in water, 60 mm before the stop's plane without anything between."""
    text = "OBNA 0.2 0\nWAVM 1 0.55 1\nFTYP 1 0 1 1\nSURF 0\n  DISZ 60\n  GLAS ___BLANK 1 0 1.33 0 0\n"
    text += "SURF 1\n  STOP\n  DISZ 10\n  GLAS ___BLANK 1 0 1.33 0 0\nSURF 2\n"
    system = parse_zmx(text, "lens.zmx")
    assert system.medium == constant(1.33)
    assert system.pupil.value == pytest.approx(60 * math.tan(math.asin(0.2 / 1.33)), rel=1e-12)


def test_vignetting_factors_stop_what_lies_outside_of_their_ellipse():
    factors = "VDXN 0 0.1\nVDYN 0 -0.2\nVCXN 0 0.3\nVCYN 0 0.4\nVANN 0 30\n"
    system = read(f"{factors}FTYP 0 0 2 1\nYFLN 0 5")
    rays = sunflower(0.0, 1.0, 4000)
    wavelength = float(system.wavelengths[0])
    whole = field_light(system, 0, wavelength, rays.x, rays.y)
    assert not whole.lost.any()
    aimed = field_light(system, 1, wavelength, rays.x, rays.y)
    # The ellipse has the area pi 0.7 0.6 and lies inside of the circle but for a corner of a few percent.
    assert np.mean(~aimed.lost) == pytest.approx(0.7 * 0.6, abs=0.01)
    assert set(aimed.status[aimed.lost]) == {VIGNETTED}
    assert set(aimed.surface[aimed.lost]) == {system.stop}
    assert "Vignetting factors leave of the stop, in % by field: 100, 42." in info(system)
    # Points that the factors make of the pupil's rim, as the format defines them.
    u = 0.999 * np.exp(1j * np.linspace(0, 2 * np.pi, 50))
    made = ((0.1 + 0.7 * u.real) + 1j * (-0.2 + 0.6 * u.imag)) * np.exp(1j * np.deg2rad(30))
    assert inside_ellipse(made.real, made.imag, system.vignetting[1]).all()
    made = ((0.1 + 0.7 * 1.01 * u.real) + 1j * (-0.2 + 0.6 * 1.01 * u.imag)) * np.exp(1j * np.deg2rad(30))
    assert not inside_ellipse(made.real, made.imag, system.vignetting[1]).all()


def test_glasses_are_those_of_the_catalogues_that_the_file_names():
    assert read("GCAT HOYA SCHOTT\nFTYP 0", glass="BAF2 0 0").surfaces[0].medium == glass("HOYA:BAF2")
    assert read("GCAT CDGM HOYA\nFTYP 0", glass="BAF2 0 0").surfaces[0].medium == glass("CDGM:BAF2")
    crystal = read("FTYP 0", glass="BAF2 0 0").surfaces[0].medium
    assert refractive_index(crystal, 587.5618e-6) == pytest.approx(1.47448, abs=1e-5)
    elsewhere = read("GCAT SCHOTT\nFTYP 0", glass="S-BSL7 0 0 1.516330 64.14")
    assert elsewhere.note == (
        "The glass S-BSL7 is in none of the catalogues that the file names (SCHOTT); that of OHARA was taken."
    )
    stale = read("GCAT SCHOTT\nFTYP 0", glass="N-BK7 0 0 1.62 36.4")
    assert (
        stale.note == "The index of N-BK7 is 1.5168 by its catalogue (taken) and 1.62 by line 9 of the file."
    )
    assert read("GCAT SCHOTT\nFTYP 0", glass="N-BK7 0 0 1.5 40").note == ""  # what is written for unknown


def test_glasses_of_the_user_go_first():
    own = parse_agf("NM N-BK7 1 0 1.6 60\nCD 2.56 0 0 0 0 0\nLD 0.3 2\n", "mine.agf")
    assert read("GCAT SCHOTT\nFTYP 0", glasses=own).surfaces[0].medium == own["N-BK7"]


def test_a_model_glass_whose_name_and_index_are_of_the_catalogue_is_that():
    assert read("FTYP 0", glass="N-BK7 1 0 1.5168 64.17 0").surfaces[0].medium == glass("N-BK7")
    model = read("FTYP 0", glass="N-BK7 1 0 1.6 60 0").surfaces[0].medium
    assert refractive_index(model, 587.5618e-6) == pytest.approx(1.6, abs=1e-12)


def test_all_problems_are_told_at_once_with_their_lines(tmp_path):
    text = lens("FTYP 0\nGFAC 1 9", glass="UNOBTAINIUM 0 0", behind="  TYPE NONSENSE\n")
    path = tmp_path / "lens.zmx"
    path.write_text(text)
    with pytest.raises(UserError) as told:
        described(str(path), [])
    message = f"{told.value}\n{told.value.details}"
    assert "cannot be traced, for 3 reasons" in message
    assert [int(line) for line in re.findall(r"- line (\d+) ", message)] == [4, 9, 18]
    assert "surface 2         STANDARD  -50       3" in message
    assert "UNOBTAINIUM" in message.split("What the file holds")[1]


def test_properties_that_are_not_understood_are_named_once():
    system = read("FTYP 0", behind="  SSID 3\n  TOLE 1\n")
    text = lens("FTYP 0").replace("  STOP", "  SSID 1\n  STOP") + "  SSID 2\n  TOLE 1\n"
    note = parse_zmx(text, "lens.zmx").note
    assert "properties that are not understood and were left aside: SSID (line 14), TOLE (line 19)." in note
    assert info(system).count("SSID") == 1


def test_operands_behind_the_surfaces_are_no_header():
    assert read("FTYP 0", behind="ENPD 0 0 0\nFNUM 1\nMNUM 3 2\n").note == (
        "The file has 3 configurations; this is number 2, in which it was saved."
    )


def rows(radii, thicknesses, glasses, stop):
    """The surfaces of a file, stop counted from 1."""
    lines = []
    for number, (radius, thickness, name) in enumerate(
        zip(radii, thicknesses, glasses, strict=True), start=1
    ):
        lines += [f"SURF {number}", f"  CURV {1 / radius!r}", f"  DISZ {thickness!r}"]
        lines += [f"  GLAS {name} 0 0"] if name else []
        lines += ["  STOP"] if number == stop else []
    return "SURF 0\n  DISZ INFINITY\n" + "\n".join(lines) + f"\nSURF {len(radii) + 1}\n"


def test_figures_that_opticstudio_prints():
    """A Cooke triplet and a singlet, as published in Optiland's issue 710."""
    radii = (22.01359, -435.76044, -22.21328, 20.29192, 79.68360, -18.39533)
    glasses = ("SK16", "", "F2", "", "SK16", "")
    between = (3.25896, 6.00755, 0.99997, 4.75041, 2.95208, 42.20778)
    header = "GCAT SCHOTT\nENPD 10\nWAVM 1 0.48 1\nWAVM 2 0.55 1\nWAVM 3 0.65 1\nPWAV 2\n"
    header += "FTYP 0 0 3 3\nYFLN 0 14 20\n"
    of_hikari = {"SK16": glass("HIKARI:SK16")}
    cooke = paraxial(parse_zmx(header + rows(radii, between, glasses, 4), "lens.zmx", of_hikari))
    assert cooke.focal_length == pytest.approx(49.99978307143194, rel=1e-12)
    assert cooke.entrance_pupil == pytest.approx(11.51215867374679, rel=1e-12)
    header = "GCAT HOYA\nENPD 25\nWAVM 1 0.4861327 1\nWAVM 2 0.5875618 1\nWAVM 3 0.6562725 1\n"
    header += "PWAV 2\nFTYP 0\n"
    text = rows((63.73364157, 653.2939232), (10.0, 92.7383463), ("LAC9", ""), 2)
    singlet = paraxial(parse_zmx(header + text, "lens.zmx"))
    assert singlet.focal_length == pytest.approx(101.501826, abs=5e-7)
    assert singlet.entrance_pupil == pytest.approx(6.318809, abs=5e-7)
    assert singlet.exit_pupil_diameter == pytest.approx(23.39711, abs=5e-6)
    assert singlet.f_number == pytest.approx(4.060073, abs=5e-7)
    assert -singlet.defocus == pytest.approx(2.255622, abs=5e-7)


def test_a_ring_shaped_obscuration_is_an_opening_and_is_named():
    system = parse_zmx(lens("FTYP 0").replace("  STOP", "  OBSC 4 9 0\n  STOP"), "lens.zmx")
    assert (system.surfaces[2].opening.outer, system.surfaces[2].opening.inner) == (4.0, 0.0)
    assert system.note == (
        "Ring-shaped obscurations stop here all light beyond their inner radius: surface 3."
    )


def test_light_that_converges_to_a_virtual_object_is_imaged_without_aberration_at_the_aplanatic_point():
    """Toward R (1 + n) behind a sphere it meets at R (1 + 1 / n), on paths that are equal."""
    n, radius = 1.5, 40.0
    system = parse_zmx(
        f"OBNA 0.12 0\nWAVM 1 0.55 1\nFTYP 1 0 1 1\nYFLN 0\nSURF 0\n  DISZ {-radius * (1 + n)}\n"
        f"SURF 1\n  STOP\n  CURV {1 / radius}\n  GLAS ___BLANK 1 0 {n} 0 0\n  DISZ {radius * (1 + 1 / n)}\n"
        "SURF 2\n",
        "lens.zmx",
    )
    edge = sunflower(0.0, 1.0, 60)
    rays = pupil_rays(system, system.fields[0], 550e-6, edge.x, edge.y)
    assert np.hypot(*rays.direction[:2]).max() == pytest.approx(0.12, rel=0.02)
    found = trace_sequence_numpy(pack(system, 550e-6), rays, moving(system, rest_states(system)), True)
    np.testing.assert_allclose([found.x, found.y], 0.0, rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.path, 0.0, rtol=0, atol=1e-12)  # so much forth as back
    assert paraxial(system).object_na == pytest.approx(0.12, rel=0.02)
    assert "virtual, 100 mm behind surface 1" in info(system)
