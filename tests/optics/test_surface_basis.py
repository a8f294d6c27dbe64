from decimal import Decimal, localcontext
from itertools import zip_longest

import numpy as np
import pytest
from gram_schmidt import gram_schmidt
from scipy.interpolate import RectBivariateSpline

from wavequake.errors import UserError
from wavequake.kernels.trace.grid_numpy import spline_grid
from wavequake.kernels.trace.polynomial_numpy import polynomial
from wavequake.kernels.trace.sequence import Grid, Ring
from wavequake.optics.polynomials.zernike import annular_zernike_gradient, noll_to_nm
from wavequake.optics.shapes.basis import spline_coefficients, zernike_basis

RNG = np.random.default_rng(11)


@pytest.mark.parametrize(
    ("terms", "obscuration", "digits"),
    [
        (1, 0.0, 15),
        (37, 0.0, 13),
        (105, 0.0, 12),
        (105, 0.4, 11),
        (231, 0.0, 9),
        (231, 0.3, 9),
        (231, 0.7, 13),
        (232, 0.0, 13),
        (325, 0.3, 13),
        (496, 0.0, 13),
        (861, 0.1, 13),
        (861, 0.7, 13),
    ],
)
def test_polynomials_are_the_zernike_ones_with_their_slopes(terms, obscuration, digits):
    radius = np.sqrt(RNG.uniform(obscuration**2, 1.0, 200))
    angle = RNG.uniform(0.0, 2 * np.pi, 200)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    coefficients = RNG.normal(size=terms)
    form = zernike_basis(terms, obscuration)
    got = polynomial(form.degree, 3.0, form.basis, form.matrix @ coefficients, 3.0 * x, 3.0 * y)
    bases = annular_zernike_gradient(x, y, terms, obscuration)
    for values, reference, scale in zip(got, bases, [1.0, 1 / 3.0, 1 / 3.0], strict=True):
        expected = reference @ coefficients * scale
        assert np.abs(values - expected).max() <= 10.0**-digits * np.abs(expected).max()


@pytest.mark.parametrize(("terms", "obscuration"), [(325, 0.3), (496, 0.0), (861, 0.1)])
@pytest.mark.parametrize("decay", [0.0, 2.0])
def test_sums_of_high_degree_are_those_of_100_digits(terms, obscuration, decay):
    """Height to 1e-13 of the largest, slopes to 1e-13 of the steepest, up to the rim."""
    orders = [noll_to_nm(j) for j in range(1, terms + 1)]
    degree = orders[-1][0]
    coefficients = RNG.normal(size=terms) / np.maximum(1.0, [n for n, _ in orders]) ** decay
    radius = np.append(np.sqrt(RNG.uniform(obscuration**2, 1.0, 20)), np.ones(5))
    angle = RNG.uniform(0.0, 2 * np.pi, 25)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    with localcontext(prec=100):
        sums = {m: [Decimal(0)] * (degree // 2 + 1) for m in range(-degree, degree + 1)}
        for m in range(degree + 1):
            for k, powers in enumerate(gram_schmidt(m, (degree - m) // 2 + 1, obscuration)):
                for signed in {m, -m}:
                    if (m + 2 * k, signed) in orders:
                        rms = Decimal(coefficients[orders.index((m + 2 * k, signed))])
                        scale = rms * Decimal(2 if m else 1).sqrt()
                        sums[signed] = [
                            a + scale * b for a, b in zip_longest(sums[signed], powers, fillvalue=Decimal(0))
                        ]
        points = zip(map(Decimal, x.tolist()), map(Decimal, y.tolist()), strict=True)
        expected = np.array([height_and_slopes(sums, *point) for point in points], dtype=np.float64)
    form = zernike_basis(terms, obscuration)
    got = polynomial(form.degree, 1.0, form.basis, form.matrix @ coefficients, x, y)
    for values, reference in zip(got, expected.T, strict=True):
        assert np.abs(values - reference).max() <= 1e-13 * np.abs(reference).max()


def height_and_slopes(sums, x, y):
    """Of the sum of P_m(x^2 + y^2) times the real (m >= 0) or imaginary part of (x + i y)^|m|."""
    square, powers, total = x * x + y * y, [(Decimal(1), Decimal(0))], [Decimal(0)] * 3
    for m in range(max(sums) + 1):
        real, imaginary = powers[-1]
        before = powers[-2] if m else (Decimal(0), Decimal(0))
        for signed in {m, -m}:
            value = sum(c * square**i for i, c in enumerate(sums[signed]))
            slope = sum(i * c * square ** (i - 1) for i, c in enumerate(sums[signed]) if i)
            if signed < 0:
                wave, wave_x, wave_y = imaginary, m * before[1], m * before[0]
            else:
                wave, wave_x, wave_y = real, m * before[0], -m * before[1]
            total[0] += value * wave
            total[1] += value * wave_x + 2 * x * slope * wave
            total[2] += value * wave_y + 2 * y * slope * wave
        powers.append((real * x - imaginary * y, real * y + imaginary * x))
    return total


def test_monomials_stay_where_they_are_exact_enough():
    """They are the fastest; wide holes spoil them earlier."""
    for terms, obscuration in [(231, 0.0), (231, 0.4), (105, 0.7)]:
        assert zernike_basis(terms, obscuration).basis == "monomial"
    for terms, obscuration in [(232, 0.0), (231, 0.5), (153, 0.9)]:
        assert zernike_basis(terms, obscuration).basis == Ring(obscuration)


def test_spline_is_that_of_fitpack_with_slopes_up_to_the_edge():
    heights = RNG.normal(size=(2, 7, 9))
    coefficients = spline_coefficients(heights)
    assert coefficients.shape == (2, 9, 11)
    grid = Grid(-4 * 0.5 - 0.5, -3 * 0.25 - 0.25, 0.5, 0.25, coefficients[0])
    x, y = RNG.uniform(-2.0, 2.0, (2, 1, 60)), RNG.uniform(-0.75, 0.75, (2, 1, 60))
    x, y = x[:, 0], y[:, 0]
    value, slope_x, slope_y = spline_grid(grid, coefficients, x, y)
    for instant in range(2):
        spline = RectBivariateSpline(np.linspace(-0.75, 0.75, 7), np.linspace(-2.0, 2.0, 9), heights[instant])
        at = (y[instant], x[instant])
        np.testing.assert_allclose(value[instant], spline.ev(*at), rtol=0, atol=1e-12)
        np.testing.assert_allclose(slope_x[instant], spline.ev(*at, dy=1), rtol=0, atol=1e-11)
        np.testing.assert_allclose(slope_y[instant], spline.ev(*at, dx=1), rtol=0, atol=1e-11)


def test_bad_numbers_are_refused():
    with pytest.raises(UserError, match="0 Zernike terms"):
        zernike_basis(0)
    with pytest.raises(UserError, match="2017 Zernike terms; it can have 1 to 2016"):
        zernike_basis(2017)
    with pytest.raises(UserError, match=r"must lie in \[0, 1\)"):
        zernike_basis(4, 1.0)
