"""Polynomials in x and y over a conic."""

from dataclasses import dataclass

import numpy as np

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Polynomial
from wavequake.optics.shapes.heights import require_finite
from wavequake.optics.shapes.shape import SMALLEST_RADIUS, Array, Packed, SagAndSlopes, Shape, register


@register
@dataclass(frozen=True)
class ExtendedPolynomial(Shape):
    """A conic plus C_0 x + C_1 y + C_2 x^2 + C_3 x y + ... (Störkle 2018, Eq. 3.22, Table 3.1).

    x and y are divided by ``normalization_radius``, so the coefficients are lengths.
    """

    radius: float
    conic: float
    coefficients: tuple[float, ...]
    normalization_radius: float = 1.0

    def over_conic(self, x: Array, y: Array) -> SagAndSlopes:
        """Return the sum of the terms as they are written, and its slopes."""
        radius = self.normalization_radius
        u, v = x / radius, y / radius
        value, slope_x, slope_y = np.zeros_like(u), np.zeros_like(u), np.zeros_like(u)
        powers = extended_powers(len(self.coefficients))
        for (i, j), coefficient in zip(powers, self.coefficients, strict=True):
            value += coefficient * u**i * v**j
            slope_x += coefficient * i * u ** max(i - 1, 0) * v**j / radius
            slope_y += coefficient * j * u**i * v ** max(j - 1, 0) / radius
        return value, slope_x, slope_y

    def packed(self) -> Packed:
        """Return the polynomial with the constant that the trace counts first."""
        if not self.coefficients:
            return Packed()
        degree = sum(extended_powers(len(self.coefficients))[-1])
        coefficients = np.zeros((degree + 1) * (degree + 2) // 2)
        coefficients[1 : 1 + len(self.coefficients)] = self.coefficients
        return Packed(polynomial=Polynomial(degree, self.normalization_radius, coefficients))

    def require(self) -> None:
        """Raise UserError unless the coefficients are finite and the normalization radius is positive."""
        require_finite(self, self.coefficients)
        if not self.normalization_radius >= SMALLEST_RADIUS:
            raise UserError(
                f"the normalization radius of a {type(self).__name__} is {self.normalization_radius}; it "
                f"must be positive, {SMALLEST_RADIUS:g} mm at least"
            )

    def added_curvature(self) -> float:
        """Return the mean of those of x^2 and y^2."""
        square = [*self.coefficients, 0.0, 0.0, 0.0, 0.0, 0.0]
        return (square[2] + square[4]) / self.normalization_radius**2


def extended_powers(count: int) -> list[tuple[int, int]]:
    """Return the powers of x and y of an extended polynomial's terms (Störkle 2018, Table 3.1)."""
    powers: list[tuple[int, int]] = []
    degree = 1
    while len(powers) < count:
        powers += [(degree - j, j) for j in range(degree + 1)]
        degree += 1
    return powers[:count]
