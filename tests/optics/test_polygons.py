import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.optics.segments.arrangements import tmt_segments
from wavequake.optics.segments.layout import jwst_segments, tmt18_segments
from wavequake.optics.shapes.polygons import (
    centroids,
    distance_from_origin,
    edge_lines,
    inset,
    overlapping,
    polygons_at,
    protrusion,
    signed_areas,
)

SETS = {
    "tmt": tmt_segments().corners,
    "tmt-18": tmt18_segments().corners,
    "jwst": jwst_segments().corners,
}


def regular(count, radius, x=0.0, y=0.0):
    angle = 2 * np.pi * np.arange(count) / count + 0.1
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)


def signed_distances(corners, x, y):
    """Distances (S, N) of points to all edges of every polygon; negative inside."""
    start, end = corners[..., None], np.roll(corners, -1, axis=1)[..., None]
    x1, y1, along_x, along_y = start[:, :, 0], start[:, :, 1], *np.moveaxis(end - start, 2, 0)
    part = np.clip(((x - x1) * along_x + (y - y1) * along_y) / (along_x**2 + along_y**2), 0.0, 1.0)
    nearest = np.hypot(x - x1 - part * along_x, y - y1 - part * along_y).min(axis=1)
    inside = (along_x * (y - y1) - along_y * (x - x1) >= 0.0).all(axis=1)
    return np.where(inside, -nearest, nearest)


def test_area_and_centroid_of_a_triangle_far_away():
    triangle = np.array([[[1e6, 2e6], [1e6 + 3.0, 2e6], [1e6, 2e6 + 4.0]]])
    assert signed_areas(triangle) == pytest.approx([6.0], rel=1e-15)
    np.testing.assert_allclose(centroids(triangle), [[1e6 + 1.0, 2e6 + 4 / 3]], rtol=1e-15)
    assert signed_areas(triangle[:, ::-1]) == pytest.approx([-6.0])


def test_a_repeated_corner_changes_nothing():
    square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
    padded = np.array([[*square, square[-1], square[-1]]])
    assert signed_areas(padded) == pytest.approx([4.0])
    np.testing.assert_allclose(centroids(padded), [[1.0, 1.0]])
    expected = [[0, -1, 0], [1, 0, 2], [0, 1, 2], [0, 0, 1e9], [0, 0, 1e9], [-1, 0, 0]]
    np.testing.assert_allclose(edge_lines(padded)[0], expected, rtol=0, atol=1e-15)
    assert protrusion(padded)[0] <= 0.0
    assert polygons_at(padded, np.array([1.0]), np.array([1.9]), 0.0).tolist() == [[0]]


@given(st.integers(3, 9), st.floats(0.1, 0.9))
def test_inset_of_a_regular_polygon_is_a_smaller_one(count, part):
    polygon, inradius = regular(count, 2.0), 2.0 * np.cos(np.pi / count)
    smaller = inset(polygon[None], part * inradius)[0]
    np.testing.assert_allclose(smaller, (1.0 - part) * polygon, rtol=0, atol=1e-13)


def test_protrusion_finds_dents_and_crossings():
    dented = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [2.0, 1.0], [0.0, 4.0]]
    turn = 4 * np.pi / 5 * np.arange(5)
    star = np.stack([np.cos(turn), np.sin(turn)], axis=1)  # turns left everywhere, twice around
    assert (protrusion(np.array([dented, star])) > 0.5).all()
    assert protrusion(regular(7, 3.0)[None])[0] <= 1e-15


@given(st.floats(0.0, 6.3), st.floats(0.1, 9.0))
def test_disks_overlap_by_the_depth_of_their_overlap(azimuth, distance):
    x, y = distance * np.cos(azimuth), distance * np.sin(azimuth)
    pair = np.array([regular(64, 2.0), regular(64, 2.0, x, y)])  # nearly disks of radius 2
    depth = 4.0 - distance
    if abs(depth) > 0.02:
        assert overlapping(pair, 0.0).tolist() == ([[0, 1]] if depth > 0.0 else [])
        assert overlapping(pair, 4.1).size == 0


def test_no_segments_overlap_but_every_neighbor_does_when_they_grow():
    for corners in SETS.values():
        assert overlapping(corners, 1e-3).size == 0
    pairs = overlapping(inset(SETS["tmt"], -2.0), 1e-3)
    assert len(pairs) == 1386  # shared edges of the 492 segments


@pytest.mark.parametrize("name", SETS)
@given(seed=st.integers(0, 2**32 - 1))
def test_every_point_is_found_on_the_polygon_that_contains_it(name, seed):
    corners = SETS[name]
    extent = 1.05 * np.abs(corners).max()
    x, y = np.random.default_rng(seed).uniform(-extent, extent, (2, 40))
    distance = signed_distances(corners, x, y)
    expected = np.where(distance.min(axis=0) <= 0.0, distance.argmin(axis=0), -1)
    assert polygons_at(corners, x, y, 0.0)[:, 0].tolist() == expected.tolist()


@pytest.mark.parametrize("name", SETS)
@given(seed=st.integers(0, 2**32 - 1), margin=st.sampled_from([0.5, 5.0, 300.0]))
def test_points_find_all_polygons_within_the_margin(name, seed, margin):
    corners = SETS[name]
    extent = 1.05 * np.abs(corners).max()
    x, y = np.random.default_rng(seed).uniform(-extent, extent, (2, 40))
    found = polygons_at(corners, x, y, margin)
    distance = signed_distances(corners, x, y)
    for ray, row in enumerate(found):
        chosen = row[row >= 0]
        assert len(set(chosen)) == len(chosen)
        assert set(np.flatnonzero(distance[:, ray] <= margin)) <= set(chosen)
        assert (distance[chosen, ray] <= 1.2 * margin).all()  # a hexagon's mitered corner: 2/sqrt(3)
        if distance[:, ray].min() < 0.0:
            assert row[0] == distance[:, ray].argmin()
        assert (row[len(chosen) :] == -1).all()
    assert found.shape[1] == max(1, (found >= 0).sum(axis=1).max())


def test_polygons_of_very_different_sizes_and_points_outside_are_found():
    corners = np.array([regular(6, 100.0), regular(6, 0.1, 150.0, 0.0), regular(6, 0.1, 0.0, -1e4)])
    x = np.array([0.0, 150.0, 0.0, 1e9, np.nan, -np.inf, 0.0])
    y = np.array([0.0, 0.0, -1e4, 0.0, 0.0, 0.0, -5e3])
    assert polygons_at(corners, x, y, 0.0)[:, 0].tolist() == [0, 1, 2, -1, -1, -1, -1]
    assert polygons_at(corners, x[:0], y[:0], 0.0).shape == (0, 1)


def test_the_number_of_points_does_not_change_the_answer():
    x, y = np.random.default_rng(1).uniform(-15e3, 15e3, (2, 70_000))  # more than one block
    whole = polygons_at(SETS["tmt-18"], x, y, 0.0)[:, 0]
    part = polygons_at(SETS["tmt-18"], x[65_000:], y[65_000:], 0.0)[:, 0]
    assert (whole[65_000:] == part).all()


def test_distance_from_the_origin():
    square = np.array([[2.0, -1.0], [4.0, -1.0], [4.0, 1.0], [2.0, 1.0]])
    corners = np.array([square, np.add(square, [0.0, 4.0]), np.subtract(square, [3.0, 0.0])])
    np.testing.assert_allclose(distance_from_origin(corners), [2.0, np.hypot(2.0, 3.0), 0.0])
