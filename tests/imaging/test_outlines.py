import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.imaging.engines.polygon_transform import polygon_areas
from wavequake.imaging.pupils.outlines import annulus, blocked, disc, segments, vane

SQUARE = np.array([[0, 0], [2, 0], [2, 2], [0, 2.0]])
CROSSING = np.array([[0, 0], [3, 0], [3, 2], [1, -1.0]])


def area(outline):
    return float(outline.sign @ polygon_areas(outline.corners))


def test_circles_and_rings_have_their_areas():
    assert area(annulus(2.0)) == pytest.approx(4 * np.pi, rel=1e-12)
    assert area(annulus(2.0, 0.5)) == pytest.approx(3.75 * np.pi, rel=1e-12)
    assert np.abs(np.hypot(*disc(1.0).T) - 1).max() < 3e-7


def test_a_cross_of_vanes_blocks_its_middle_once():
    cross = blocked(blocked(segments(SQUARE[None]), vane([-1, 1], [3, 1], 0.2)), vane([1, -1], [1, 3], 0.3))
    assert area(cross) == pytest.approx(4 - 2 * 0.2 - 2 * 0.3 + 0.2 * 0.3, rel=1e-12)


def test_a_vane_cuts_a_ring_by_the_chords_area():
    outline = blocked(annulus(1.0, 0.4), vane([0, 0], [2, 0], 0.1))

    def half_strip(radius, half):  # of a disc, 0 < x, |y| < half
        return half * np.sqrt(radius**2 - half**2) + radius**2 * np.arcsin(half / radius)

    lost = half_strip(1.0, 0.05) - half_strip(0.4, 0.05)
    assert area(outline) == pytest.approx(np.pi * (1 - 0.16) - lost, abs=1e-7)


def test_an_obstruction_keeps_pieces_apart():
    two = segments(np.stack([SQUARE, SQUARE + np.array([3.0, 0.0])]))
    shadowed = blocked(two, disc(0.5, (3.0, 1.0), corners=64))
    areas = np.bincount(shadowed.piece, shadowed.sign * polygon_areas(shadowed.corners))
    assert areas == pytest.approx([4.0, 4.0 - np.pi / 8], rel=1e-12)


def test_an_obstruction_elsewhere_changes_nothing():
    outline = segments(SQUARE[None])
    assert blocked(outline, SQUARE + 5.0) is outline


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: disc(0.0), "radius of a disc"),
        (lambda: vane([1, 1], [1, 1], 0.1), "length and a width"),
        (lambda: vane([0, 0], [1, 1], -0.1), "length and a width"),
        (lambda: segments(SQUARE[None, ::-1]), "counter-clockwise"),
        (lambda: segments(CROSSING[None]), "segment 0 crosses or touches itself"),
        (lambda: blocked(annulus(1.0), CROSSING), "an obstruction crosses or touches itself"),
        (lambda: blocked(annulus(1.0), SQUARE * np.nan), "not a finite number"),
    ],
)
def test_bad_outlines_are_refused(build, message):
    with pytest.raises(UserError, match=message):
        build()
