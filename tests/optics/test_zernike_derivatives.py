"""Values and derivatives of annular Zernike polynomials against 60-digit Gram-Schmidt."""

from decimal import Decimal, localcontext
from math import sqrt

import numpy as np
import pytest
from gram_schmidt import gram_schmidt
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.optics.polynomials.zernike import annular_zernike, annular_zernike_gradient, noll_to_nm

TERMS = 231  # up to degree 20


def radial(eps, radii):
    """R(rho) and dR/drho of every (n, m) of the first terms, floats of 60-digit numbers."""
    with localcontext() as context:
        context.prec = 60
        degree, table = noll_to_nm(TERMS)[0], {}
        for m in range(degree + 1):
            for k, coefficients in enumerate(gram_schmidt(m, (degree - m) // 2 + 1, eps)):
                powers = [(m + 2 * i, c) for i, c in enumerate(coefficients)]
                value = [sum(c * rho**p for p, c in powers) for rho in radii]
                slope = [sum(p * c * rho ** (p - 1) for p, c in powers if p) for rho in radii]
                table[m + 2 * k, m] = np.array(value, dtype=float), np.array(slope, dtype=float)
    return table


@pytest.mark.parametrize("eps", [0.0, 0.1008133, 0.4])
def test_values_and_derivatives_equal_60_digit_gram_schmidt(eps):
    radii = [Decimal(eps) + (1 - Decimal(eps)) * step / 8 for step in range(1 if eps == 0 else 0, 9)]
    table = radial(eps, radii)
    rho, theta = (grid.ravel() for grid in np.meshgrid(np.array(radii, dtype=float), [0.3, 1.9, 4.0, 5.5]))
    cos, sin = np.cos(theta), np.sin(theta)
    results = annular_zernike_gradient(rho * cos, rho * sin, TERMS, eps)
    for j, columns in enumerate(zip(*(result.T for result in results), strict=True), start=1):
        n, m = noll_to_nm(j)
        value, slope = (np.tile(part, 4) for part in table[n, abs(m)])
        wave, turned = np.ones_like(theta), np.zeros_like(theta)
        if m:
            wave = sqrt(2) * (np.cos(m * theta) if m > 0 else np.sin(-m * theta))
            turned = sqrt(2) * (-m * np.sin(m * theta) if m > 0 else -m * np.cos(m * theta))
        outward, around = slope * wave, value / rho * turned  # polar components of the gradient
        expected = value * wave, cos * outward - sin * around, sin * outward + cos * around
        sizes = np.abs(expected[0]).max(), *[np.hypot(outward, around).max()] * 2
        for column, truth, size in zip(columns, expected, sizes, strict=True):
            np.testing.assert_allclose(column, truth, atol=1e-12 * size, rtol=0, err_msg=f"j = {j}")


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(0, 0.9), st.integers(1, 66))
def test_derivatives_are_limits_of_differences(x, y, eps, terms):
    step = 1e-5
    x, y = x / sqrt(2), y / sqrt(2)  # within the unit circle, the hole included
    at, (shift_x, shift_y) = np.array([x, x]), np.array([[-step, step]]) * np.ones((2, 1))
    _, by_x, by_y = annular_zernike_gradient(np.array([x]), np.array([y]), terms, eps)
    along_x = annular_zernike(at + shift_x, np.array([y, y]), terms, eps)
    along_y = annular_zernike(at, np.array([y, y]) + shift_y, terms, eps)
    for derivative, pair in ((by_x, along_x), (by_y, along_y)):
        size = max(1.0, np.abs(pair).max(), np.abs(derivative).max())
        np.testing.assert_allclose(derivative[0], (pair[1] - pair[0]) / (2 * step), rtol=0, atol=2e-5 * size)


def test_derivatives_of_the_first_terms_at_the_center():
    _, by_x, by_y = annular_zernike_gradient(np.zeros(1), np.zeros(1), 11)
    np.testing.assert_allclose(by_x[0], [0, 2, 0, 0, 0, 0, 0, -2 * sqrt(8), 0, 0, 0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(by_y[0], [0, 0, 2, 0, 0, 0, -2 * sqrt(8), 0, 0, 0, 0], rtol=0, atol=1e-14)


@pytest.mark.parametrize(("terms", "eps"), [(0, 0.0), (4, 1.0), (4, float("nan")), (4, -0.1)])
def test_bad_input_is_named(terms, eps):
    with pytest.raises(UserError):
        annular_zernike_gradient(np.zeros(1), np.zeros(1), terms, eps)
