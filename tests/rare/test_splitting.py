"""Probabilities by splitting: closed forms, and OpenTURNS where it is installed."""

import numpy as np
import pytest
from scipy.special import log_ndtr
from scipy.stats import chi2, gamma, norm
from tests.mechanics.shaken import records

from wavequake.campaign.rare.splitting import probability
from wavequake.errors import UserError

RARE = 1e-4


def linear(u):
    return u.sum(axis=1) / np.sqrt(u.shape[1])


def square(u):
    return np.sum(u**2, axis=1)


def exponential(u):
    """Sum of independent exponential numbers."""
    return -log_ndtr(-u).sum(axis=1)


def series(u):
    """Any of four components fails, on either side."""
    return np.abs(u[:, :4]).max(axis=1)


def parallel(u):
    """All of three components fail."""
    return u[:, :3].min(axis=1)


CLOSED_FORMS = {
    "linear": (linear, 10, norm.isf(RARE), RARE),
    "chi-squared": (square, 8, chi2.isf(RARE, 8), RARE),
    "exponential": (exponential, 4, gamma.isf(RARE, 4), RARE),
    "series": (series, 6, norm.isf(RARE / 8), 1.0 - (1.0 - RARE / 4) ** 4),
    "parallel": (parallel, 6, norm.isf(RARE ** (1 / 3)), RARE),
}


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_intervals_hold_as_often_as_they_say(name):
    function, dimensions, limit, exact = CLOSED_FORMS[name]
    count = records(50, 200)
    found = [probability(function, dimensions, limit, seed=seed, points=80) for seed in range(count)]
    assert sum(one.low <= exact <= one.high for one in found) >= records(41, 183)  # 99.95 % of 50
    values = np.array([one.value for one in found])
    assert abs(values.mean() - exact) < 4.0 * values.std() / np.sqrt(count)


def test_rarer_than_one_of_a_billion_and_in_many_dimensions():
    found = probability(linear, 300, norm.isf(1e-9), points=200, seed=3)
    assert found.low <= 1e-9 <= found.high
    assert (found.high - found.low) / 2 < 0.3 * found.value
    assert found.levels[-1] == norm.isf(1e-9)
    assert np.all(np.diff(found.levels) > 0.0)


def test_evaluations_are_counted_and_the_seed_decides_all():
    asked = []

    def counting(u):
        asked.append(len(u))
        return linear(u)

    found = probability(counting, 3, norm.isf(1e-3), points=60, runs=8, seed=5)
    assert sum(asked) == found.evaluations
    assert probability(linear, 3, norm.isf(1e-3), points=60, runs=8, seed=5) == found
    assert probability(linear, 3, norm.isf(1e-3), points=60, runs=8, seed=6) != found


def test_what_is_not_rare_is_counted():
    found = probability(linear, 2, norm.isf(0.3), points=200)
    assert found.levels == (norm.isf(0.3),)
    assert found.low <= 0.3 <= found.high


def test_openturns_finds_the_same():
    ot = pytest.importorskip("openturns", reason="OpenTURNS is not installed (pip install openturns)")
    ot.RandomGenerator.SetSeed(1)
    ot.Log.Show(ot.Log.NONE)
    weights = np.linspace(0.2, 1.0, 12)

    def function(u):
        return u**2 @ weights + u[:, 0]

    limit = 32.0
    model = ot.PythonFunction(12, 1, func_sample=lambda x: function(np.array(x))[:, None].tolist())
    output = ot.CompositeRandomVector(model, ot.RandomVector(ot.Normal(12)))
    oracle = ot.SubsetSampling(ot.ThresholdEvent(output, ot.Greater(), limit))
    oracle.setMaximumOuterSampling(400)
    oracle.setBlockSize(50)
    oracle.run()
    other = oracle.getResult()
    found = probability(function, 12, limit, points=500)
    spread = np.hypot(
        other.getCoefficientOfVariation() * other.getProbabilityEstimate(), (found.high - found.low) / 4
    )
    assert abs(found.value - other.getProbabilityEstimate()) < 4.0 * spread


@pytest.mark.parametrize(
    ("function", "limit", "message"),
    [
        (linear, -30.0, "All of 1000 cases exceed the limit -30"),
        (lambda u: np.tanh(u[:, 0]), 1.5, "No case exceeds the limit 1.5: the largest value"),
        (lambda u: np.zeros(len(u)), 1.0, "No case exceeds the limit 1"),
        (lambda u: u[:, 0] * np.nan, 1.0, "must give one number for each point"),
        (lambda u: u, 1.0, "must give one number for each point"),
        (linear, np.inf, "must be a finite number"),
    ],
)
def test_what_cannot_be_judged_is_a_sentence(function, limit, message):
    with pytest.raises(UserError, match=message):
        probability(function, 3, limit)
