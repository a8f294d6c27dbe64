"""Estimators of contributions against closed forms, and their intervals against repetition."""

import numpy as np
import pytest
from scipy.stats import sobol_indices

from wavequake.workflows.budgets.indices import removed_shares, variance_shares

A, B = 7.0, 0.1


def ishigami(x):
    return np.sin(x[:, 0]) + A * np.sin(x[:, 1]) ** 2 + B * x[:, 2] ** 4 * np.sin(x[:, 0])


def pick_freeze(f, one, other):
    swapped = []
    for factor in range(one.shape[1]):
        mixed = one.copy()
        mixed[:, factor] = other[:, factor]
        swapped.append(f(mixed))
    return f(one), f(other), np.column_stack(swapped)


def test_indices_of_ishigamis_function_are_those_of_its_closed_form():
    # Ishigami & Homma 1990, Proc. ISUMA, p. 398: the variances by integration over (-pi, pi)^3.
    v1 = (1 + B * np.pi**4 / 5) ** 2 / 2
    v2, v13 = A**2 / 8, B**2 * np.pi**8 * (1 / 18 - 1 / 50)
    whole = v1 + v2 + v13
    random = np.random.default_rng(1)
    one, other = random.uniform(-np.pi, np.pi, (2, 40_000, 3))
    found = variance_shares(*pick_freeze(ishigami, one, other))
    np.testing.assert_allclose(found.first.value, [v1 / whole, v2 / whole, 0.0], rtol=0, atol=0.02)
    np.testing.assert_allclose(
        found.total.value, [(v1 + v13) / whole, v2 / whole, v13 / whole], rtol=0, atol=0.02
    )


def test_scipy_finds_the_same_indices_up_to_its_other_first_order_estimator():
    random = np.random.default_rng(2)
    one, other = random.uniform(-np.pi, np.pi, (2, 2**14, 3))
    a, b, swapped = pick_freeze(ishigami, one, other)
    ours = variance_shares(a, b, swapped)
    theirs = sobol_indices(func={"f_A": a[None], "f_B": b[None], "f_AB": swapped.T[:, None, :]}, n=2**14)
    np.testing.assert_allclose(ours.total.value, theirs.total_order, rtol=0.01, atol=1e-3)
    np.testing.assert_allclose(ours.first.value, theirs.first_order, rtol=0, atol=0.03)


def test_fractions_of_an_additive_model_are_inside_their_intervals_as_often_as_promised():
    sizes = np.array([3.0, 2.0, 1.0])
    exact = sizes**2 / np.sum(sizes**2)
    hits = np.zeros((3, 3))
    for seed in range(100):
        random = np.random.default_rng(seed)
        one, other = random.standard_normal((2, 150, 3)) * sizes
        a, b, swapped = pick_freeze(lambda x: x.sum(axis=1), one, other)
        found = variance_shares(a, b, swapped)
        removed = removed_shares(a, a[:, None] - one)
        for row, estimate in enumerate((found.first, found.total, removed)):
            hits[row] += (estimate.low <= exact) & (exact <= estimate.high)
    assert (hits / 100 >= 0.88).all()
    assert (hits / 100 <= 0.99).all()


def test_a_constant_has_no_variance_to_share_and_nothing_has_no_mean_square():
    ones = np.ones(20)
    found = variance_shares(ones, ones, np.ones((20, 2)))
    assert np.isnan(found.first.value).all()
    assert np.isnan(found.total.high).all()
    assert np.isnan(removed_shares(np.zeros(20), np.zeros((20, 1))).value).all()


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_a_large_mean_does_not_spoil_the_indices(offset):
    random = np.random.default_rng(3)
    one, other = random.standard_normal((2, 5000, 2)) * [2.0, 1.0]
    found = variance_shares(*pick_freeze(lambda x: offset + x.sum(axis=1), one, other))
    np.testing.assert_allclose(found.total.value, [0.8, 0.2], rtol=0, atol=0.03)
