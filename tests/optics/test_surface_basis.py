import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline

from wavequake.errors import UserError
from wavequake.kernels.grid_numpy import spline_grid
from wavequake.kernels.polynomial_numpy import polynomial
from wavequake.kernels.sequence import Grid
from wavequake.optics.surface_basis import spline_coefficients, zernike_basis
from wavequake.optics.zernike import annular_zernike_gradient

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
        (496, 0.0, 6),
    ],
)
def test_polynomials_are_the_zernike_ones_with_their_slopes(terms, obscuration, digits):
    radius = np.sqrt(RNG.uniform(obscuration**2, 1.0, 200))
    angle = RNG.uniform(0.0, 2 * np.pi, 200)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    coefficients = RNG.normal(size=terms)
    form = zernike_basis(terms, obscuration)
    got = polynomial(form.degree, 3.0, "monomial", form.matrix @ coefficients, 3.0 * x, 3.0 * y)
    bases = annular_zernike_gradient(x, y, terms, obscuration)
    for values, reference, scale in zip(got, bases, [1.0, 1 / 3.0, 1 / 3.0], strict=True):
        expected = reference @ coefficients * scale
        assert np.abs(values - expected).max() <= 10.0**-digits * np.abs(expected).max()


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
        np.testing.assert_allclose(value[instant], spline.ev(*at), atol=1e-12)
        np.testing.assert_allclose(slope_x[instant], spline.ev(*at, dy=1), atol=1e-11)
        np.testing.assert_allclose(slope_y[instant], spline.ev(*at, dx=1), atol=1e-11)


def test_bad_numbers_are_refused():
    with pytest.raises(UserError, match="0 Zernike terms"):
        zernike_basis(0)
    with pytest.raises(UserError, match=r"must lie in \[0, 1\)"):
        zernike_basis(4, 1.0)
