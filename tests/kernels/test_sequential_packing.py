"""What the host tells the kernel about how strongly a surface bends holds everywhere on it."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.kernels.trace import packing
from wavequake.kernels.trace.polynomial_numpy import polynomial
from wavequake.kernels.trace.sequence import Element, Grid, Moving, Polynomial, Ring, Sequence, terms


def strongest_bend(slopes, radius, points, inner=0.0):
    """Largest directional second derivative on a ring, from central differences of the slopes."""
    x, y = np.meshgrid(*[np.linspace(-radius, radius, points)] * 2)
    on_ring = (np.hypot(x, y) <= radius) & (np.hypot(x, y) >= inner)
    x, y = x[on_ring], y[on_ring]
    h = 1e-5 * radius
    right, left, up, down = (slopes(x + h * a, y + h * b) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1)))
    xx, xy = ((right[k] - left[k]) / (2 * h) for k in (0, 1))
    yy = (up[1] - down[1]) / (2 * h)
    mean, spread = 0.5 * np.abs(xx + yy), np.hypot(0.5 * (xx - yy), xy)
    return (mean + spread).max()


def bend_of(element):
    bends = packing._bends(0, element, Moving(np.zeros((1, 1, 12))), [])
    return float(bends[0]), packing._parts(element, None, [])[1]


@pytest.mark.parametrize("basis", ["monomial", Ring(), Ring(0.4)], ids=str)
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 6, 13, 20])
def test_no_polynomial_bends_more_than_the_host_says(degree, basis):
    random = np.random.default_rng(degree)
    inner = 0.0 if basis == "monomial" else 40.0 * basis.inner
    for kind in range(6):
        coefficients = random.normal(size=terms(degree)) / (1.0 + np.arange(terms(degree))) ** (0.5 * kind)
        element = Element(polynomial=Polynomial(degree, 40.0, coefficients, basis))
        bend, reach = bend_of(element)
        true = strongest_bend(
            lambda x, y, c=coefficients: polynomial(degree, 40.0, basis, c, x, y)[1:], reach, 121, inner
        )
        assert true <= bend + 1e-8
        # Not so cautious that weak surfaces would seem strong.
        assert bend <= 6.0 * true + 1e-8


@pytest.mark.parametrize("degree", [6, 13, 20])
def test_bumps_do_not_bend_more_than_the_host_says(degree):
    """Bumps at the center are steepest where random polynomials are not."""
    i = np.arange(3000) + 0.5
    u, v = np.sqrt(i / 3000) * np.stack([np.cos(i * 2.39996), np.sin(i * 2.39996)])
    basis = np.stack([u ** (n - j) * v**j for n in range(degree + 1) for j in range(n + 1)], axis=1)
    for width, place in ((0.2, 0.0), (0.4, 0.0), (0.3, 0.3), (0.3, 0.7)):
        bump = np.exp(-((u - place) ** 2 + v**2) / width**2)
        coefficients = np.linalg.lstsq(basis, bump, rcond=None)[0]
        bend, reach = bend_of(Element(polynomial=Polynomial(degree, 40.0, coefficients)))
        true = strongest_bend(
            lambda x, y, c=coefficients: polynomial(degree, 40.0, "monomial", c, x, y)[1:], reach, 121
        )
        assert true <= bend <= 6.0 * true


def test_powers_beyond_the_range_of_numbers_are_refused():
    for radius in (1e-15, 1e15):
        element = Element(polynomial=Polynomial(20, radius, np.ones(terms(20))))
        with pytest.raises(UserError, match="a polynomial of degree 20 over a radius of 1e"):
            bend_of(element)


def test_no_grid_bends_more_than_the_host_says():
    from wavequake.kernels.trace.grid_numpy import spline_grid

    random = np.random.default_rng(3)
    for _ in range(5):
        grid = Grid(-50.0, -60.0, 10.0, 12.0, random.normal(size=(11, 11)))
        bend, reach = bend_of(Element(grid=grid))
        assert reach == np.inf
        # Inside of the edge, where the slope jumps.
        assert (
            strongest_bend(lambda x, y, g=grid: spline_grid(g, g.coefficients, x, y)[1:], 39.0, 201) <= bend
        )


def test_even_powers_always_take_the_full_iteration():
    sequence = Sequence((Element(even=(1e-9,)), Element()))
    layout, limits, _ = packing.packed_elements(sequence, Moving(np.zeros((3, 2, 12))), False)
    assert limits.shape == (3, 1)
    assert (limits < 0.0).all()
    assert [shape.bare for shape in layout.shapes] == [False, True]
    assert layout.numbers.dtype == np.float64


def test_one_program_serves_all_batches_of_elements_that_may_turn():
    """Its text is its shapes': the program of a batch that turns, even where nothing does."""
    moved = np.zeros((2, 2, 12))
    moved[:, :, [0, 4, 8]] = 1.0
    moved[:, :, 11] = -5.0
    tilted = moved.copy()
    tilted[1, 1, [4, 5, 7, 8]] = np.cos(0.1), np.sin(0.1), -np.sin(0.1), np.cos(0.1)
    for turning, same in ((True, True), (False, False)):
        sequence = Sequence((Element(-0.01, action="reflect"), Element()), turning=turning)
        shapes = [
            packing.packed_elements(sequence, Moving(poses), False)[0].shapes for poses in (moved, tilted)
        ]
        assert (shapes[0] == shapes[1]) is same
        assert [shape.rotates for shape in shapes[1]] == [turning, True]
