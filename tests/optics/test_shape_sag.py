import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.optics.shapes.sag import deformation_sag, shape_sag, vertex_curvature
from wavequake.optics.shapes.shapes import (
    Conic,
    EvenAsphere,
    ExtendedPolynomial,
    GridDeformation,
    GridSag,
    ZernikeDeformation,
    ZernikeSag,
)

RNG = np.random.default_rng(5)
X, Y = RNG.uniform(-40.0, 40.0, (2, 50))
GRID = RNG.normal(size=(9, 12)) * 1e-3

SHAPES = [
    Conic(),
    Conic(-250.0, -1.3),
    EvenAsphere(300.0, 0.4, (1e-5, -2e-8, 3e-12)),
    ExtendedPolynomial(-400.0, 0.2, (0.1, -0.2, 0.05, 0.03, -0.02, 0.01, 0.0, -0.03), 50.0),
    ZernikeSag(500.0, -0.5, (0.0, 1e-3, -2e-3, 5e-4, 0.0, 1e-4, 2e-4, -1e-4), 60.0, 0.3),
    GridSag(-700.0, 0.0, GRID, 8.0, 11.0),
]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_slopes_are_the_derivatives_of_the_sag(shape):
    _, slope_x, slope_y = shape_sag(shape, X, Y)
    step = 1e-3
    along_x = (shape_sag(shape, X + step, Y)[0] - shape_sag(shape, X - step, Y)[0]) / (2 * step)
    along_y = (shape_sag(shape, X, Y + step)[0] - shape_sag(shape, X, Y - step)[0]) / (2 * step)
    np.testing.assert_allclose(slope_x, along_x, rtol=0, atol=2e-10)
    np.testing.assert_allclose(slope_y, along_y, rtol=0, atol=2e-10)


def test_sphere_is_the_textbook_one():
    z, _, _ = shape_sag(Conic(-80.0), X, Y)
    np.testing.assert_allclose(X**2 + Y**2 + (z + 80.0) ** 2, 80.0**2, rtol=1e-14)


def test_no_surface_beyond_the_reach_of_a_conic():
    z, slope_x, _ = shape_sag(Conic(10.0), np.array([9.0, 11.0]), np.zeros(2))
    assert np.isfinite([z[0], slope_x[0]]).all()
    assert np.isnan([z[1], slope_x[1]]).all()


def test_terms_of_an_extended_polynomial_follow_table_3_1():
    for index, monomial in enumerate([X, Y, X**2, X * Y, Y**2, X**3, X**2 * Y, X * Y**2, Y**3]):
        coefficients = (0.0,) * index + (2.0,)
        z, _, _ = shape_sag(ExtendedPolynomial(np.inf, 0.0, coefficients), X, Y)
        np.testing.assert_allclose(z, 2.0 * monomial, rtol=1e-14)


def test_zernike_defocus_and_coma_are_noll_s():
    rho2 = (X**2 + Y**2) / 60.0**2
    z, _, _ = shape_sag(ZernikeSag(np.inf, 0.0, (0, 0, 0, 2e-3, 0, 0, 0, 1e-3), 60.0), X, Y)
    defocus = 2e-3 * np.sqrt(3) * (2 * rho2 - 1)
    coma = 1e-3 * np.sqrt(8) * (3 * rho2 - 2) * X / 60.0
    np.testing.assert_allclose(z, defocus + coma, rtol=0, atol=1e-16)


def test_a_grid_keeps_cubic_surfaces_up_to_its_edge():
    def cubic(x, y):
        return 1e-4 * x**3 - 2e-4 * x * y**2 + 3e-4 * y**3 + 1e-3 * x * y

    x, y = np.meshgrid(np.arange(-20.0, 21.0, 8.0), np.arange(-15.0, 16.0, 6.0))
    at_x, at_y = RNG.uniform(-1, 1, (2, 30)) * [[20.0], [15.0]]
    z, slope_x, _ = shape_sag(GridSag(np.inf, 0.0, cubic(x, y), 8.0, 6.0), at_x, at_y)
    np.testing.assert_allclose(z, cubic(at_x, at_y), rtol=0, atol=1e-13)
    np.testing.assert_allclose(slope_x, 3e-4 * at_x**2 - 2e-4 * at_y**2 + 1e-3 * at_y, rtol=0, atol=1e-13)


def test_a_grid_goes_on_flat_beyond_its_edge():
    z, slope_x, slope_y = shape_sag(GridSag(np.inf, 0.0, GRID, 8.0, 11.0), np.array([100.0]), np.array([0.0]))
    edge, _, along = shape_sag(GridSag(np.inf, 0.0, GRID, 8.0, 11.0), np.array([44.0]), np.array([0.0]))
    assert z == edge
    assert slope_x == 0.0
    assert slope_y == along


@pytest.mark.parametrize(
    ("form", "shape"),
    [
        (ZernikeDeformation(8, 60.0, 0.3), SHAPES[4]),
        (GridDeformation(9, 12, 8.0, 11.0), SHAPES[5]),
    ],
)
def test_deformations_are_what_static_shapes_add_to_their_conic(form, shape):
    numbers = np.asarray(shape.coefficients) if isinstance(shape, ZernikeSag) else shape.heights
    whole = shape_sag(shape, X, Y)
    base = shape_sag(Conic(shape.radius, shape.conic), X, Y)
    for part, total, conic in zip(deformation_sag(form, numbers, X, Y), whole, base, strict=True):
        np.testing.assert_allclose(conic + part, total, rtol=0, atol=1e-15)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_vertex_curvature_is_half_the_laplacian(shape):
    step = 0.01
    ends = np.array([-step, step])
    _, along_x, _ = shape_sag(shape, ends, np.zeros(2))
    _, _, along_y = shape_sag(shape, np.zeros(2), ends)
    expected = (np.diff(along_x)[0] + np.diff(along_y)[0]) / (4 * step)
    assert vertex_curvature(shape) == pytest.approx(expected, rel=2e-4, abs=1e-9)


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        (Conic(0.0), "radius of a Conic is 0.0"),
        (Conic(1.0, np.nan), "conic constant"),
        (EvenAsphere(1.0, 0.0, (0.0, np.inf)), "coefficient 1 of a EvenAsphere"),
        (ZernikeSag(1.0, 0.0, (1.0,), 0.0), "pupil radius"),
        (ExtendedPolynomial(1.0, 0.0, (1.0,), 0.0), "normalization radius"),
        (GridSag(1.0, 0.0, np.zeros((3, 9)), 1.0, 1.0), "4 rows and 4 columns"),
        (GridSag(1.0, 0.0, np.full((5, 5), np.nan), 1.0, 1.0), "not finite"),
        (GridSag(1.0, 0.0, np.zeros((5, 5)), 0.0, 1.0), "spacings"),
    ],
)
def test_numbers_that_make_no_surface_are_refused(shape, message):
    with pytest.raises(UserError, match=message):
        shape_sag(shape, X, Y)


def test_coefficients_that_do_not_fit_a_deformation_are_refused():
    with pytest.raises(UserError, match="8 Zernike terms"):
        deformation_sag(ZernikeDeformation(8, 1.0), np.zeros(7), X, Y)
    with pytest.raises(UserError, match="9 rows and 12 columns"):
        deformation_sag(GridDeformation(9, 12, 1.0, 1.0), np.zeros((12, 9)), X, Y)
