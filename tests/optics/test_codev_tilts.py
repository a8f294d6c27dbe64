"""Tilted and decentered surfaces of CODE V's sequence files against another tracer."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.optics.rays.packing import moving, pack
from wavequake.optics.segments.kinematics import cardan
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.zemax.codev import read_seq


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
