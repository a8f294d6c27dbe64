import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.path import Path

from wavequake.errors import UserError
from wavequake.imaging.pupils.coverage import coverage
from wavequake.imaging.pupils.outlines import Outline

N = 7


def random_polygon(seed, corners=6, reach=3.4):
    random = np.random.default_rng(seed)
    angles = np.sort(random.uniform(0, 2 * np.pi, corners))
    return N / 2 + reach * np.stack([np.cos(angles), random.uniform(0.3, 1) * np.sin(angles)], axis=1)


def one(corners):
    return Outline(corners[None], np.ones(1), np.zeros(1, dtype=np.intp))


@given(st.integers(0, 2**32 - 1))
def test_cells_sum_to_the_polygons_area_and_centroid(seed):
    x, y = random_polygon(seed).T
    cross = x * np.roll(y, -1) - y * np.roll(x, -1)
    area = cross.sum() / 2
    found = coverage(one(np.stack([x, y], axis=1)), N)
    assert found.share.sum() == pytest.approx(area, abs=1e-9)
    assert (found.share <= 1 + 1e-12).all()
    for place, c in ((found.x, x), (found.y, y)):
        moment = (cross * (c + np.roll(c, -1))).sum() / 6
        assert found.share @ place == pytest.approx(moment, abs=1e-8)
    rows, columns = np.divmod(found.cells, N)
    lit = found.share > 1e-6  # a centroid is rounding over area
    assert (np.abs(found.x - columns - 0.5)[lit] <= 0.5 + 1e-9).all()
    assert (np.abs(found.y - rows - 0.5)[lit] <= 0.5 + 1e-9).all()


def test_each_cell_equals_a_count_of_points():
    corners = random_polygon(3)
    fine = 200
    at = (np.arange(N * fine) + 0.5) / fine
    x, y = np.meshgrid(at, at)
    inside = Path(corners).contains_points(np.stack([x.ravel(), y.ravel()], axis=1)).reshape(x.shape)
    shares, first_x, first_y = (
        a.reshape(N, fine, N, fine).mean(axis=(1, 3)) for a in (inside, inside * x, inside * y)
    )
    found = coverage(one(corners), N)
    total, moment_x, moment_y = np.zeros((3, N * N))
    total[found.cells] = found.share
    moment_x[found.cells], moment_y[found.cells] = found.share * found.x, found.share * found.y
    assert total.reshape(N, N) == pytest.approx(shares, abs=2e-3)
    assert moment_x.reshape(N, N) == pytest.approx(first_x, abs=2e-2)
    assert moment_y.reshape(N, N) == pytest.approx(first_y, abs=2e-2)


def test_edges_on_grid_lines_fill_whole_cells():
    square = np.array([[1, 2], [4, 2], [4, 5], [1, 5.0]])
    found = coverage(one(square), N)
    assert found.share == pytest.approx(np.ones(9), abs=1e-14)
    assert set(found.cells) == {N * row + column for row in (2, 3, 4) for column in (1, 2, 3)}
    assert found.x == pytest.approx(found.cells % N + 0.5, abs=1e-14)


def test_a_hole_is_taken_out_and_pieces_stay_apart():
    square = np.array([[0, 0], [3, 0], [3, 3], [0, 3.0]])
    hole = np.array([[1, 1], [2, 1], [2, 1.5], [1, 1.5]])
    outline = Outline(np.stack([square, hole, square / 3 + 2.5]), np.array([1, -1, 1.0]), np.array([0, 0, 1]))
    found = coverage(outline, N)
    assert np.bincount(found.piece, found.share) == pytest.approx([8.5, 1.0], abs=1e-14)
    middle = found.cells == N + 1
    assert (found.share[middle], found.y[middle]) == pytest.approx((0.5, 1.75), abs=1e-14)
    assert np.count_nonzero(found.cells == 2 * N + 2) == 2  # both pieces meet there


def test_a_polygon_beyond_the_grid_is_refused():
    with pytest.raises(UserError, match="beyond its grid"):
        coverage(one(np.array([[0, 0], [7.5, 0], [0, 1.0]])), N)
