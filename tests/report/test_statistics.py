"""Quantiles against exact binomial sums and simulated coverage; jitter against closed forms."""

from fractions import Fraction
from math import comb
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.report.statistics import case_rms, distribution, jitter_of_cases, quantile, quantile_ranks


def binomial_below(count, draws, probability):
    """P(B < count) in exact rational arithmetic."""
    p = Fraction(probability)
    return sum(comb(draws, k) * p**k * (1 - p) ** (draws - k) for k in range(count))


# The equal-tailed ranks of the median at 95 %, as tables of the sign test give them.
@pytest.mark.parametrize(
    ("draws", "ranks"),
    [
        (5, (0, 6)),
        (6, (1, 6)),
        (8, (1, 8)),
        (9, (2, 8)),
        (10, (2, 9)),
        (15, (4, 12)),
        (20, (6, 15)),
        (25, (8, 18)),
    ],
)
def test_median_ranks_are_those_of_the_tables(draws, ranks):
    assert quantile_ranks(draws, 0.5) == ranks


def test_p95_has_an_upper_bound_from_72_draws_on():
    # 0.95^71 = 0.0262 > 0.025 >= 0.95^72
    assert quantile_ranks(71, 0.95)[1] == 72
    assert quantile_ranks(72, 0.95)[1] == 72


@given(draws=st.integers(1, 60), probability=st.sampled_from([0.05, 0.25, 0.5, 0.9, 0.95]))
def test_ranks_are_the_tightest_with_exact_tails(draws, probability):
    lower, upper = quantile_ranks(draws, probability)
    tail = Fraction("0.025")
    assert binomial_below(lower, draws, probability) <= tail < binomial_below(lower + 1, draws, probability)
    above = 1 - binomial_below(upper, draws, probability)
    assert above <= tail
    assert upper == 1 or 1 - binomial_below(upper - 1, draws, probability) > tail


@pytest.mark.parametrize(("probability", "draws"), [(0.5, 25), (0.95, 200), (0.05, 80)])
def test_coverage_of_a_skewed_population_is_what_the_binomial_says(probability, draws):
    samples = np.random.default_rng(1).lognormal(size=(4000, draws))
    truth = np.exp(NormalDist().inv_cdf(probability))
    found = [quantile(sample, probability) for sample in samples]
    covered = np.mean([interval.low <= truth <= interval.high for interval in found])
    lower, upper = quantile_ranks(draws, probability)
    exact = float(binomial_below(upper, draws, probability) - binomial_below(lower, draws, probability))
    assert exact >= 0.95
    assert covered == pytest.approx(exact, abs=4 * np.sqrt(exact * (1 - exact) / 4000))


def test_pooled_instants_cover_however_much_a_case_repeats_itself():
    random = np.random.default_rng(2)
    for share in (0.0, 0.7, 1.0):  # of the variance that all instants of a case have in common
        common, own = random.normal(size=(1500, 40, 1)), random.normal(size=(1500, 40, 5))
        samples = np.sqrt(share) * common + np.sqrt(1.0 - share) * own
        found = [quantile(sample, 0.5, draws=40) for sample in samples]
        assert np.mean([interval.low <= 0.0 <= interval.high for interval in found]) >= 0.94


def test_equal_instants_give_the_interval_of_the_cases():
    values = np.random.default_rng(3).normal(size=50)
    assert quantile(np.repeat(values, 7), 0.3, draws=50).low == quantile(values, 0.3).low
    assert quantile(np.repeat(values, 7), 0.3, draws=50).high == quantile(values, 0.3).high


def test_quantile_interpolates_and_takes_infinite_radii():
    assert quantile(np.array([3.0, 1.0, 2.0, 4.0]), 0.5).value == 2.5
    found = quantile(np.array([1.0, np.inf, np.inf]), 0.5)
    assert found.value == np.inf
    assert (found.low, found.high) == (-np.inf, np.inf)
    assert np.isnan(quantile(np.array([]), 0.5).value)


@pytest.mark.parametrize(("probability", "value"), [(0.999, 6.0), (0.001, 1.0), (0.5, 3.5)])
def test_a_quantile_lies_in_its_interval(probability, value):
    """Six draws: with 99.4 % all are below the 99.9th percentile, which is no less than the largest, then."""
    found = quantile(np.arange(1.0, 7.0), probability)
    assert found.value == value
    assert found.low <= found.value <= found.high


@given(st.integers(1, 40))
def test_the_band_and_the_interval_of_a_quantile_are_two_views_of_one_thing(draws):
    """A value is within the interval of the median just where the band at that value holds one half."""
    values = np.arange(1.0, draws + 1.0)
    curve, median = distribution(values), quantile(values, 0.5)
    holds = (curve.low < 0.5) & (curve.high > 0.5)
    inside = (curve.values >= median.low) & (curve.values < median.high)
    np.testing.assert_array_equal(holds, inside)


def test_band_has_the_closed_form_of_no_and_all_successes():
    curve = distribution(np.arange(20.0))
    np.testing.assert_allclose(curve.low[-1], 0.025 ** (1 / 20))  # all 20 of 20
    assert curve.high[-1] == 1.0
    assert curve.probability[0] == 0.05
    # One of 20: the upper bound p solves P(B <= 1) = 0.025.
    p = curve.high[0]
    np.testing.assert_allclose((1 - p) ** 20 + 20 * p * (1 - p) ** 19, 0.025, rtol=1e-9)


def test_many_values_are_thinned_and_keep_their_ends():
    curve = distribution(np.arange(10_000.0), points=50)
    assert len(curve.values) == 50
    assert (curve.values[0], curve.values[-1]) == (0.0, 9999.0)
    np.testing.assert_allclose(curve.probability, (curve.values + 1) / 10_000)
    assert not len(distribution(np.array([])).values)


def jitter(los, sets=None):
    """Return the jitter of lines of sight (case, time, 2)."""
    if not los.size:
        return jitter_of_cases(np.empty((0, 2)), np.empty((0, 2)))
    return jitter_of_cases(los.mean(axis=1), los.var(axis=1), sets)


def test_case_rms_is_over_instants():
    np.testing.assert_allclose(case_rms(np.array([[3.0, 4.0], [1.0, 1.0]])), [np.sqrt(12.5), 1.0])


def test_jitter_removes_the_mean_of_the_population_only():
    # Two still cases at +-(3, 4) about (100, -7): still within each case, 5 apart from the common mean. The
    # variance is that of two draws, with N - 1.
    los = np.array([100.0, -7.0]) + np.array([3.0, 4.0]) * np.array([1.0, -1.0])[:, None, None] * np.ones(
        (2, 6, 1)
    )
    found = jitter(los)
    np.testing.assert_allclose(found.axis, np.sqrt(2.0) * np.array([3.0, 4.0]))
    assert found.radial == pytest.approx(5.0 * np.sqrt(2.0))
    assert np.isnan(found.standard_error)  # two are equally far from their mean, however much they scatter
    found = jitter(np.concatenate([los, [[[100.0, -7.0]] * 6]]))  # and a third at the mean: 25, 25, 0
    assert found.radial**2 == pytest.approx(50.0 / 2.0)
    assert found.standard_error == pytest.approx(25.0 / 3.0 / (2.0 * found.radial))


@pytest.mark.parametrize("size", [2, 4, 12])
def test_jitter_of_few_cases_is_not_too_small(size):
    """The variance of still and of moving cases, whose means differ, is unbiased: 1 and 1 + 1 per axis."""
    random = np.random.default_rng(9)
    means = random.normal(size=(4000, size, 1, 2))
    for los, variance in ((means, 1.0), (means + random.normal(size=(4000, size, 50, 2)), 2.0)):
        found = np.mean([jitter(one).axis ** 2 for one in los])
        assert found == pytest.approx(variance, rel=0.03)


def test_jitter_of_sets_is_that_of_as_many_draws():
    """Sets of two opposite cases: the mean of all is known, so that nothing is to be mended."""
    random = np.random.default_rng(3)
    half = random.normal(size=(4000, 3, 1, 2))
    sets = np.repeat(np.arange(3), 2)
    pairs = np.stack([half, -half], axis=2).reshape(4000, 6, 1, 2)
    assert np.mean([jitter(one, sets).axis ** 2 for one in pairs]) == pytest.approx(1.0, rel=0.03)


def test_a_single_still_case_says_nothing_of_jitter():
    assert np.isnan(jitter(np.ones((1, 1, 2))).radial)
    assert np.isnan(jitter(np.ones((1, 7, 2))).radial)
    assert jitter(np.ones((2, 7, 2))).radial == 0.0


def test_jitter_of_a_sine_is_its_amplitude_over_root_two():
    phase = 2 * np.pi * np.arange(16) / 16
    los = np.stack([2.0 * np.sin(phase), np.zeros(16)], axis=1)[None]
    found = jitter(los)
    np.testing.assert_allclose(found.axis, [np.sqrt(2.0), 0.0], rtol=0, atol=1e-15)
    assert np.isnan(found.standard_error)


def test_standard_error_is_the_scatter_of_repeated_campaigns():
    random = np.random.default_rng(4)
    found = [jitter(random.normal(size=(60, 1, 2)) + random.normal(size=(60, 8, 2))) for _ in range(300)]
    scatter = np.std([one.radial for one in found])
    assert np.mean([one.standard_error for one in found]) == pytest.approx(scatter, rel=0.15)


def test_no_cases_have_no_jitter():
    assert np.isnan(jitter(np.empty((0, 0, 2))).radial)
