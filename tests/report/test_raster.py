"""Pictures of the glass are exact for segments that are only moved."""

import numpy as np

from wavequake.report.raster import fill_segments, plane_slopes, segment_at


def rays_on(centers, radius=500.0, count=6):
    around = 2.0 * np.pi * np.arange(count) / count + 0.2
    rays = centers[:, None] + radius * np.stack([np.cos(around), np.sin(around)], axis=1)
    return rays.reshape(-1, 2), np.repeat(np.arange(len(centers)), count)


def test_planes_per_segment_are_filled_exactly(hexagons):
    centers, corners = hexagons
    rays, segment = rays_on(centers)
    tilt = np.random.default_rng(1).normal(size=(7, 2))
    piston = np.arange(7.0) * 100.0
    values = piston[segment] + ((rays - centers[segment]) * tilt[segment]).sum(axis=1)
    picture = fill_segments(corners, centers, rays, segment, values, 2800.0, 90)
    along = ((np.arange(90) + 0.5) / 90 * 2 - 1) * 2800.0
    for k in range(7):
        # Pixels well inside the hexagon's inscribed circle belong to it and to nobody else.
        x, y = np.meshgrid(along, along)
        mine = np.hypot(x - centers[k, 0], y - centers[k, 1]) < 800.0
        expected = piston[k] + tilt[k, 0] * (x - centers[k, 0]) + tilt[k, 1] * (y - centers[k, 1])
        np.testing.assert_allclose(picture[mine], expected[mine], atol=1e-9)


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


def test_rays_that_fix_no_plane_give_no_slope_across_it():
    rays = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [5.0, 5.0]])
    slopes = plane_slopes(rays, np.array([0.0, 3.0, 6.0, 9.0]), np.array([0, 0, 0, 1]), 3)
    np.testing.assert_allclose(slopes, [[3.0, 0.0], [0.0, 0.0], [0.0, 0.0]], atol=1e-12)


def test_a_segment_without_rays_stays_empty(hexagons):
    centers, corners = hexagons
    rays, segment = rays_on(centers)
    kept = segment != 0
    picture = fill_segments(corners, centers, rays[kept], segment[kept], np.ones(kept.sum()), 2800.0, 40)
    assert np.isnan(picture[20, 20])
    assert np.isfinite(picture).any()
