"""Segments and openings that are not convex: an L, a star, a comb, against Matplotlib's paths."""

from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.path import Path

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, list_devices
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.sequential_numpy import on_glass
from wavequake.kernels.trace.status import GAP, OK, lost_at
from wavequake.optics.rays.packing import opening_regions
from wavequake.optics.rays.pupils import PupilRays, segment_rays
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.layout import areas, candidates, segments_on_conic
from wavequake.optics.segments.modal_derivatives import modal_model
from wavequake.optics.segments.prepared import prepare, trace_states
from wavequake.optics.segments.telescope import with_segments
from wavequake.optics.shapes.concave import crossing, signed_distance, triangles
from wavequake.optics.shapes.polygon_table import read_polygons
from wavequake.optics.shapes.polygons import (
    centroids,
    concave,
    distance_from_origin,
    overlapping,
    polygons_at,
    signed_areas,
)
from wavequake.optics.shapes.shapes import Opening
from wavequake.optics.systems.kinematics import rest_states

L = np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 2], [0, 2.0]])
COMB = np.array(
    [[0, 0], [5, 0], [5, 2], [4, 2], [4, 1], [3, 1], [3, 2], [2, 2], [2, 1], [1, 1], [1, 2], [0, 2.0]]
)
TURN = np.pi / 5 * np.arange(10)
STAR = np.where(np.arange(10) % 2, 0.4, 1.0)[:, None] * np.stack([np.cos(TURN), np.sin(TURN)], axis=1)
SHAPES = {"L": L, "comb": COMB, "star": STAR}
DEVICES = list_devices()


def padded(*polygons):
    most = max(map(len, polygons))
    return np.stack([np.pad(p, ((0, most - len(p)), (0, 0)), "edge") for p in polygons])


def inside(polygon, x, y):
    return Path(polygon).contains_points(np.stack([x, y], axis=-1))


def star_shaped(seed, count):
    """A polygon whose corners are in order about the origin, no two of them more than half a turn apart."""
    random = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(count) + random.uniform(0, 0.8, count)) / count
    return random.uniform(0.1, 1.0, (count, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def test_areas_and_centroids_in_closed_form():
    corners = padded(L, COMB, STAR)
    # The star is ten triangles with the sides 1 and 0.4 and 36 degrees between them.
    np.testing.assert_allclose(signed_areas(corners), [4, 8, 2 * np.sin(np.pi / 5)], rtol=1e-14)
    expected = [[(1.5 * 3 + 0.5) / 4, (0.5 * 3 + 1.5) / 4], [2.5, (5 * 0.5 + 3 * 1.5) / 8], [0, 0]]
    np.testing.assert_allclose(centroids(corners), expected, rtol=0, atol=1e-15)
    assert concave(1e3 * corners).all()


@pytest.mark.parametrize("name", SHAPES)
def test_triangles_cover_a_polygon_once(name):
    shape = SHAPES[name]
    for corners in (shape, np.roll(shape, 3, axis=0), padded(shape, np.zeros((15, 2)))[0]):
        parts = triangles(corners[None])[0]
        assert parts.shape == (len(corners) - 2, 3, 2)
        assert (signed_areas(parts) >= 0.0).all()
        x, y = np.random.default_rng(4).uniform(-1.5, 5.5, (2, 3000))
        within = np.sum(
            [inside(part, x, y) for part, a in zip(parts, signed_areas(parts), strict=True) if a], axis=0
        )
        np.testing.assert_array_equal(within, inside(shape, x, y))


@given(st.integers(0, 2**32 - 1), st.integers(4, 16))
def test_any_star_shaped_polygon_falls_into_triangles_and_knows_its_inside(seed, count):
    corners = star_shaped(seed, count)[None]
    parts = signed_areas(triangles(corners)[0])
    assert (parts > 0.0).all()
    assert parts.sum() == pytest.approx(signed_areas(corners)[0], rel=1e-12)
    assert not crossing(corners)[0]
    x, y = np.random.default_rng(seed).uniform(-1, 1, (2, 200))
    distance = signed_distance(corners, x[:, None], y[:, None])[:, 0]
    np.testing.assert_array_equal(distance < 0.0, inside(corners[0], x, y))
    ends = corners[0], np.roll(corners[0], -1, axis=0)
    dense = np.concatenate([a + t * (b - a) for t in np.linspace(0, 1, 400) for a, b in [ends]])
    nearest = np.hypot(x[:, None] - dense[:, 0], y[:, None] - dense[:, 1]).min(axis=1)
    np.testing.assert_allclose(np.abs(distance), nearest, rtol=0, atol=5e-3)


@pytest.mark.parametrize(
    ("polygon", "crosses"),
    [
        ([[0, 0], [3, 0], [3, 2], [1, -1]], True),
        ([[0, 0], [4, 0], [4, 1], [2, 0], [0, 1]], True),  # a corner on an edge
        ([[0, 0], [4, 0], [4, 4], [2, 4], [2, 5], [2, 4], [0, 4]], True),  # out and back
        ([[0, 0], [2, 0], [1, 1], [2, 2], [0, 2], [1, 1]], True),  # a corner twice
        ([[0, 0], [4, 0], [4, 1], [2, 0.001], [0, 1]], False),
        ([[0, 0], [2, 0], [4, 0], [4, 1], [2, 0.5], [0, 1], [0, 1], [0, 1]], False),
    ],
)
def test_polygons_that_cross_or_touch_themselves_are_found(polygon, crosses):
    assert crossing(np.array([polygon], dtype=float))[0] == crosses


def test_points_find_the_polygon_they_lie_on_between_interlocking_ones():
    """A comb, the teeth of another one in its gaps, and a bar within the notch of an L."""
    teeth = COMB * [1, -1] + [1.0, 3.5]
    other = teeth[::-1]
    corners = padded(
        COMB, other, L + np.array([7, 0]), np.array([[8.2, 1.2], [10, 1.2], [10, 2], [8.2, 2.0]])
    )
    assert overlapping(corners, 1e-3).tolist() == []
    x, y = np.random.default_rng(2).uniform([[-0.5], [-0.5]], [[10.5], [4.5]], (2, 5000))
    expected = np.full(x.size, -1)
    for number, polygon in enumerate(corners):
        expected[inside(polygon, x, y)] = number
    assert (np.bincount(expected + 1) > 100).all()
    np.testing.assert_array_equal(polygons_at(corners, x, y, 0.0)[:, 0], expected)
    near = polygons_at(corners, x, y, 0.3)
    np.testing.assert_array_equal(np.where(expected >= 0, near[:, 0], -1), expected)
    distance = signed_distance(corners, x[:, None], y[:, None])
    np.testing.assert_array_equal((near >= 0).sum(axis=1), (distance <= 0.3).sum(axis=1))
    moved = corners.copy()
    moved[3] += [0.0, -0.3]
    assert overlapping(moved, 1e-3).tolist() == [[2, 3]]
    assert distance_from_origin(corners - np.array([1.5, 1.5])) == pytest.approx(
        [0.5, 0.0, 5.5, np.hypot(6.7, 0.0)]
    )


def test_tables_take_concave_polygons_and_refuse_those_that_cross_themselves():
    head = "id," + ",".join(f"x{k}_m,y{k}_m" for k in range(1, 7)) + "\n"
    row = "A," + ",".join(f"{x},{y}" for x, y in L)
    names, corners, _ = read_polygons(StringIO(head + row))
    assert names == ["A"]
    np.testing.assert_array_equal(corners[0], 1e3 * L)
    with pytest.raises(UserError, match="'A' crosses or touches itself"):
        read_polygons(StringIO(head + "A,0,0,3,0,3,1,1,-1,1,2,0,2"))
    with pytest.raises(UserError, match="'A' and 'B' overlap"):
        read_polygons(StringIO(head + row + "\nB,0.5,0.5,2,0.5,2,2,0.5,2"))


@pytest.fixture(scope="module")
def mirror():
    """A telescope whose segments are an L, a star and a comb of some meters."""
    shapes = padded(2e3 * L + [2e3, 2e3], 2.5e3 * STAR + [-6e3, 3e3], 1.2e3 * COMB + [-2e3, -7e3])
    plain = telescope("tmt-thesis")
    whole = segments_on_conic(
        ("L", "star", "comb"), shapes, plain.primary.shape.radius, plain.primary.shape.conic
    )
    return with_segments(plain, whole)


@pytest.mark.parametrize("points", [1, 3, 6, 12])
def test_rays_over_segments_integrate_over_their_glass(mirror, points):
    """Areas, centroids and second moments; those of the L are the sums of two rectangles'."""
    rays, corners = segment_rays(mirror.segments, points), mirror.segments.corners
    assert (rays.weight > 0.0).all()
    for segment, polygon in enumerate(corners):
        mine = rays.segment == segment
        assert inside(polygon, rays.x[mine], rays.y[mine]).all()
    share = np.bincount(rays.segment, rays.weight)
    np.testing.assert_allclose(share, areas(mirror.segments) / areas(mirror.segments).sum(), rtol=1e-12)
    for at, middle in ((rays.x, 0), (rays.y, 1)):
        mean = np.bincount(rays.segment, rays.weight * at) / share
        np.testing.assert_allclose(mean, centroids(corners)[:, middle], rtol=1e-12)
    if points > 1:
        u, v = ((at[rays.segment == 0] - 2e3) / 2e3 for at in (rays.x, rays.y))
        weight = 4.0 * rays.weight[rays.segment == 0] / share[0]
        assert weight @ u**2 == pytest.approx(27 / 3 + 1 / 3, rel=1e-12)
        assert weight @ v**2 == pytest.approx(3 / 3 + 7 / 3, rel=1e-12)
        assert weight @ (u * v) == pytest.approx(4.5 * 0.5 + 0.5 * 1.5, rel=1e-12)


@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.kind)
def test_rays_meet_the_glass_that_is_there_at_rest_and_moved(mirror, device):
    corners, random = mirror.segments.corners, np.random.default_rng(6)
    x, y = random.uniform(-9e3, 9e3, (2, 6000))
    expected = np.full(x.size, -1)
    for segment, polygon in enumerate(corners):
        expected[inside(polygon, x, y)] = segment
    found = candidates(mirror.segments, x, y)[:, 0]
    np.testing.assert_array_equal(found, expected)
    prepared = prepare(mirror, PupilRays(x, y, np.ones(x.size), expected), 550e-6, 4, margin=500.0)
    states = rest_states(mirror, TILE)
    states.segment_motion[1, :, 0] = [300.0, -200.0, 400.0]
    status = trace_states(prepared, states, device).status[0]
    assert (status[:, 0] == OK).all()
    for segment in range(3):
        mine = prepared.rays.segment == segment
        along = mirror.segments.axes[segment] @ [1.0, 0.0, 0.0]
        shift = states.segment_motion[1, segment, 0] * along[:2]
        at = prepared.rays.x[mine], prepared.rays.y[mine]
        kept = inside(corners[segment] + shift, *at)
        # The glass has moved along its tangent plane, off the parent: rays meet it a little aside.
        clear = np.abs(signed_distance(corners[segment] + shift, *(a[:, None] for a in at))[:, 0]) > 2.0
        assert np.count_nonzero(~kept & clear) > 15
        np.testing.assert_array_equal(
            status[mine, 1][clear] != lost_at(GAP, -1), kept[clear]
        )  # some then miss M2


def test_modal_models_reach_to_the_nearest_edge(mirror):
    """In a notch the line of an edge is no edge."""
    rays = segment_rays(mirror.segments, 3)
    model = modal_model(prepare(mirror, rays, 550e-6, 6), NUMPY, (0, 2))
    corners = mirror.segments.corners[rays.segment]
    part = np.linspace(0, 1, 2001)[:, None, None, None]
    dense = corners + part * (np.roll(corners, -1, axis=1) - corners)
    nearest = np.linalg.norm(dense - np.stack([rays.x, rays.y], axis=-1)[:, None], axis=-1).min()
    assert model.clearance == pytest.approx(nearest, abs=0.05)
    assert model.clearance > 50.0


@pytest.mark.parametrize("center", [(0.0, 0.0), (0.7, -1.3)])
@pytest.mark.parametrize("name", SHAPES)
def test_openings_may_be_any_simple_polygon(name, center):
    shape = SHAPES[name]
    x, y = np.random.default_rng(8).uniform(-2.0, 6.0, (2, 4000))
    (region,) = opening_regions(Opening(corners=tuple(map(tuple, shape.tolist())), center=center))
    expected = inside(shape + np.array(center), x, y)
    assert 50 < np.count_nonzero(expected) < 3900
    np.testing.assert_array_equal(on_glass((region,), x, y), expected)
    np.testing.assert_array_equal(on_glass((replace(region, blocks=True),), x, y), ~expected)
    assert not on_glass((region,), np.array([np.nan]), np.array([0.5]))[0]
    closed = np.concatenate([shape, shape[:1]])  # as files often list corners
    assert opening_regions(Opening(corners=tuple(map(tuple, closed.tolist())), center=center)) == (region,)
