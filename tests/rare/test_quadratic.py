"""Quadratic forms of Gaussian numbers against closed forms, Imhof's integral and nested quadrature."""

from math import erfc, exp, pi, sqrt

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import chi2, ncx2, norm

from wavequake.campaign.rare.quadratic import exceedance, limit_of, quadratic_form, tilt_to
from wavequake.errors import UserError


@pytest.mark.parametrize("freedom", [1, 2, 7, 300])
@pytest.mark.parametrize("probability", [0.5, 0.1, 1e-4, 1e-9, 1e-100])
def test_chi_squared(freedom, probability):
    form = quadratic_form(0.0, np.zeros(freedom), np.eye(freedom))
    limit = chi2.isf(probability, freedom)
    np.testing.assert_allclose(exceedance(form, limit), probability, rtol=1e-11)
    np.testing.assert_allclose(limit_of(form, probability), limit, rtol=1e-11)


def test_a_linear_form_is_gaussian_and_a_shifted_square_not_central():
    line = quadratic_form(1.0, np.array([3.0, 4.0]), np.zeros((2, 2)))
    np.testing.assert_allclose(exceedance(line, 1.0 + 5.0 * norm.isf(1e-20)), 1e-20, rtol=1e-11)
    shift = np.array([1.0, 2.0, 0.5])
    form = quadratic_form(shift @ shift, 2.0 * shift, np.eye(3))
    for limit in (10.0, 40.0, 80.0):
        np.testing.assert_allclose(exceedance(form, limit), ncx2.sf(limit, 3, shift @ shift), rtol=1e-11)


def imhof(curvatures, slopes, constant, limit):
    """Imhof's integral of the characteristic function (1961), which knows no saddle."""
    freedom_shift = slopes / (2.0 * curvatures)
    offset = limit - constant + np.sum(curvatures * freedom_shift**2)

    def inside(u):
        a = curvatures * u
        angle = 0.5 * np.sum(np.arctan(a) + freedom_shift**2 * a / (1.0 + a**2)) - 0.5 * u * offset
        size = np.prod((1.0 + a**2) ** 0.25) * np.exp(0.5 * np.sum((freedom_shift * a) ** 2 / (1.0 + a**2)))
        return np.sin(angle) / (u * size)

    return 0.5 + quad(inside, 0.0, 120.0, limit=4000, epsabs=1e-12)[0] / np.pi


def test_imhof_says_the_same():
    random = np.random.default_rng(4)
    curvatures, slopes = random.uniform(0.2, 2.0, 9), random.normal(size=9)
    turn = np.linalg.qr(random.normal(size=(9, 9)))[0]
    form = quadratic_form(0.7, turn @ slopes, turn @ np.diag(curvatures) @ turn.T)
    for limit in (8.0, 20.0, 35.0):
        exact = imhof(curvatures, slopes, 0.7, limit)
        np.testing.assert_allclose(exceedance(form, limit), exact, rtol=0.0, atol=1e-9)


def density(x):
    """As norm.pdf, in a hundredth of the time for a single number."""
    return exp(-0.5 * x * x) / sqrt(2.0 * pi)


def above(x):
    return 0.5 * erfc(x / sqrt(2.0))


def test_curvatures_of_both_signs_and_slopes_beside_them():
    form = quadratic_form(0.0, np.array([1.0, 3.0, 2.0]), np.diag([1.0, -1.0, 0.0]))

    def over(z):
        inner = lambda y: density(y) * above((15.0 - y * y - y - 3.0 * z + z * z) / 2.0)  # noqa: E731
        return density(z) * quad(inner, -12.0, 12.0, epsabs=1e-14, limit=200)[0]

    exact = quad(over, -12.0, 12.0, epsabs=1e-13, limit=200)[0]
    np.testing.assert_allclose(exceedance(form, 15.0), exact, rtol=1e-7)


def test_tilted_draws_have_their_mean_at_the_limit_and_weights_that_undo_it():
    random = np.random.default_rng(1)
    square = random.normal(size=(6, 6))
    form = quadratic_form(0.3, random.normal(size=6), square @ square.T / 6.0)
    limit = limit_of(form, 1e-5)
    tilt = tilt_to(form, limit)
    unit = random.standard_normal((200_000, 6))
    points = tilt.drawn(unit)
    values = form.values(points)
    np.testing.assert_allclose(form.along(tilt.along(unit)), values, rtol=1e-9)
    assert abs(values.mean() - limit) < 5.0 * values.std() / np.sqrt(len(values))
    # The weight is the ratio of the densities of the points, known without the form.
    mean = points.mean(axis=0)
    covariance = np.cov(points.T)
    apart = points[:5] - mean
    ratio = -0.5 * np.sum(points[:5] ** 2, axis=1) + 0.5 * np.einsum(
        "ij,ij->i", apart, np.linalg.solve(covariance, apart.T).T
    )
    ratio += 0.5 * np.linalg.slogdet(covariance)[1]
    np.testing.assert_allclose(np.log(tilt.weights(values[:5])), ratio, atol=0.15)


def test_what_is_never_reached():
    bounded = quadratic_form(1.0, np.zeros(2), -np.eye(2))
    assert exceedance(bounded, 2.0) == 0.0
    with pytest.raises(UserError, match="No case reaches 2"):
        tilt_to(bounded, 2.0)
    assert exceedance(quadratic_form(0.0, np.zeros(1), np.eye(1)), 1e5) == 0.0
