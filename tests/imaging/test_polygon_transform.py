import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.imaging.engines.polygon_transform import polygon_areas, polygon_centroids, polygon_transform

HEXAGON = 720.0 * np.stack([np.cos(np.arange(6) * np.pi / 3), np.sin(np.arange(6) * np.pi / 3)], axis=1)[None]


def triangle_by_quadrature(corners, fx, fy):
    """Tensor Gauss rule on the triangle collapsed from the unit square, 40 nodes per direction."""
    t, w = np.polynomial.legendre.leggauss(40)
    t, w = 0.5 * (t + 1), 0.5 * w
    u, v = np.meshgrid(t, t, indexing="ij")
    weight = np.outer(w * t, w)
    a, b, c = corners
    x = a[0] + u * ((b - a)[0] + v * (c - b)[0])
    y = a[1] + u * ((b - a)[1] + v * (c - b)[1])
    jacobian = abs((b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0])
    waves = np.exp(-2j * np.pi * (np.multiply.outer(fx, x) + np.multiply.outer(fy, y)))
    return jacobian * (waves * weight).sum(axis=(1, 2))


@settings(max_examples=20, deadline=None)
@given(st.floats(0.0, 2 * np.pi), st.integers(0, 10_000))
def test_triangles_equal_gauss_quadrature(angle, seed):
    rng = np.random.default_rng(seed)
    corners = np.array([[0.0, 0.0], [1.0, 0.1], [0.2, 0.9]]) + 0.2 * rng.random((3, 2))
    frequency = 10.0 ** np.linspace(-7.0, 1.2, 60) / (2 * np.pi)
    fx, fy = frequency * np.cos(angle), frequency * np.sin(angle)
    exact = triangle_by_quadrature(corners, fx, fy)
    found = polygon_transform(corners[None], fx, fy)[:, 0]
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-14 * polygon_areas(corners[None])[0])


def test_square_is_a_product_of_sincs_for_all_frequencies():
    # Includes f = 0, frequencies along the edges and the seam between series and edge sum (k·reach = 1).
    square = 500.0 * np.array([[[-1, -1], [1, -1], [1, 1], [-1, 1.0]]])
    seam = 1.0 / (2 * np.pi * 500.0 * np.sqrt(2))
    steps = np.array([0, 1e-12, 1e-7, 1e-5, 0.999999 * seam, 1.000001 * seam, 1e-3, 0.0031, 0.01])
    fx, fy = (a.ravel() for a in np.meshgrid(steps, np.concatenate([-steps[1:], steps])))
    exact = 1e6 * np.sinc(1000.0 * fx) * np.sinc(1000.0 * fy)
    np.testing.assert_allclose(polygon_transform(square, fx, fy)[:, 0], exact, rtol=0, atol=3e-15 * 1e6)


def test_shift_area_conjugate_and_sum_laws():
    rng = np.random.default_rng(1)
    fx, fy = rng.normal(0, 5e-4, (2, 40))
    transform = polygon_transform(HEXAGON, fx, fy)
    area = 1.5 * np.sqrt(3) * 720.0**2
    assert polygon_transform(HEXAGON, np.zeros(1), np.zeros(1))[0, 0] == pytest.approx(area, rel=1e-15)
    shifted = polygon_transform(HEXAGON + np.array([300.0, -1200.0]), fx, fy)
    law = transform * np.exp(-2j * np.pi * (300.0 * fx - 1200.0 * fy))[:, None]
    np.testing.assert_allclose(shifted, law, rtol=0, atol=1e-14 * area)
    np.testing.assert_allclose(
        polygon_transform(HEXAGON, -fx, -fy), transform.conj(), rtol=0, atol=1e-15 * area
    )
    halves = [HEXAGON[:, [0, 1, 2, 3]], HEXAGON[:, [3, 4, 5, 0]]]
    total = sum(polygon_transform(half, fx, fy) for half in halves)
    np.testing.assert_allclose(total, transform, rtol=0, atol=1e-14 * area)


def test_a_repeated_last_corner_changes_nothing():
    fx, fy = np.linspace(0, 1e-3, 7), np.linspace(-2e-4, 5e-4, 7)
    padded = np.concatenate([HEXAGON, HEXAGON[:, -1:], HEXAGON[:, -1:]], axis=1)
    np.testing.assert_allclose(
        polygon_transform(padded, fx, fy), polygon_transform(HEXAGON, fx, fy), rtol=0, atol=1e-9
    )


def test_centroid_follows_the_first_moment_of_the_transform():
    corners = np.array([[[100.0, 50.0], [900.0, 80.0], [300.0, 700.0]]])
    np.testing.assert_allclose(polygon_centroids(corners), corners.mean(axis=1), rtol=1e-14)


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        (HEXAGON[:, ::-1], "polygon 0 has the area .* counter-clockwise"),
        (np.where(np.arange(6)[None, :, None] == 2, np.nan, HEXAGON), "polygon 0 has a corner that is not"),
        (np.zeros((0, 6, 2)), "shape"),
        (np.zeros((1, 6, 2)), "area 0"),
    ],
)
def test_impossible_polygons_are_refused(corners, message):
    with pytest.raises(UserError, match=message):
        polygon_transform(corners, np.zeros(1), np.zeros(1))
