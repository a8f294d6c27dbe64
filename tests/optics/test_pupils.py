from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.optics.rays.pupils import grid_rays, on_glass, segment_rays, sunflower
from wavequake.optics.segments.arrangements import tmt_segments
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.layout import areas, jwst_segments, segments_on_conic
from wavequake.optics.segments.telescope import with_segments

DEGREE = {1: 1, 3: 2, 6: 4, 12: 6}


def moment(corners, p, q):
    """Integral of x^p y^q over a polygon: Green's theorem and Gauss-Legendre along the edges, both exact."""
    node, weight = np.polynomial.legendre.leggauss(p + q + 2)
    start, along = corners, np.roll(corners, -1, axis=0) - corners
    x, y = (start[:, k, None] + along[:, k, None] * (node + 1) / 2 for k in (0, 1))
    return np.sum(x ** (p + 1) / (p + 1) * y**q * weight / 2 * along[:, 1, None])


def irregular():
    """Return a triangle, a quadrilateral and a hexagon, side by side and about 1 mm wide."""
    corners = [
        [[0.0, 0.0], [0.9, 0.1], [0.3, 0.8]] + [[0.3, 0.8]] * 3,
        [[1.0, 0.0], [1.9, 0.2], [1.8, 0.9], [1.1, 1.0]] + [[1.1, 1.0]] * 2,
        [[-1.0, 0.1], [-0.5, 0.0], [-0.1, 0.4], [-0.2, 0.9], [-0.7, 1.0], [-1.1, 0.5]],
    ]
    return segments_on_conic(["3", "4", "6"], np.array(corners), -100.0, -1.0)


@given(st.floats(0.0, 5.0), st.floats(5.1, 9.0), st.integers(1, 300))
def test_sunflower(inner, outer, count):
    rays = sunflower(inner, outer, count)
    i = np.arange(count)
    r = np.sqrt(inner**2 + (i + 0.5) / count * (outer**2 - inner**2))
    np.testing.assert_allclose(
        rays.x + 1j * rays.y, r * np.exp(1j * i * np.pi * (3 - np.sqrt(5))), rtol=0, atol=1e-11
    )
    assert len(rays) == count
    assert rays.weight.sum() == pytest.approx(1.0)
    assert (rays.segment == -1).all()


def test_2000_sunflower_rays_on_the_18_segments():
    system = telescope("tmt-18")
    rays = on_glass(system, sunflower(system.annulus.inner, system.annulus.outer, 2000))
    count = np.bincount(rays.segment)
    assert count.sum() == 2000  # none unassigned
    assert (count[:6].min(), count[:6].max()) == (132, 136)
    assert (count[6:].min(), count[6:].max()) == (78, 122)


def test_a_grid_on_the_492_segments():
    system = telescope("tmt")
    rays = on_glass(system, grid_rays(15000.0, 50.0))
    count = dict(zip(system.segments.names, np.bincount(rays.segment), strict=True))
    assert (len(rays), count["A1"], count["B10"]) == (260956, 540, 539)
    assert len(rays) * 50.0**2 == pytest.approx(areas(system.segments).sum(), rel=2e-3)
    assert rays.weight.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("points", DEGREE)
def test_cubature_is_exact_up_to_its_degree_and_no_further(points):
    segments = irregular()
    rays = segment_rays(segments, points)
    assert np.bincount(rays.segment).tolist() == [3 * points, 4 * points, 6 * points]
    area = areas(segments).sum()
    for degree in range(DEGREE[points] + 2):
        errors = []
        for p in range(degree + 1):
            for index, corners in enumerate(segments.corners):
                on = rays.segment == index
                total = area * np.sum(rays.weight[on] * rays.x[on] ** p * rays.y[on] ** (degree - p))
                errors.append(abs(total - moment(corners, p, degree - p)) / 2.0**degree)  # |x|, |y| < 2
        if degree <= DEGREE[points]:
            assert max(errors) < 1e-15
        else:
            assert max(errors) > 1e-10


def test_cubature_of_a_wave_converges():
    segments = irregular()
    corners = segments.corners[2]
    # Integral of exp(x + 2 y) by its Taylor series in exact moments.
    terms = [(p, q) for p in range(24) for q in range(24)]
    factorial = np.cumprod([1.0, *range(1, 24)])
    exact = sum(2.0**q * moment(corners, p, q) / factorial[p] / factorial[q] for p, q in terms)
    errors = []
    for points in DEGREE:
        rays = segment_rays(segments, points)
        on = rays.segment == 2
        total = areas(segments).sum() * np.sum(rays.weight[on] * np.exp(rays.x[on] + 2 * rays.y[on]))
        errors.append(abs(total / exact - 1.0))
    assert errors[0] < 5e-2
    assert (np.array(errors[1:]) < np.array(errors[:-1]) / 10).all()


@pytest.mark.parametrize("build", [tmt_segments, jwst_segments])
@pytest.mark.parametrize("points", DEGREE)
def test_rays_lie_on_their_segments_side_by_side(build, points):
    segments = build()
    rays = segment_rays(segments, points)
    assert rays.segment.tolist() == np.repeat(np.arange(len(segments)), 6 * points).tolist()
    share = np.bincount(rays.segment, rays.weight)
    np.testing.assert_allclose(share, areas(segments) / areas(segments).sum(), rtol=1e-12)
    system = with_segments(telescope("jwst"), segments)
    found = on_glass(system, replace(rays, segment=np.full(len(rays), -1)))
    np.testing.assert_array_equal(found.segment, rays.segment)
    np.testing.assert_allclose(found.weight, rays.weight, rtol=1e-12)


def test_a_monolithic_mirror_takes_all_rays_of_its_annulus():
    system = telescope("tmt-thesis")
    rays = on_glass(system, sunflower(1512.2, 15000.0, 500))
    assert len(rays) == 500
    assert (rays.segment == 0).all()
    grid = on_glass(system, grid_rays(15000.0, 100.0))
    radius = np.hypot(grid.x, grid.y)
    assert radius.min() > 1512.2
    assert radius.max() < 15000.0
    assert len(grid) * 100.0**2 == pytest.approx(np.pi * (15000.0**2 - 1512.2**2), rel=1e-3)


@pytest.mark.parametrize("name", ["tmt", "tmt-18", "tmt-thesis"])
def test_a_pupil_no_ray_passes(name):
    system = telescope(name)
    with pytest.raises(UserError, match=r"No ray passes the pupil of .* of the 50 rays .* to 1\d+(\.\d)? mm"):
        on_glass(system, sunflower(0.0, 1000.0, 50))


@pytest.mark.parametrize(
    ("inner", "outer"), [(2.0, 1.0), (1.0, 1.0), (-1.0, 1.0), (0.0, float("nan")), (0.0, float("inf"))]
)
def test_impossible_annuli(inner, outer):
    with pytest.raises(UserError, match="0 <= inner < outer"):
        sunflower(inner, outer, 10)


def test_impossible_samplings():
    with pytest.raises(UserError, match="number of rays is 0"):
        sunflower(0.0, 1.0, 0)
    with pytest.raises(UserError, match="positive radius and spacing"):
        grid_rays(1.0, 0.0)
    with pytest.raises(UserError, match="no rule of 4 rays per triangle; choose one of 1, 3, 6, 12"):
        segment_rays(tmt_segments(), 4)
    with pytest.raises(UserError, match="monolithic mirror has no segments"):
        segment_rays(telescope("tmt-thesis").segments, 3)
