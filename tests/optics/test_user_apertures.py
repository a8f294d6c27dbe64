"""User-defined apertures of lens files: polygons beside each other, whose corners stand in the file."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.trace.sequential_numpy import on_glass
from wavequake.optics.rays.packing import opening_regions
from wavequake.optics.zemax.read import parse_zmx

SQUARE = [(-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0), (1.0, -1.0)]  # clockwise


def lens(*polygons, keyword="USAP", scale=1.0, unit="MM", shift=(0.0, 0.0)):
    rows = [f'UDAD 0 "A B.UDA" {scale}']
    number = 0
    for corners in polygons:
        for x, y in (*corners, (0.0, 0.0)):
            number += 1
            rows.append(f"UDAD {number} {x} {y} 0")
    lines = "\n".join(f"  {row}" for row in (f"{keyword} 0 0 0", f"OBDC {shift[0]} {shift[1]}", *rows))
    head = f"UNIT {unit}\nENPD 10\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0\nYFLN 0\nSURF 0\n  DISZ INFINITY\n"
    return f"{head}SURF 1\n  STOP\n  DISZ 10\n  CURV 0.01\n  GLAS N-BK7\n{lines}\nSURF 2\n  DISZ 0\n"


def moved(corners, x, y):
    return [(a + x, b + y) for a, b in corners]


def passes(text, x, y):
    opening = parse_zmx(text, "lens.zmx").surfaces[0].opening
    return on_glass(opening_regions(opening), x, y)


def in_squares(centers, half, x, y):
    return np.any([(abs(x - a) < half) & (abs(y - b) < half) for a, b in centers], axis=0)


POINTS = np.random.default_rng(3).uniform(-12.0, 12.0, (2, 20000))


@pytest.mark.parametrize(
    "centers",
    [[(3.0, 0.0)], [(-6.0, 0.0), (0.0, 0.5), (6.0, 1.0)], [(-6, -6), (6, -6), (6, 6), (-6, 6), (0, 3)]],
)
def test_light_passes_in_any_of_the_polygons(centers):
    text = lens(*(moved(SQUARE, *center) for center in centers))
    np.testing.assert_array_equal(passes(text, *POINTS), in_squares(centers, 1.0, *POINTS))


def test_light_is_stopped_in_any_of_them():
    centers = [(-6.0, 0.0), (5.0, 2.0)]
    text = lens(*(moved(SQUARE, *center) for center in centers), keyword="USOB")
    np.testing.assert_array_equal(passes(text, *POINTS), ~in_squares(centers, 1.0, *POINTS))


def test_corners_have_a_scale_the_file_s_unit_and_a_center():
    text = lens(moved(SQUARE, 2.0, 0.0), scale=0.5, unit="CM", shift=(-0.2, 0.1))
    expected = in_squares([(10.0 - 2.0, 1.0)], 5.0, *POINTS)
    np.testing.assert_array_equal(passes(text, *POINTS), expected)


@pytest.mark.parametrize(
    ("polygons", "why"),
    [
        ([], "three corners"),
        ([SQUARE[:2]], "three corners"),
        ([SQUARE, [(0.5 * x, 0.5 * y) for x, y in SQUARE]], "a polygon in another"),
        ([SQUARE, moved(SQUARE, 1.0, 0.5)], "a polygon in another"),
        ([moved(SQUARE, 3.0, 0.0), [(1.0, -0.1), (1.0, 0.1), (5.0, 0.1), (5.0, -0.1)]], "touch or cross"),
        ([[(1, 0), (2, 2), (2, 0), (1, 2)]], "crosses itself"),
    ],
)
def test_polygons_that_are_no_aperture_are_refused(polygons, why):
    with pytest.raises(UserError, match=why):
        parse_zmx(lens(*polygons), "lens.zmx")


def test_corners_of_another_kind_are_refused():
    text = lens(SQUARE).replace("UDAD 2 -1.0 1.0 0", "UDAD 2 -1.0 1.0 2")
    with pytest.raises(UserError, match="a corner of the kind 2"):
        parse_zmx(text, "lens.zmx")


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ('UDA" 1.0', 'UDA" nan', "'nan' is not the scale"),
        ('UDA" 1.0', 'UDA" -2', "'-2' is not the scale"),
        ('UDA" 1.0', 'UDA" 1e308', "more than 1e"),
        ("UDAD 2 ", "UDAD 1 ", r"whose line 1 \(UDAD\) stands there twice"),
        ("  UDAD 1 ", '  UDAD 0 "A B.UDA" 0.5\n  UDAD 1 ', r"whose line 0 \(UDAD\) stands there twice"),
        ("UDAD 2 -1.0", "UDAD 2 -1e200", "more than 1e"),
    ],
)
def test_scales_and_corners_that_make_no_sense_are_refused_by_their_line(old, new, why):
    text = lens(SQUARE)
    assert old in text
    with pytest.raises(UserError, match=rf"line \d+ \(UDAD\).*{why}"):
        parse_zmx(text.replace(old, new), "lens.zmx")
