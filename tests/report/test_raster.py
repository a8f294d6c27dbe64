"""Pictures of the glass are exact for segments that are only moved."""

import numpy as np
import pytest

from wavequake.report.segments.raster import fill_segments, segment_at


def rays_on(centers, radius=500.0, count=6):
    around = 2.0 * np.pi * np.arange(count) / count + 0.2
    radii = radius * (1.0 + 0.5 * (np.arange(count) % 2))  # on one circle x^2 + y^2 would pass for a piston
    rays = centers[:, None] + (radii * np.stack([np.cos(around), np.sin(around)])).T
    return rays.reshape(-1, 2), np.repeat(np.arange(len(centers)), count)


@pytest.mark.parametrize(("count", "degree"), [(6, 1), (12, 2)])
def test_a_segment_that_is_moved_or_curved_is_filled_exactly(hexagons, count, degree):
    centers, corners = hexagons
    rays, segment = rays_on(centers, count=count)
    random = np.random.default_rng(1)
    piston, tilt, curvature = (
        100.0 * np.arange(7.0),
        random.normal(size=(7, 2)),
        random.normal(size=(7, 3)) * 1e-3,
    )

    def shape(x, y, k):
        dx, dy = x - centers[k, 0], y - centers[k, 1]
        curved = curvature[k, 0] * dx**2 + curvature[k, 1] * dx * dy + curvature[k, 2] * dy**2
        return piston[k] + tilt[k, 0] * dx + tilt[k, 1] * dy + (degree == 2) * curved

    picture = fill_segments(corners, centers, rays, segment, shape(*rays.T, segment), 2800.0, 90)
    along = ((np.arange(90) + 0.5) / 90 * 2 - 1) * 2800.0
    x, y = np.meshgrid(along, along)
    for k in range(7):
        # Pixels well inside the hexagon's inscribed circle belong to it and to nobody else.
        mine = np.hypot(x - centers[k, 0], y - centers[k, 1]) < 800.0
        np.testing.assert_allclose(picture[mine], shape(x, y, k)[mine], rtol=0, atol=1e-7)


def test_whatever_the_values_a_ray_keeps_its_own(hexagons):
    centers, corners = hexagons
    # Rays on pixel centers of an 80 x 80 picture of +-2800 mm: a pixel is 70 mm.
    offsets = 70.0 * np.array([[0, 0], [5, 0], [0, 5], [-5, 0], [0, -5], [4, 4], [-4, 4]])
    near = np.round((centers - 35.0) / 70.0) * 70.0 + 35.0
    rays, segment = (near[:, None] + offsets).reshape(-1, 2), np.repeat(np.arange(7), 7)
    values = np.random.default_rng(2).normal(size=len(rays))
    picture = fill_segments(corners, centers, rays, segment, values, 2800.0, 80)
    column, row = np.round((rays.T + 2800.0 - 35.0) / 70.0).astype(int)
    np.testing.assert_allclose(picture[row, column], values, rtol=0, atol=1e-12)


def test_pixels_off_the_glass_are_empty(hexagons):
    centers, corners = hexagons
    rays, segment = rays_on(centers)
    picture = fill_segments(corners, centers, rays, segment, np.ones(len(rays)), 4000.0, 64)
    assert np.isnan(picture[0]).all()
    np.testing.assert_allclose(picture[np.isfinite(picture)], 1.0)


def test_points_belong_to_the_polygon_that_holds_them_not_to_the_nearest_center():
    # A wide and a narrow rectangle: x = 900 is nearer to the narrow one's center but in the wide one.
    corners = np.array(
        [
            [[-1000, -500], [1000, -500], [1000, 500], [-1000, 500]],
            [[1000, -500], [1200, -500], [1200, 500], [1000, 500]],
        ]
    )
    centers = corners.mean(axis=1)
    points = np.array([[900.0, 0.0], [1100.0, 0.0], [1300.0, 0.0], [1201.0, 0.0]])
    assert segment_at(points, corners.astype(float), centers, margin=2.0).tolist() == [0, 1, -1, 1]


def test_triangles_that_repeat_a_corner_are_polygons_too():
    corners = np.array([[[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [0.0, 10.0]]])
    points = np.array([[1.0, 1.0], [9.0, 9.0]])
    assert segment_at(points, corners, corners.mean(axis=1), margin=0.0).tolist() == [0, -1]


def test_rays_that_fix_no_plane_are_continued_along_themselves_only():
    corners = np.array([[[-100.0, -100.0], [100.0, -100.0], [100.0, 100.0], [-100.0, 100.0]]])
    rays = np.array([[-50.0, 0.0], [0.0, 0.0], [50.0, 0.0]])
    picture = fill_segments(corners, np.zeros((1, 2)), rays, np.zeros(3, int), 3.0 * rays[:, 0], 100.0, 10)
    np.testing.assert_allclose(
        picture, np.tile(3.0 * (20.0 * np.arange(10) - 90.0), (10, 1)), rtol=0, atol=1e-9
    )


def test_a_segment_without_rays_stays_empty(hexagons):
    centers, corners = hexagons
    rays, segment = rays_on(centers)
    kept = segment != 0
    picture = fill_segments(corners, centers, rays[kept], segment[kept], np.ones(kept.sum()), 2800.0, 40)
    assert np.isnan(picture[20, 20])
    assert np.isfinite(picture).any()


def test_what_is_kept_from_the_map_before_does_not_show_in_the_next(hexagons):
    """Each of the arguments makes another picture, also right after the one of the others."""
    centers, corners = hexagons
    rays, segment = rays_on(centers)
    values = np.random.default_rng(1).normal(size=len(rays))
    first = (corners, centers, rays, segment, values, 2800.0, 60)
    others = [(0.9 * corners, 0), (1.1 * rays, 2), (np.roll(segment, 1), 3), (-values, 4), (2000.0, 5)]
    one = fill_segments(*first)
    for value, place in others:
        other = fill_segments(*first[:place], value, *first[place + 1 :])
        assert not np.array_equal(other, one, equal_nan=True), place
        np.testing.assert_array_equal(fill_segments(*first), one)
