import csv
import json
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.optics.segments.arrangements import tmt_segments
from wavequake.optics.segments.layout import (
    areas,
    candidates,
    half_planes,
    hexagon_ring_segments,
    is_monolithic,
    jwst_segments,
    monolithic,
    polygons_from_csv,
    segments_on_conic,
    tmt18_segments,
)

DATA = Path(__file__).parents[1] / "data"
TO_OPTICS = np.array([1.0, 1.0, -1.0])


def table(name):
    with open(DATA / name, newline="") as stream:
        rows = list(csv.DictReader(stream))
    numbers = np.array([[float(value) for key, value in row.items() if key != "id"] for row in rows])
    return [row["id"] for row in rows], numbers


def test_the_tmt_is_the_official_one():
    segments = tmt_segments()
    names, numbers = table("tmt_segments.csv")  # in m, z to the sky
    assert list(segments.names) == names
    np.testing.assert_allclose(segments.centers * TO_OPTICS / 1e3, numbers[:, :3], rtol=0, atol=1e-9)
    np.testing.assert_allclose(segments.axes[:, :, 2], numbers[:, 3:6], rtol=0, atol=1e-8)
    np.testing.assert_allclose(segments.axes[:, :, 0], numbers[:, 6:9], rtol=0, atol=1e-8)
    np.testing.assert_allclose(segments.corners.reshape(492, 12) / 1e3, numbers[:, 9:], rtol=0, atol=1e-9)


def test_the_tmt_has_its_published_area():
    assert areas(tmt_segments()).sum() / 1e6 == pytest.approx(653.2832935644483, rel=1e-12)


def test_tmt_gaps_are_what_is_asked_for():
    closed, open_ = tmt_segments(gap=0.0).corners, tmt_segments(gap=10.0).corners
    # Without gaps segments share vertices: 492 hexagons with 1386 shared and 180 free edges have
    # 492 - 1566 + vertices = 0 (a disk with a hole), so 1074 of them.
    assert len(np.unique(np.round(closed.reshape(-1, 2), 6), axis=0)) == 1074
    # On each edge the gap takes half its width of glass.
    perimeter = np.linalg.norm(closed - np.roll(closed, 1, axis=1), axis=2).sum(axis=1)
    lost = areas(tmt_segments(gap=0.0)) - areas(tmt_segments(gap=10.0))
    np.testing.assert_allclose(lost, 5.0 * perimeter, rtol=0.05)  # projected, and short at the corners
    assert (np.linalg.norm(open_ - closed, axis=2) < 5.0 / np.cos(np.pi / 6) * 1.02).all()


@pytest.mark.parametrize("gap", [-1.0, float("nan"), 1240.0])
def test_impossible_gaps(gap):
    for build in (tmt_segments, lambda gap: tmt18_segments(1000.0, gap=gap * 2)):
        with pytest.raises(UserError, match="gap between segments is"):
            build(gap)


@pytest.mark.parametrize(
    ("segments", "radius", "conic"),
    [
        (tmt_segments(), -60000.0, -1.00095348),
        (tmt18_segments(), -60000.0, -1.0009535),
        (jwst_segments(), -15879.7, -1.0),
    ],
    ids=["tmt", "tmt-18", "jwst"],
)
def test_segments_stand_on_their_parent(segments, radius, conic):
    x, y, z = segments.centers.T
    assert z.max() < 0.0
    # The conic as an implicit surface: r^2 - 2 R z + (1 + k) z^2 = 0, with its gradient as the normal.
    residual = x**2 + y**2 - 2.0 * radius * z + (1.0 + conic) * z**2
    np.testing.assert_allclose(residual / (2.0 * radius), 0.0, rtol=0, atol=1e-11)
    gradient = np.stack([x, y, -radius + (1.0 + conic) * z], axis=1)
    to_sky = gradient / np.linalg.norm(gradient, axis=1, keepdims=True) * -TO_OPTICS
    np.testing.assert_allclose(segments.axes[:, :, 2], to_sky * np.sign(to_sky[:, 2:]), rtol=0, atol=1e-14)
    product = np.swapaxes(segments.axes, 1, 2) @ segments.axes
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(segments.axes), 1.0)
    assert (segments.axes[:, 2, 2] > 0.0).all()


def test_tmt18_is_the_circumscribed_reading():
    reference = json.loads((DATA / "tmt18_hexagons.json").read_text())
    segments = tmt18_segments()
    centers = [segment["center_m"] for segment in reference["segments"]]
    corners = [segment["corners_m"] for segment in reference["segments"]]
    np.testing.assert_allclose(segments.centers[:, :2] / 1e3, centers, rtol=0, atol=1e-13)
    np.testing.assert_allclose(segments.corners / 1e3, corners, rtol=0, atol=1e-13)
    assert segments.names == tuple(str(number) for number in range(1, 19))
    assert areas(segments).sum() / 1e6 == pytest.approx(553.8004555779436, rel=1e-13)


@pytest.mark.parametrize(
    ("side", "outermost", "hole", "area"),
    [
        (15000 / np.sqrt(19), 15000.0, 2980.197803396348, 553.8004555779436),
        (30000 / (5 * np.sqrt(3)), 15099.668870541501, 3000.0, 561.1844616523163),
        (15000 / np.sqrt(13), 18134.115744809666, 3602.8834606144606, 809.400665844687),
    ],
)
def test_all_readings_of_the_tmt18_follow_from_the_side(side, outermost, hole, area):
    segments = tmt18_segments(side)
    assert np.hypot(*segments.corners.reshape(-1, 2).T).max() == pytest.approx(outermost, rel=1e-14)
    # The nearest edge lines about the origin bound the hole.
    assert -half_planes(segments)[:6, :, 2].min() == pytest.approx(hole, rel=1e-14)
    assert areas(segments).sum() / 1e6 == pytest.approx(area, rel=1e-13)


@given(st.integers(1, 4), st.floats(10.0, 1e3), st.floats(0.0, 0.5))
def test_rings_of_hexagons(rings, side, part):
    gap = part * side
    segments = hexagon_ring_segments(side, rings, gap)
    assert len(segments) == 3 * rings * (rings + 1)
    glass = 1.5 * np.sqrt(3) * (side - gap / np.sqrt(3)) ** 2
    np.testing.assert_allclose(areas(segments), glass, rtol=1e-12)
    x, y = segments.centers[:, :2].T
    ring = np.repeat(np.arange(1, rings + 1), 6 * np.arange(1, rings + 1))
    azimuth = np.round(np.degrees(np.arctan2(y, x)), 6) % 360.0
    assert list(zip(ring, azimuth, strict=True)) == sorted(zip(ring, azimuth, strict=True))
    distance = np.hypot(x[:, None] - x, y[:, None] - y) + 1e9 * np.eye(len(x))
    np.testing.assert_allclose(distance.min(axis=1), np.sqrt(3) * side, rtol=1e-12)


@pytest.mark.parametrize("side", [0.0, -1.0, float("inf"), float("nan")])
def test_impossible_sides(side):
    with pytest.raises(UserError, match="side of a hexagonal segment"):
        tmt18_segments(side)


def test_the_jwst_has_its_published_polygons():
    segments = jwst_segments()
    names, numbers = table("jwst_centroids.csv")
    assert list(segments.names) == names
    np.testing.assert_allclose(segments.centers[:, :2] / 1e3, numbers[:, :2], rtol=0, atol=2e-9)
    np.testing.assert_allclose(areas(segments) / 1e6, numbers[:, 2], rtol=1e-9)
    assert areas(segments).sum() / 1e6 == pytest.approx(26.6409, abs=5e-5)
    # The published circumscribed diameter; corners are given to the micrometer.
    diameter = 2 * np.hypot(*segments.corners.reshape(-1, 2).T).max()
    assert diameter == pytest.approx(6603.464, abs=2e-3)


def test_local_x_axes_point_along_the_global_one():
    axes = jwst_segments().axes
    np.testing.assert_allclose(
        axes[:, 1, 0], -axes[:, 0, 2] * axes[:, 1, 2] / np.hypot(*axes[:, 1:, 2].T), rtol=0, atol=1e-15
    )
    assert (axes[:, 0, 0] > 0.9).all()
    np.testing.assert_allclose(
        axes[:, 0, 1], 0.0, rtol=0, atol=1e-16
    )  # y has no component along the global x axis


def test_a_users_table_with_pivots():
    text = "id,cx_m,cy_m,x1_m,y1_m,x2_m,y2_m,x3_m,y3_m\nA,1.25,0.5,1,0,2,0,1,1\n"
    segments = polygons_from_csv(StringIO(text), -4000.0, -1.0)
    np.testing.assert_allclose(segments.centers, [[1250.0, 500.0, -(1250.0**2 + 500.0**2) / 8000.0]])
    middle = polygons_from_csv(StringIO(text.replace("cx_m", "notes")), -4000.0, -1.0).centers
    np.testing.assert_allclose(middle[0, :2], [4000.0 / 3.0, 1000.0 / 3.0])


def test_a_segment_beyond_its_parent():
    corners = np.array([[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], [[3.0, 0.0], [6.0, 0.0], [3.0, 1.0]]])
    with pytest.raises(UserError, match="'far' reaches beyond the primary mirror's parent surface"):
        segments_on_conic(["near", "far"], corners, -5.0, 0.0)
    pivots = np.array([[6.0, 0.0], [0.0, 0.0]])
    with pytest.raises(UserError, match=r"'near' reaches beyond .* its pivot must lie on it"):
        segments_on_conic(["near", "far"], 0.5 * corners, -5.0, 0.0, pivots)


def test_a_monolithic_mirror_is_one_segment_without_edges():
    mirror = monolithic(15000.0)
    assert is_monolithic(mirror)
    assert not is_monolithic(tmt18_segments())
    assert len(mirror) == 1
    assert half_planes(mirror).shape == (1, 0, 3)
    assert np.isnan(areas(mirror)).all()
    assert candidates(mirror, np.zeros(3), np.ones(3), 5.0).tolist() == [[0]] * 3
    with pytest.raises(UserError, match="outer radius"):
        monolithic(0.0)
