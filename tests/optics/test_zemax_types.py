"""Tilted planes, irregular surfaces, long aspheres, phases and picked-up glasses in Zemax files.

Radii of spots are those that OpticStudio printed as semi-diameters of the image in its samples "Irregular
surface" and "Test Spherical", whose numbers stand here.
"""

import math

import numpy as np
import pytest
from test_zemax import lens, read

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential import trace_sequence
from wavequake.kernels.trace.sequential_numpy import on_glass
from wavequake.optics.rays.aiming import aimed_rays
from wavequake.optics.rays.packing import moving, opening_regions, pack
from wavequake.optics.shapes.sag import shape_sag
from wavequake.optics.systems.axis_ray import follow_axis
from wavequake.optics.systems.info import info
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.zemax.export import zmx_text
from wavequake.optics.zemax.read import parse_zmx

STOP = "  STOP\n  DISZ 5"
GLASS = "  GLAS ___BLANK 1 0 1.5 0"


def ends(system, x, y, direction=(0.0, 0.0, 1.0)):
    """Where rays from (x, y) before the first surface meet the image, and their directions there."""
    start = np.array([x, y, np.zeros(len(x))], float)
    turned = np.repeat(np.array(direction, float)[:, None] / np.linalg.norm(direction), len(x), axis=1)
    found = trace_sequence(
        pack(system, 550e-6),
        Rays(start, turned, np.zeros(len(x))),
        moving(system, rest_states(system)),
        NUMPY,
    )
    return found.x[0], found.y[0], found.u[0], found.v[0]


def spot(system):
    """The largest distance of the rim's rays from the axis on the image."""
    angle = np.arange(0.0, 2.0 * np.pi, np.pi / 4.0)
    rays = aimed_rays(system, system.fields[0], 550e-6, np.cos(angle), np.sin(angle)).rays
    found = trace_sequence(pack(system, 550e-6), rays, moving(system, rest_states(system)), NUMPY)
    return float(np.hypot(found.x, found.y).max())


def test_a_tilted_plane_is_a_wedge_that_leaves_the_axes_as_they_are():
    system = read(STOP, f"  DISZ 4\n{GLASS}", "  TYPE TILTSURF\n  PARM 1 0\n  PARM 2 0.2\n  DISZ 10")
    (y,) = ends(system, [0.0], [0.5])[1]
    angle = math.atan(0.2)
    bent = math.asin(1.5 * math.sin(angle)) - angle  # Snell's law at the inclined face
    height = 0.5 * 0.2  # of the face where the ray leaves it
    assert y == pytest.approx(0.5 + math.tan(bent) * (10.0 - height), abs=1e-12)
    assert [float(one.position[2]) for one in system.surfaces] == pytest.approx([0.0, 5.0, 9.0, 19.0])
    *_, last = follow_axis(system, 550e-6)  # first-order data follow the axis through it
    assert last.direction[1] == pytest.approx(math.sin(bent), abs=1e-12)


def test_a_tilted_mirror_folds_and_its_aperture_is_that_of_its_projection():
    tilted = "  TYPE TILTSURF\n  PARM 1 -0.3\n  PARM 2 1\n  GLAS MIRROR\n  CLAP 0 2 0\n  OBDC 0.5 0\n  DISZ 0"
    system = read(STOP, tilted)
    mirror = system.surfaces[1]
    normal = np.array([0.3, -1.0, 1.0]) / math.sqrt(2.09)
    np.testing.assert_allclose(mirror.rotation[:, 2], normal, atol=1e-15)
    for angle, share in ((0.3, 0.99), (2.0, 0.99), (2.0, 1.01), (4.4, 1.01)):
        x, y = 0.5 + share * 2.0 * math.cos(angle), share * 2.0 * math.sin(angle)
        here = np.array([x, y, -0.3 * x + y]) @ mirror.rotation
        assert here[2] == pytest.approx(0.0, abs=1e-14)
        assert on_glass(opening_regions(mirror.opening), here[:1], here[1:2])[0] == (share < 1.0)
    with pytest.raises(UserError, match="tilted plane with a ring as aperture"):
        read(STOP, tilted.replace("CLAP 0 2", "CLAP 1 2"))


def test_light_on_a_tilted_image_is_measured_along_the_axes_before_it():
    rows = "  DISZ INFINITY", STOP, "  TYPE TILTSURF\n  PARM 1 0.1\n  PARM 2 -0.4"
    text = "ENPD 10\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0\nYFLN 0\n"
    system = parse_zmx(text + "\n".join(f"SURF {k}\n{row}" for k, row in enumerate(rows)) + "\n", "lens.zmx")
    x, y, _, _ = ends(system, [0.7], [-2.0])
    assert (x[0], y[0]) == pytest.approx((0.7, -2.0), abs=1e-12)


def test_long_aspheres_are_powers_of_the_distance_over_a_radius():
    x, y = np.array([0.3, -2.0, 1.0]), np.array([0.4, 0.0, 2.0])
    r = np.hypot(x, y) * 0.1  # cm
    conic = 0.02 * r**2 / (1 + np.sqrt(1 - 0.5 * 0.02**2 * r**2))
    base = "  CURV 0.02\n  CONI -0.5\n  DISZ 1\n  XDAT 1 3\n  XDAT 2 0.7\n  XDAT 4 1e-3\n  XDAT 5 -2e-3"
    header = "UNIT CM\nENPD 1\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0"
    for kind, powers in (("XASPHERE", (4, 6)), ("XOSPHERE", (2, 3))):
        shape = read("  STOP", f"  TYPE {kind}\n{base}", header=header).surfaces[1].shape
        wanted = conic + 1e-3 * (r / 0.7) ** powers[0] - 2e-3 * (r / 0.7) ** powers[1]
        np.testing.assert_allclose(shape_sag(shape, x, y)[0], 10.0 * wanted, rtol=1e-13)


IRREGULAR = """  TYPE IRREGULA
  CURV 9.889001092500000400E-003
  PARM 1 -4.
  PARM 2 5.0E-1
  PARM 3 1.0E-1
  PARM 4 0
  PARM 5 -6.6666666667E-2
  PARM 6 -3.E-1
  PARM 7 1.0E-1
  PARM 8 0
  DISZ 1.0E+2
  DIAM 2.4E+1 1 0 0 1"""


def test_an_irregular_surface_makes_the_spot_that_opticstudio_prints():
    front = "  CURV 2.605930725899999900E-002\n  DISZ 1.2E+1\n  GLAS SCHOTT:BK7\n  CONI -4.3367133876E-1"
    header = "ENPD 40\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0\nYFLN 0"
    system = read(STOP, front, IRREGULAR, header=header)
    assert spot(system) == pytest.approx(2.482866715753, rel=1e-11)
    with pytest.raises(UserError, match="parameter 8 of the type IRREGULA must be 0"):
        read(STOP, front, IRREGULAR.replace("PARM 8 0", "PARM 8 30"), header=header)
    with pytest.raises(UserError, match="irregularities at its rim, but no semi-diameter"):
        read(STOP, front, IRREGULAR.replace("DIAM 2.4E+1", "DIAM 0"), header=header)


def test_fringe_phases_in_waves_make_the_spots_that_opticstudio_prints():
    # -2 Z1 - 3 Z4 - Z9 is -6 rho^4: the rim's light meets the axis 2 mm before the paraxial focus.
    numbers = {1: 9, 2: 4, 3: -2, 6: -3, 11: -1}
    phase = "  TYPE FZERNPHA\n  STOP\n  PARM 0 1\n  PARM 1 0\n  DISZ 0\n" + "\n".join(
        f"  XDAT {k} {value}" for k, value in numbers.items()
    )
    header = "ENPD 4\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0\nYFLN 0"
    found = [
        spot(read(phase, f"  TYPE PARAXIAL\n  PARM 1 100\n  DISZ {way}", header=header)) for way in (98, 100)
    ]
    assert found == pytest.approx([0.0004250034392839, 0.04125000350947], rel=1e-11)
    reversed_ = read(
        phase.replace("PARM 0 1", "PARM 0 -1"), "  TYPE PARAXIAL\n  PARM 1 100\n  DISZ 98", header=header
    )
    assert spot(reversed_) > 0.08


def test_light_is_aimed_at_a_stop_that_stands_far_off_the_axis():
    # An Offner relay (OpticStudio's sample): the axis ray meets its convex mirror at 35 degrees.
    rows = [
        "  DISZ 10",
        "  TYPE COORDBRK\n  PARM 2 -3\n  DISZ 0",
        "  CURV -0.1\n  GLAS MIRROR\n  DISZ -4.7631336931",
        "  STOP\n  CURV -0.190954258\n  GLAS MIRROR\n  DISZ 4.7631336931\n  DIAM 1",
        "  CURV -0.1\n  GLAS MIRROR\n  DISZ -10",
        "",
    ]
    text = "FLOA\nWAVM 1 0.55 1\nFTYP 0 0 2 1 0 0 0\nYFLN 0 1E-2\n"
    system = parse_zmx(text + "\n".join(f"SURF {k}\n{row}" for k, row in enumerate(rows)) + "\n", "lens.zmx")
    for field in system.fields:
        assert not aimed_rays(system, field, 550e-6, np.zeros(3), np.array([0.0, 0.9, -0.9])).lost.any()


def test_a_toroidal_grating_is_a_toroid_with_grooves():
    row = (
        "  TYPE TOROGRAT\n  CURV -0.0025\n  PARM 1 -390\n  PARM 2 0.4\n  PARM 3 1\n  GLAS MIRROR\n  DISZ -100"
    )
    system = read(STOP, row)
    grating = system.surfaces[1]
    x, y = np.array([3.0]), np.array([4.0])
    height = -400.0 + math.sqrt(400.0**2 - 16.0)
    wanted = -390.0 + math.sqrt((390.0 + height) ** 2 - 9.0)
    assert shape_sag(grating.shape, x, y)[0][0] == pytest.approx(wanted, rel=1e-12)
    assert ends(system, [0.0], [0.0])[3][0] == pytest.approx(550e-6 * 400.0, rel=1e-9)  # m lambda lines


def test_a_glass_of_another_surface_is_that_surfaces():
    model = "  DISZ 3\n  GLAS ___BLANK 1 0 1.6 40 0"
    system = read(
        STOP,
        model,
        "  DISZ 1",
        "  DISZ 3\n  GLAS ___BLANK 2 2 1.5 40",
        "  DISZ 1\n  GLAS ___BLANK 2 3 1.5 40",
    )
    media = [one.medium for one in system.surfaces]
    assert media[3] == media[1]
    assert media[4].name == "air"
    assert [one.action for one in system.surfaces[3:5]] == ["refract", "refract"]
    with pytest.raises(UserError, match="takes the glass of surface 7, which does not"):
        read(STOP, "  DISZ 3\n  GLAS ___BLANK 2 7 1.5 40")


def test_a_number_of_six_digits_is_a_glass():
    medium = read(STOP, "  DISZ 3\n  GLAS 517642 0 0 1.5 40").surfaces[1].medium
    assert medium == read(STOP, "  DISZ 3\n  GLAS ___BLANK 1 0 1.517 64.2 0").surfaces[1].medium


def test_numbers_of_a_coordinate_return_stand_in_the_file():
    turned = "  TYPE COORDBRK\n  SCBD 3 1 1\n  PARM 3 -19.5\n  PARM 6 1\n  DISZ 20"
    plain = read(STOP, turned.replace("  SCBD 3 1 1\n", ""), "  DISZ 1")
    for one, other in zip(read(STOP, turned, "  DISZ 1").surfaces, plain.surfaces, strict=True):
        np.testing.assert_array_equal(one.rotation, other.rotation)


DARK = {
    "SQOB 1 2 0": ([(0, 0), (9, 19)], [(11, 0), (0, 21), (500, 0)]),
    "ELOB 1 2 0": ([(0, 0), (9.9, 0), (0, 19.9)], [(9, 19), (10.1, 0), (0, 500)]),
    "OBSC 1 2 0": ([(11, 0), (0, -19), (-14, 0.1)], [(0, 0), (9.9, 0), (0, 21), (-500, 0)]),
}


@pytest.mark.parametrize("line", DARK)
def test_light_passes_beside_dark_rectangles_ellipses_and_rings(line):
    header = "UNIT CM\nENPD 200\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0"
    system = read(f"{STOP}\n  {line}\n  OBDC 3 -2\n  DIAM 60 1 0 0 1", header=header)
    dark, bright = DARK[line]
    x, y = np.array([*dark, *bright], float).T + np.array([[30.0], [-20.0]])
    passed = [False] * len(dark) + [True] * len(bright)
    opening = system.surfaces[0].opening
    assert on_glass(opening_regions(opening), x, y).tolist() == passed
    assert "dark polygon" in info(system)
    again = parse_zmx(zmx_text(system), "again.zmx").surfaces[0].opening
    np.testing.assert_allclose(again.dark, opening.dark, rtol=1e-12)


def test_a_ring_at_the_rim_and_an_obscuration_of_no_size():
    assert read(f"{STOP}\n  OBSC 3 8 0\n  DIAM 5 1 0 0 1").surfaces[0].opening.outer == 3.0
    assert read(f"{STOP}\n  OBSC 0 0 0").surfaces[0].opening is None
    with pytest.raises(UserError, match="0 by 2 mm; both must be positive"):
        read(f"{STOP}\n  SQOB 0 2 0")
    with pytest.raises(UserError, match="an aperture of another form"):
        parse_zmx(lens(f"{STOP}\n  UDAP 1 1 2 0"), "lens.zmx")


@pytest.mark.parametrize("mode", [0, 2])
def test_of_a_crystal_the_ordinary_ray_is_that_of_a_glass(mode):
    crystal = "TYPE BIRE__IN\n  PARM 1 {mode}\n  PARM 4 1\n  CURV 0.01\n  GLAS CALCITE\n  DISZ 5"
    out = "  TYPE BIRE_OUT\n  CURV -0.02\n  DISZ 40"
    mine = parse_zmx(lens(STOP, "  " + crystal.format(mode=mode), out), "lens.zmx")
    theirs = parse_zmx(
        lens(STOP, "  CURV 0.01\n  GLAS CALCITE\n  DISZ 5", "  CURV -0.02\n  DISZ 40"), "lens.zmx"
    )
    assert "Of crystals the ordinary ray is traced, as the file does: surface 2." in mine.note
    for one, other in zip(mine.surfaces, theirs.surfaces, strict=True):
        assert (one.shape, one.medium, one.action) == (other.shape, other.medium, other.action)
    with pytest.raises(UserError, match="the extraordinary ray is traced"):
        parse_zmx(lens(STOP, "  " + crystal.format(mode=1), out), "lens.zmx")


def test_a_file_of_more_surfaces_than_can_be_traced_is_refused_at_once():
    with pytest.raises(UserError, match="has 128 surfaces; at most 126 can be traced"):
        parse_zmx(lens(STOP, *["  DISZ 1"] * 126), "lens.zmx")
