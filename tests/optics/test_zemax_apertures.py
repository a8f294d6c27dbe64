"""Apertures of the beam in Zemax files."""

import math

import numpy as np
import pytest
from test_zemax import STOP, lens, read

from wavequake.errors import UserError
from wavequake.kernels.trace.sequential_numpy import on_glass
from wavequake.optics.rays.packing import opening_regions
from wavequake.optics.systems.system import Pupil
from wavequake.optics.zemax.read import parse_zmx


def test_apertures_of_the_beam():
    def pupil(text, row=STOP):
        return read(row, header=f"{text}\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0").pupil

    assert pupil("FNUM 4 0") == Pupil("f_number", 4.0)
    near = lens(STOP, header="OBNA 0.6 0\nWAVM 1 0.55 1\nFTYP 1 0 1 1 0 0 0").replace("INFINITY", "7")
    assert parse_zmx(near, "lens.zmx").pupil == Pupil("stop", pytest.approx(7 * 0.75))  # tan of asin 0.6
    cone = near.replace("OBNA 0.6 0", f"OBNA {math.degrees(math.asin(0.6))!r} 1")
    assert parse_zmx(cone, "lens.zmx").pupil.value == pytest.approx(7 * 0.75)
    with pytest.raises(UserError, match=r"up to 160 degrees off the axis; below 90 is traced"):
        parse_zmx(near.replace("OBNA 0.6 0", "OBNA 160 1"), "lens.zmx")
    assert pupil("FLOA", STOP + "\n  DIAM 3.5") == Pupil("stop", 3.5)


def test_a_decentered_aperture_is_about_its_center():
    header = "UNIT CM\nENPD 10\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0"
    for line, inside, outside in (
        ("CLAP 0.1 1 0", [(31.5, -20), (38, -20)], [(30, -20), (41, -20), (0, 0)]),
        ("OBSC 0 1 0", [(0, 0), (41, -20)], [(30, -20), (39, -20)]),
        ("SQAP 1 2 0", [(39, -1), (21, -39)], [(41, -20), (30, 1), (0, 0)]),
        ("SPID 0.1 1 0", [(29, -20), (31, -19)], [(31, -20), (90, -20.4)]),
    ):
        opening = read(STOP + f"\n  {line}\n  OBDC 3 -2", header=header).surfaces[0].opening
        assert opening.center == (30.0, -20.0)
        x, y = np.array([*inside, *outside], float).T
        passed = [True] * len(inside) + [False] * len(outside)
        assert on_glass(opening_regions(opening), x, y).tolist() == passed


def test_an_elliptic_aperture_is_a_polygon_of_its_area():
    system = read("  STOP\n  ELAP 2 3 0\n  OBDC 0.5 0\n  DISZ 1")
    opening = system.surfaces[0].opening
    corners = np.array(opening.corners)
    x, y = corners.T
    area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    assert area == pytest.approx(np.pi * 2.0 * 3.0, rel=1e-12)
    np.testing.assert_allclose((x / 2.0) ** 2 + (y / 3.0) ** 2, 1.0, atol=1.5e-3)
    assert opening.center == (0.5, 0.0)
    assert "Elliptic apertures are polygons of 72 corners and the same area here: surface 1." in system.note
    place = np.array([0.5 + 1.99, 0.5 + 2.01, 0.5, 0.5, 0.5 - 1.99]), np.array([0.0, 0.0, 2.99, 3.01, 0.0])
    inside = on_glass(opening_regions(opening), *place)
    np.testing.assert_array_equal(inside, [True, False, True, False, True])
    with pytest.raises(UserError, match="an aperture of 0 by 3 mm; both must be positive"):
        read("  STOP\n  ELAP 0 3 0\n  DISZ 1")


def test_spider_arms_reach_outwards_at_equal_angles():
    opening = read(STOP + "\n  SPID 2 3 0").surfaces[0].opening
    blocked = [
        not on_glass(opening_regions(opening), np.array([x]), np.array([y]))[0]
        for x, y in [(5, 0.9), (5, 1.1), (-5, 0.0), (-2.5, 4.33), (-2.5, -4.33), (0.0, 5.0)]
    ]
    assert blocked == [True, False, False, True, True, False]
