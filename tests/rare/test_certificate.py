"""Weighted draws, and corrections by a costly model, against closed forms."""

import numpy as np
import pytest
from scipy.stats import chi2, norm

from wavequake.campaign.rare.certificate import correction, estimated
from wavequake.campaign.rare.quadratic import exceedance, limit_of, quadratic_form, tilt_to


@pytest.mark.parametrize("probability", [1e-4, 1e-9])
@pytest.mark.parametrize("freedom", [2, 40])
def test_intervals_of_weighted_draws_hold_as_often_as_they_say(freedom, probability):
    form = quadratic_form(0.0, np.zeros(freedom), np.eye(freedom))
    limit = chi2.isf(probability, freedom)
    tilt = tilt_to(form, limit)
    found = [estimated(tilt, limit, seed, 4000) for seed in range(200)]
    assert sum(one.low <= probability <= one.high for one in found) >= 183


def corrected(shift, noise, cases, seed, lost=0.0):
    """Return a correction of a Gaussian number by itself with a shift and noise, and the exact one."""
    random = np.random.default_rng(seed)
    form = quadratic_form(0.0, np.array([1.0, 0.0]), np.zeros((2, 2)))
    limit = limit_of(form, 1e-5)
    tilt = tilt_to(form, limit)
    points = tilt.drawn(random.standard_normal((cases, 2)))
    cheap = form.values(points)
    costly = cheap + shift + noise * points[:, 1]
    known = random.random(cases) >= lost
    found = correction(
        tilt.weights(cheap), float(tilt.weights(limit)), cheap > limit, known & (costly > limit), known
    )
    exact = norm.sf((limit - shift) / np.hypot(1.0, noise)) - exceedance(form, limit)
    return found, exact


@pytest.mark.parametrize(("shift", "noise"), [(0.0, 0.0), (0.02, 0.0), (-0.1, 0.0), (0.0, 0.1), (0.05, 0.2)])
def test_corrections_hold_as_often_as_they_say(shift, noise):
    found = [corrected(shift, noise, 1000, seed) for seed in range(200)]
    assert sum(one.low <= exact <= one.high for one, exact in found) >= 183


def test_where_no_case_differs_the_interval_says_what_that_proves():
    few, many = (corrected(0.0, 0.0, cases, 0)[0] for cases in (100, 10_000))
    assert few.more == few.fewer == few.unknown == 0
    assert few.value == many.value == 0.0
    assert many.high == -many.low > 0.0
    np.testing.assert_allclose(few.high / many.high, 100.0, rtol=0.03)


def test_cases_that_failed_count_as_what_is_worse():
    whole, _ = corrected(0.0, 0.0, 1000, 0)
    some, _ = corrected(0.0, 0.0, 1000, 0, lost=0.05)
    assert some.unknown > 20
    assert some.low < whole.low
    assert some.high > whole.high
