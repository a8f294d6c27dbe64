import json
from math import sqrt
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.optics.polynomials.zernike import annular_zernike, circular_zernike_xy, noll_to_nm

REFERENCE = json.loads((Path(__file__).parents[1] / "data" / "zernike_annular.json").read_text())


def quadrature(obscuration, radii, azimuths):
    """Points and weights that integrate polynomials of degree 4 radii - 2 exactly over an annulus."""
    nodes, weights = np.polynomial.legendre.leggauss(radii)
    rho = np.sqrt(obscuration**2 + (1 - obscuration**2) * (nodes + 1) / 2)
    theta = 2 * np.pi * np.arange(azimuths) / azimuths
    x, y = np.outer(rho, np.cos(theta)).ravel(), np.outer(rho, np.sin(theta)).ravel()
    return x, y, np.repeat(weights / 2 / azimuths, azimuths)


def test_noll_indices_are_those_of_the_reference():
    assert [list(noll_to_nm(j)) for j in range(1, 46)] == REFERENCE["nm"]


@given(st.integers(1, 2000))
def test_noll_indices_follow_the_thesis_formulas(j):
    n = int((sqrt(8 * j - 7) - 1) // 2)  # Störkle 2018, Eq. 3.46 and 3.47
    term = 2 * j - n * (n + 1)
    m = 2 * (term // 4) if n % 2 == 0 else 2 * -(-term // 4) - 1
    assert noll_to_nm(j) == (n, m if j % 2 == 0 else -m)


@pytest.mark.parametrize("obscuration", REFERENCE["radial_coefficients"])
def test_annular_polynomials_equal_60_digit_gram_schmidt(obscuration):
    coefficients = REFERENCE["radial_coefficients"][obscuration]
    rho, theta = np.meshgrid(np.linspace(float(obscuration), 1.0, 7), [0.0, 0.3, 1.1, 2.5, 4.0, 5.7])
    rho, theta = rho.ravel(), theta.ravel()
    basis = annular_zernike(rho * np.cos(theta), rho * np.sin(theta), 45, float(obscuration))
    for (n, m), column in zip(REFERENCE["nm"], basis.T, strict=True):
        radial = sum(c * rho ** (abs(m) + 2 * k) for k, c in enumerate(coefficients[f"{n},{abs(m)}"]))
        wave = 1.0 if m == 0 else sqrt(2) * (np.cos(m * theta) if m > 0 else np.sin(-m * theta))
        np.testing.assert_allclose(column, radial * wave, atol=1e-12, rtol=0)


@pytest.mark.parametrize("obscuration", [0.0, 0.1008133, 0.4, 0.95])
def test_first_231_polynomials_are_orthonormal(obscuration):
    x, y, weight = quadrature(obscuration, 22, 44)
    basis = annular_zernike(x, y, 231, obscuration)
    np.testing.assert_allclose(basis.T @ (weight[:, None] * basis), np.eye(231), rtol=0, atol=1e-12)


@given(st.floats(-0.75, 0.75), st.floats(-0.75, 0.75))
def test_circular_monomials_give_the_same_polynomials(u, v):
    degree, terms = 6, 28
    monomials = np.array([u ** (n - k) * v**k for n in range(degree + 1) for k in range(n + 1)])
    values = annular_zernike(np.array([u]), np.array([v]), terms)[0]
    np.testing.assert_allclose(monomials @ circular_zernike_xy(degree, terms), values, rtol=0, atol=1e-12)


def test_circular_monomials_of_the_low_terms_are_those_of_noll():
    matrix = circular_zernike_xy(3, 8)
    assert matrix[:, 3] == pytest.approx(sqrt(3) * np.array([-1, 0, 0, 2, 0, 2, 0, 0, 0, 0]))  # 2 rho^2 - 1
    assert matrix[:, 4] == pytest.approx(sqrt(6) * np.array([0, 0, 0, 0, 2, 0, 0, 0, 0, 0]))  # 2 u v
    assert matrix[:, 6] == pytest.approx(
        sqrt(8) * np.array([0, 0, -2, 0, 0, 0, 0, 3, 0, 3])
    )  # (3 rho^2 - 2) v


@pytest.mark.parametrize(
    "call",
    [
        lambda: noll_to_nm(0),
        lambda: annular_zernike(np.zeros(1), np.zeros(1), 0),
        lambda: annular_zernike(np.zeros(1), np.zeros(1), 4, 1.0),
        lambda: annular_zernike(np.zeros(1), np.zeros(1), 4, float("nan")),
        lambda: circular_zernike_xy(2, 7),
    ],
)
def test_bad_input_is_named(call):
    with pytest.raises(UserError):
        call()
