from math import sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.optics.polynomials.transforms import expansion_matrix, transform_coefficients
from wavequake.optics.polynomials.zernike import annular_zernike, noll_to_nm

OBSCURATIONS = st.floats(0, 0.6)


@given(OBSCURATIONS, OBSCURATIONS, st.integers(1, 66), st.integers(0, 9))
def test_both_expansions_are_the_same_wavefront(source, target, terms, seed):
    random = np.random.default_rng(seed)
    coefficients = random.normal(size=(3, terms))
    rho, theta = np.sqrt(random.uniform(source**2, 1, 40)), random.uniform(0, 2 * np.pi, 40)
    x, y = rho * np.cos(theta), rho * np.sin(theta)
    transformed = transform_coefficients(coefficients, source, target)
    before = coefficients @ annular_zernike(x, y, terms, source).T
    after = transformed @ annular_zernike(x, y, terms, target).T
    np.testing.assert_allclose(
        after, before, rtol=0, atol=1e-13 * terms * max(1.0, np.abs(transformed).max())
    )


@given(OBSCURATIONS, OBSCURATIONS, st.integers(1, 66))
def test_there_and_back_is_the_identity(source, target, terms):
    there, back = expansion_matrix(terms, source, target), expansion_matrix(terms, target, source)
    size = np.abs(there).max() * np.abs(back).max()
    np.testing.assert_allclose(there @ back, np.eye(terms), rtol=0, atol=1e-13 * size)


@given(OBSCURATIONS, st.integers(1, 66))
def test_only_lower_degrees_of_equal_frequency_mix(eps, terms):
    orders = [noll_to_nm(j) for j in range(1, terms + 1)]
    allowed = np.array([[a[1] == b[1] and b[0] <= a[0] for b in orders] for a in orders])
    matrix = expansion_matrix(terms, eps, 0.0)
    assert not matrix[~allowed].any()
    np.testing.assert_allclose(expansion_matrix(terms, eps, eps), np.eye(terms), rtol=0, atol=1e-13)


def test_first_terms_in_closed_form():
    """From Mahajan 1981: piston, tilt, defocus, astigmatism and coma over an annulus."""
    e = 0.4
    matrix = expansion_matrix(8, e, 0.0)
    expected = np.zeros((8, 8))
    expected[0, 0] = 1
    expected[1, 1] = expected[2, 2] = 1 / sqrt(1 + e**2)
    expected[3, [0, 3]] = (
        -sqrt(3) * e**2 / (1 - e**2),
        1 / (1 - e**2),
    )  # sqrt(3) (2 r^2 - 1 - e^2) / (1 - e^2)
    expected[4, 4] = expected[5, 5] = 1 / sqrt(1 + e**2 + e**4)
    # sqrt(8) (3 (1 + e^2) r^3 - 2 (1 + e^2 + e^4) r) / ((1 - e^2) sqrt((1 + e^2) (1 + 4 e^2 + e^4)))
    norm = (1 - e**2) * sqrt((1 + e**2) * (1 + 4 * e**2 + e**4))
    for coma, tilt in ((6, 2), (7, 1)):
        expected[coma, coma] = (1 + e**2) / norm
        expected[coma, tilt] = sqrt(2) * (2 * (1 + e**2) - 2 * (1 + e**2 + e**4)) / norm
    np.testing.assert_allclose(matrix, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("eps", [0.1008133, 0.4])
def test_231_terms_stay_exact(eps):
    there, back = expansion_matrix(231, 0.0, eps), expansion_matrix(231, eps, 0.0)
    np.testing.assert_allclose(back @ there, np.eye(231), rtol=0, atol=1e-12 * np.abs(back).max())
    x, y = np.random.default_rng(3).uniform(-0.7, 0.7, size=(2, 30))
    circular = annular_zernike(x, y, 231)
    annular = annular_zernike(x, y, 231, eps)
    size = np.abs(annular).max()
    np.testing.assert_allclose(annular @ there.T, circular, rtol=0, atol=1e-12 * size)


@pytest.mark.parametrize("arguments", [(0, 0.1, 0.0), (4, 1.0, 0.0), (4, 0.0, 1.0), (4, 0.0, float("nan"))])
def test_bad_input_is_named(arguments):
    with pytest.raises(UserError):
        expansion_matrix(*arguments)
