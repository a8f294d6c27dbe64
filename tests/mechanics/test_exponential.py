"""Exponentials of stacks against SciPy's, one by one, and closed forms."""

import numpy as np
import pytest
from scipy.linalg import expm

from wavequake.mechanics.vibration.exponential import exponentials

RANDOM = np.random.default_rng(5)


@pytest.mark.parametrize("size", [1e-6, 0.3, 5.0, 60.0])
@pytest.mark.parametrize("kind", ["real", "complex"])
def test_they_are_those_of_scipy(size, kind):
    matrices = size * RANDOM.standard_normal((7, 5, 5)) / 5.0
    if kind == "complex":
        matrices = matrices + 1j * size * RANDOM.standard_normal((7, 5, 5)) / 5.0
    matrices[3] *= 1e-3  # each has squarings of its own
    for found, matrix in zip(exponentials(matrices), matrices, strict=True):
        np.testing.assert_allclose(
            found, expm(matrix), rtol=0, atol=2e-14 * size * np.abs(found).max() + 1e-15
        )


def test_oscillators_turn():
    angle = np.array([1e-9, 0.1, 3.0, 200.0])
    turning = angle[:, None, None] * np.array([[0.0, 1.0], [-1.0, 0.0]])
    found = exponentials(turning)
    np.testing.assert_allclose(found[:, 0, 0], np.cos(angle), atol=1e-13)
    np.testing.assert_allclose(found[:, 0, 1], np.sin(angle), atol=1e-13)


def test_one_that_is_not_finite_spoils_no_other():
    matrices = RANDOM.standard_normal((3, 2, 2))
    whole = exponentials(matrices)
    matrices[1, 0, 1] = np.nan
    found = exponentials(matrices)
    assert np.isnan(found[1]).all()
    np.testing.assert_array_equal(found[[0, 2]], whole[[0, 2]])
    assert exponentials(np.zeros((0, 2, 2))).shape == (0, 2, 2)
