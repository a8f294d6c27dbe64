"""Rare values and exceedance probabilities against distributions whose tails are known."""

import numpy as np
import pytest
from scipy.stats import binomtest, expon, genpareto, norm, pareto, uniform

from wavequake.campaign.statistics import tail
from wavequake.campaign.statistics.tail import exceedance, fit_tail, fits, rare_value, steadiness
from wavequake.errors import UserError

RARE = 1e-4


def sample(distribution, seed, count=2000):
    return distribution.rvs(count, random_state=seed)


@pytest.mark.parametrize(
    ("distribution", "least"),
    # A normal tail is not yet that of its limit at the largest twentieth: it falls a little faster.
    [(expon(), 0.90), (pareto(2.0), 0.90), (uniform(), 0.90), (norm(), 0.86)],
    ids=["exponential", "pareto", "uniform", "normal"],
)
def test_intervals_cover_the_truth_as_often_as_promised(distribution, least):
    truth, hits = distribution.isf(RARE), 0
    for seed in range(60):
        fitted = fit_tail(sample(distribution, seed))
        # The interval holds what lacks no more likelihood than its ends, which the next test looks at.
        hits += tail._lack(fitted, truth - fitted.threshold, np.log(RARE)) <= 0.0
    assert hits / 60 >= least


def test_an_interval_ends_where_the_likelihood_does():
    fitted = fit_tail(sample(expon(), 4))
    found = rare_value(fitted, RARE)
    assert found.low < found.value < found.high
    for end in (found.low, found.high):
        assert tail._lack(fitted, end - fitted.threshold, np.log(RARE)) == pytest.approx(0.0, abs=0.02)
    odds = exceedance(fitted, found.value)
    assert odds.value == pytest.approx(RARE, rel=1e-6)
    assert odds.low < RARE < odds.high
    # Both intervals are cuts of one region of limits and probabilities.
    assert exceedance(fitted, found.high).high == pytest.approx(RARE, rel=0.03)
    assert exceedance(fitted, found.low).low == pytest.approx(RARE, rel=0.03)


def test_the_fit_is_that_of_scipy():
    fitted = fit_tail(sample(pareto(3.0), 1, 5000))
    shape, _, scale = genpareto.fit(fitted.excesses, floc=0)
    assert fitted.shape == pytest.approx(shape, abs=1e-3)
    assert fitted.scale == pytest.approx(scale, rel=1e-3)


@pytest.mark.parametrize(("distribution", "shape"), [(expon(), 0.0), (pareto(2.0), 0.5), (uniform(), -1.0)])
def test_shapes_are_those_of_the_theory(distribution, shape):
    # Pickands 1975: exponential tails have none, powers -a have 1 / a, a uniform density ends with -1.
    assert fit_tail(sample(distribution, 2, 40_000)).shape == pytest.approx(shape, abs=0.08)


def test_beyond_a_largest_value_nothing_is_found_but_more_is_not_ruled_out():
    fitted = fit_tail(sample(uniform(), 3))
    found = exceedance(fitted, 1.5)
    assert (found.value, found.low) == (0.0, 0.0)
    assert 0.0 < found.high < 1e-2


def test_below_the_threshold_shares_and_quantiles_are_those_of_the_draws():
    values = sample(norm(), 5)
    fitted = fit_tail(values)
    found = exceedance(fitted, 0.0)
    above = int((values > 0).sum())
    exact = binomtest(above, 2000).proportion_ci(method="exact")
    assert (found.value, found.low, found.high) == pytest.approx((above / 2000, exact.low, exact.high))
    assert rare_value(fitted, 0.5).value == pytest.approx(np.median(values))
    assert exceedance(fitted, -100.0).value == 1.0


def test_a_tail_that_changes_its_kind_is_not_steady():
    values = sample(expon(), 6, 4000)
    alike = steadiness(fit_tail(values), RARE)
    found = rare_value(fit_tail(values), RARE)
    assert found.low < alike.value < found.high
    broken = np.where(values > np.quantile(values, 0.95), values**3, values)
    fitted = fit_tail(broken, float(np.quantile(values, 0.7)))
    assert steadiness(fitted, RARE).value > rare_value(fitted, RARE).high
    assert steadiness(fit_tail(values[:1100]), RARE) is None


@pytest.mark.parametrize(
    ("values", "threshold", "words"),
    [
        (np.arange(150.0), None, "150 cases are too few for a tail: take at least 200"),
        (np.empty(0), None, "0 cases are too few for a tail"),
        (np.ones(1), None, "1 case is too few for a tail: take at least 200"),
        (np.arange(1000.0), 990.0, "Only 9 of 1000 cases exceed 990, and a tail needs at least 50"),
        (np.append(np.arange(1000.0), np.inf), None, "1 of 1001 values are not finite"),
        (np.append(np.arange(1000.0), np.nan), None, "1 of 1001 values are not finite"),
        (np.repeat([0.0, 1.0], 500), 0.5, "All 500 values above 0.5 are equal: there is no tail"),
        (np.zeros(1000), None, "Only 0 of 1000 cases exceed 0"),
    ],
)
def test_what_has_no_tail_is_refused(values, threshold, words):
    with pytest.raises(UserError, match=words):
        fit_tail(values, threshold)


def test_scaling_and_shifting_the_draws_scales_and_shifts_the_rare_value():
    values = sample(expon(), 7)
    one, other = rare_value(fit_tail(values), RARE), rare_value(fit_tail(3e-9 * values + 5e-8), RARE)
    assert other.value == pytest.approx(3e-9 * one.value + 5e-8, rel=1e-3)
    assert other.high == pytest.approx(3e-9 * one.high + 5e-8, rel=1e-2)


def test_a_law_that_does_not_fit_is_told_and_one_that_does_seldom():
    good = [fits(fit_tail(sample(expon(), seed))) for seed in range(40)]
    assert good.count(False) <= 4  # one in forty on average; five or more have a chance of 0.3 %
    ordinary, far = norm.rvs(size=1900, random_state=1), norm.rvs(12.0, 0.1, size=50, random_state=2)
    assert not fits(fit_tail(np.concatenate([ordinary, far])))
