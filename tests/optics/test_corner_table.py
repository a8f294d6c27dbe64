import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY, list_devices
from wavequake.kernels.device.tiles import TILE
from wavequake.kernels.trace.status import GAP, OK, lost_at
from wavequake.optics.rays.pupils import PupilRays, segment_rays
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.layout import areas, candidates, tmt18_segments
from wavequake.optics.segments.prepared import prepare, trace_states
from wavequake.optics.segments.telescope import with_segments
from wavequake.optics.shapes.corner_table import distorted
from wavequake.optics.systems.kinematics import rest_states

DEVICES = [NUMPY, *(device for device in list_devices() if device.kind == "cpu")][:2]
GAP_MM = 100.0


def table(*rows):
    return io.StringIO("segment,corner,dx_mm,dy_mm\n" + "\n".join(",".join(map(str, row)) for row in rows))


def inside(polygon, x, y):
    """Even-odd rule: how many edges a line to the right crosses."""
    crossings = np.zeros(len(x), dtype=int)
    for (x1, y1), (x2, y2) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if y1 != y2:
            at = x1 + (y - y1) / (y2 - y1) * (x2 - x1)
            crossings += ((y1 > y) != (y2 > y)) & (x < at)
    return crossings % 2 == 1


@given(st.integers(0, 17), st.integers(0, 5), st.floats(-40, 40), st.floats(-40, 40))
def test_a_displaced_corner_changes_the_area_by_its_triangles(segment, corner, dx, dy):
    """Half the cross product of the displacement with the diagonal between the corner's neighbors."""
    segments = tmt18_segments(gap=GAP_MM)
    moved = distorted(segments, table((segments.names[segment], corner + 1, dx, dy)))
    polygon = segments.corners[segment]
    diagonal = polygon[(corner + 1) % 6] - polygon[corner - 1]
    change = areas(moved) - areas(segments)
    assert change[segment] == pytest.approx(0.5 * (dx * diagonal[1] - dy * diagonal[0]), abs=1e-6)
    assert np.count_nonzero(np.delete(change, segment)) == 0
    np.testing.assert_array_equal(moved.centers, segments.centers)


@pytest.fixture(scope="module")
def system():
    """The 18 hexagons with every corner displaced by some 15 mm."""
    plain = telescope("tmt-18", gap=GAP_MM)
    moves = np.random.default_rng(4).normal(0.0, 15.0, (18, 6, 2)).round(3)
    rows = [
        (name, corner + 1, *moves[index, corner])
        for index, name in enumerate(plain.segments.names)
        for corner in range(6)
    ]
    segments = distorted(plain.segments, table(*rows))
    np.testing.assert_allclose(segments.corners, plain.segments.corners + moves, rtol=1e-15)
    return with_segments(plain, segments)


@pytest.mark.parametrize("device", DEVICES, ids=lambda device: device.kind)
def test_rays_near_distorted_edges_meet_the_segments_that_are_there(system, device):
    """At rest and with one segment 8 mm aside; rays straddle the edges by some 20 mm."""
    random, corners = np.random.default_rng(5), system.segments.corners
    part = random.uniform(0, 1, (18, 6, 40, 1))
    on_edge = corners[:, :, None] + part * (np.roll(corners, -1, axis=1) - corners)[:, :, None]
    near = (on_edge + random.normal(0, 10, on_edge.shape)).reshape(-1, 2)
    centers = np.repeat(corners.mean(axis=1), 3, axis=0) + np.tile([[0, 0], [50, 0], [0, 50]], (18, 1))
    x, y = np.concatenate([near, centers]).T
    expected = np.full(len(x), -1)
    for segment, polygon in enumerate(corners):
        expected[inside(polygon, x, y)] = segment
    assert (expected == -1).any()
    found = candidates(system.segments, x, y)[:, 0]
    np.testing.assert_array_equal(found, expected)

    rays = PupilRays(x, y, np.ones(len(x)), expected)
    prepared = prepare(system, rays, 550e-6, 4)
    states = rest_states(system, TILE)
    states.segment_motion[1, 3, 0] = 8.0
    status = trace_states(prepared, states, device).status[0]
    assert (status[:, 0] == OK).all()
    own = prepared.rays.segment == 3
    to_optics = system.segments.axes[3] * np.array([1.0, 1.0, -1.0])[:, None]
    shift = 8.0 * to_optics[:, 0]
    # Along the ray the shifted surface is met where it was but for its slope: micrometers, so none is nearer.
    kept = inside(corners[3] + shift[:2], prepared.rays.x[own], prepared.rays.y[own])
    assert 0 < np.count_nonzero(~kept) < np.count_nonzero(own)
    np.testing.assert_array_equal(status[own, 1] == OK, kept)
    assert (status[own, 1][~kept] == lost_at(GAP, -1)).all()


def test_rays_over_segments_cover_the_distorted_glass(system):
    rays = segment_rays(system.segments, 3)
    for segment, polygon in enumerate(system.segments.corners):
        mine = rays.segment == segment
        assert inside(polygon, rays.x[mine], rays.y[mine]).all()
        share = areas(system.segments)[segment] / areas(system.segments).sum()
        assert rays.weight[mine].sum() == pytest.approx(share, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "lacks segment"),
        ("segment,corner,dx_mm\n1,1,2", "lacks dy_mm"),
        ("segment,corner,dx_mm,dy_mm\n19,1,0,0", "line 2: there is no segment '19'; the nearest is '9'"),
        ("segment,corner,dx_mm,dy_mm\n1,7,0,0", "'7' is not a corner; write a number from 1 to 6"),
        ("segment,corner,dx_mm,dy_mm\n1,0,0,0", "'0' is not a corner"),
        ("segment,corner,dx_mm,dy_mm\n1,1,x,0", "'x' is not a number; write millimeters"),
        ("segment,corner,dx_mm,dy_mm\n1,1,nan,0", "'nan' is not a number"),
        ("segment,corner,dx_mm,dy_mm\n1,1,0", "'' is not a number"),
        ("segment,corner,dx_mm,dy_mm\n1,1,0,5,0", "line 2: there are 5 cells, but 4 columns"),
        ("segment,corner,dx_mm,dy_mm\n1,1,0,0\n1,1,1,0", "line 3: corner 1 of segment 1 is displaced twice"),
        ("segment,corner,dx_mm,dy_mm\n1,1,-9000,-9000", "segment '1' would cross itself"),
        ("segment,corner,dx_mm,dy_mm\n1,1,0,200", "segments '1' and '.*' would overlap"),
    ],
)
def test_tables_that_make_no_mirror_are_refused(text, message):
    with pytest.raises(UserError, match=message):
        distorted(tmt18_segments(gap=GAP_MM), io.StringIO(text))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(UserError, match=r"nowhere.csv cannot be read"):
        distorted(tmt18_segments(), tmp_path / "nowhere.csv")


def test_files_and_comments_are_read(tmp_path):
    path = tmp_path / "corners.csv"
    path.write_text("# measured\nsegment,corner,dx_mm,dy_mm\n2, 3, 1.5, -2\n\n")
    segments = tmt18_segments(gap=GAP_MM)
    change = distorted(segments, path).corners - segments.corners
    np.testing.assert_allclose(change[1, 2], [1.5, -2.0], rtol=0, atol=1e-9)
    assert np.count_nonzero(change) == 2
