import json
from dataclasses import replace
from math import inf, nan, sqrt
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.device.tiles import TILE, from_tiles
from wavequake.optics.rays.pupils import PupilRays, sunflower
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.prepared import prepare, trace_states
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.quality import meets_marechal, meets_rayleigh, peak_to_valley, spot

REFERENCE = Path(__file__).parents[1] / "data" / "tmt_optics.json"


def test_peak_to_valley_leaves_lost_rays_out():
    opd = np.array([[1.0, -2.0, 4.0], [nan, -2.0, 4.0], [nan, nan, 3.0], [nan, nan, nan]])
    np.testing.assert_array_equal(peak_to_valley(opd), [6, 6, 0, nan])
    np.testing.assert_array_equal(peak_to_valley(np.zeros((2, 0))), [nan, nan])


def test_verdicts_at_their_limits():
    np.testing.assert_array_equal(
        meets_rayleigh(np.array([0.0, 0.25, 0.2501, nan])), [True, True, False, False]
    )
    np.testing.assert_array_equal(
        meets_marechal(np.array([0.0, 1 / 14, 0.0715, nan])), [True, True, False, False]
    )


def test_a_wave_of_defocus_at_rayleighs_limit_also_meets_marechals():
    """W = a rho^2: peak to valley a, rms a / sqrt(12); a quarter wave is 1/13.9, just over 1/14."""
    rays = sunflower(0.0, 1.0, 20_000)
    wave = 0.25 * np.hypot(rays.x, rays.y)[None] ** 2
    assert peak_to_valley(wave)[0] == pytest.approx(0.25, rel=1e-3)
    assert wave.std() == pytest.approx(0.25 / sqrt(12), rel=1e-6)
    assert meets_rayleigh(peak_to_valley(wave)).all()
    assert not meets_marechal(wave.std(axis=1)).any()


@given(st.floats(0.01, 100), st.floats(-10, 10), st.floats(0.05, 1), st.integers(0, 5))
def test_an_even_disk_in_closed_form(radius, shift, fraction, shuffle):
    """Radii of an even disk: rms R / sqrt(2), and sqrt(fraction) R holds the fraction of the light."""
    rays = sunflower(0.0, radius, 2000)
    order = np.random.default_rng(shuffle).permutation(2000)
    x, y = rays.x[None, order] + shift, rays.y[None, order] - shift
    measured = spot(x, y, rays.weight[order], fraction)
    np.testing.assert_allclose(measured.centroid, [[shift, -shift]], rtol=0, atol=1e-3 * radius)
    np.testing.assert_allclose(measured.rms, radius / sqrt(2), rtol=1e-4)
    np.testing.assert_allclose(measured.enclosing, radius * sqrt(fraction), rtol=1e-2)


def test_weights_count_as_repeated_rays():
    random = np.random.default_rng(8)
    x, y, counts = random.normal(size=(1, 12)), random.normal(size=(1, 12)), random.integers(1, 5, 12)
    weighted = spot(x, y, counts.astype(float), 0.6)
    repeated = spot(np.repeat(x, counts, axis=1), np.repeat(y, counts, axis=1), np.ones(counts.sum()), 0.6)
    np.testing.assert_allclose(weighted.centroid, repeated.centroid)
    np.testing.assert_allclose(weighted.rms, repeated.rms)
    np.testing.assert_allclose(weighted.enclosing, repeated.enclosing)


def test_lost_rays_are_left_out_of_spots():
    x = np.array([[0.0, 2.0, 50.0, nan], [nan] * 4, [3.0, nan, nan, nan]])
    y = np.where(np.isnan(x), nan, 1.0)
    y[0, 2] = nan
    measured = spot(x, y, np.ones(4))
    np.testing.assert_array_equal(measured.centroid, [[1, 1], [nan, nan], [3, 1]])
    np.testing.assert_array_equal(measured.rms, [1, nan, 0])
    np.testing.assert_array_equal(measured.enclosing, [1, nan, 0])


@pytest.mark.parametrize("fraction", [0.1, 0.2, 0.3, 0.7, 1.0])
def test_a_fraction_of_equal_rays_is_reached_exactly(fraction):
    """Ten rays at the distances 1, 1, 2, 2, ..., 5, 5 from their centroid."""
    steps = np.arange(1.0, 6.0)
    measured = spot(np.concatenate([steps, -steps])[None], np.zeros((1, 10)), np.full(10, 0.1), fraction)
    assert measured.enclosing[0] == np.ceil(round(10 * fraction) / 2)


def test_spots_of_the_thesis_telescope():
    fields = json.loads(REFERENCE.read_text())["fields"]
    system = telescope("tmt-thesis")
    nodes, weights = np.polynomial.legendre.leggauss(24)
    r = np.sqrt(
        system.annulus.inner**2 + (system.annulus.outer**2 - system.annulus.inner**2) * (nodes + 1) / 2
    )
    theta = 2 * np.pi * np.arange(96) / 96
    x, y = np.outer(r, np.cos(theta)).ravel(), np.outer(r, np.sin(theta)).ravel()
    rays = PupilRays(x, y, np.repeat(weights / 2 / 96, 96), np.zeros(len(x), dtype=np.int64))
    prepared = prepare(system, rays, 550e-6, 11)
    states = rest_states(system, TILE)
    angles = np.zeros((TILE, 2))
    angles[: len(fields), 0] = np.deg2rad([field["field_arcmin"] / 60 for field in fields])
    traced = trace_states(prepared, replace(states, line_of_sight=angles), NUMPY)
    measured = spot(from_tiles(traced.x), from_tiles(traced.y), prepared.weight)
    expected = [1e3 * field["rms_spot_radius_m"] for field in fields]
    np.testing.assert_allclose(measured.rms[: len(fields)], expected, rtol=1e-6)
    assert (measured.enclosing[: len(fields)] > 0).all()


@pytest.mark.parametrize("fraction", [0.0, 1.1, nan])
def test_impossible_fractions_are_refused(fraction):
    with pytest.raises(UserError, match="fraction"):
        spot(np.zeros((1, 2)), np.zeros((1, 2)), np.ones(2), fraction)


@pytest.mark.parametrize("weight", [0.0, -1.0, nan, inf])
def test_impossible_weights_are_refused(weight):
    with pytest.raises(UserError, match="weights"):
        spot(np.zeros((1, 2)), np.zeros((1, 2)), np.array([1.0, weight]))
