import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavequake.kernels.trace.surfaces import conic_path, conic_sag, conic_sag_and_slopes, conic_slopes

CURVATURES = st.floats(-1e-3, 1e-3).filter(lambda c: c == 0.0 or abs(c) > 1e-9)
CONICS = st.floats(-4.0, 1.0)
PLACES = st.floats(-500.0, 500.0)


def implicit(x, y, z, curvature, conic):
    return curvature * (x * x + y * y + (1.0 + conic) * z * z) - 2.0 * z


@given(PLACES, PLACES, CURVATURES, CONICS)
def test_sag_lies_on_the_conic(x, y, curvature, conic):
    z = conic_sag(x, y, curvature, conic)
    assert implicit(x, y, z, curvature, conic) == pytest.approx(0.0, abs=1e-11 + 4e-16 * abs(z))


@given(PLACES, PLACES, CURVATURES, CONICS)
def test_slopes_are_the_derivatives_of_the_sag(x, y, curvature, conic):
    h = 1e-2
    across = (conic_sag(x + h, y, curvature, conic) - conic_sag(x - h, y, curvature, conic)) / (2.0 * h)
    along = (conic_sag(x, y + h, curvature, conic) - conic_sag(x, y - h, curvature, conic)) / (2.0 * h)
    assert conic_slopes(x, y, curvature, conic) == pytest.approx((across, along), rel=1e-7, abs=1e-8)


@given(PLACES, PLACES, CURVATURES, CONICS)
def test_sag_and_slopes_together_are_these_to_the_bit(x, y, curvature, conic):
    found = conic_sag_and_slopes(x, y, curvature, conic)
    apart = conic_sag(x, y, curvature, conic), *conic_slopes(x, y, curvature, conic)
    np.testing.assert_array_equal(found, apart)


def test_sag_of_a_sphere_ends_at_its_radius():
    assert conic_sag(60.0, 80.0, 1.0 / 100.0, 0.0) == pytest.approx(100.0)
    assert np.isnan(conic_sag(61.0, 80.0, 1.0 / 100.0, 0.0))
    assert np.isnan(conic_slopes(61.0, 80.0, 1.0 / 100.0, 0.0)).all()


@settings(max_examples=200)
@given(
    PLACES, PLACES, CURVATURES, CONICS, st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.sampled_from([1, -1])
)
def test_a_ray_aimed_at_a_point_of_the_surface_meets_it_there(x, y, curvature, conic, u, v, sense):
    direction = np.array([u, v, sense * np.sqrt(1.0 - u * u - v * v)])
    slopes = np.array(conic_slopes(x, y, curvature, conic))
    point = np.array([x, y, conic_sag(x, y, curvature, conic)])
    crossing = direction @ [*-slopes, 1.0]
    if crossing * sense < 0.05:  # nearly grazing, or crossed from behind
        return
    for distance in (0.0, 700.0, -3000.0):
        path = conic_path(point - distance * direction, direction, curvature, conic)
        assert path == pytest.approx(distance, abs=1e-9)


@pytest.mark.parametrize("radius", [2e3, 8e3, 15e3])
def test_a_ray_to_a_telescopes_secondary_meets_the_sheet_of_its_vertex(radius):
    # From a paraboloid of focal length 30 m to a convex hyperboloid 2.9 m before its focus.
    start = np.array([radius, 0.0, -(radius**2) / 120e3 + 27093.75])
    focus = np.array([0.0, 0.0, -30e3 + 27093.75])
    direction = (focus - start) / np.linalg.norm(focus - start)
    path = conic_path(start, direction, -1.0 / 6227.68, -1.31822813)
    hit = start + path * direction
    assert hit[2] == pytest.approx(conic_sag(hit[0], hit[1], -1.0 / 6227.68, -1.31822813), abs=1e-9)
    if radius == 2e3:
        assert hit[2] == pytest.approx(-3.0, abs=0.1)


def test_a_ray_that_misses_is_nan():
    along_z = np.array([0.0, 0.0, 1.0])
    assert np.isnan(conic_path(np.array([101.0, 0.0, -5.0]), along_z, 1e-2, 0.0))
    assert np.isnan(conic_path(np.array([0.0, 0.0, -5.0]), np.array([1.0, 0.0, 0.0]), 0.0, 0.0))
    assert np.isnan(conic_path(np.full(3, np.nan), along_z, 1e-2, 0.0))
