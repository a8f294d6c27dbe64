"""Aspheres of even powers of the distance from the vertex."""

from dataclasses import dataclass

import numpy as np

from wavequake.optics.shapes.heights import require_finite
from wavequake.optics.shapes.shape import Array, Packed, SagAndSlopes, Shape, register


@register
@dataclass(frozen=True)
class EvenAsphere(Shape):
    """A conic plus C_0 rho^2 + C_1 rho^4 + ... (Störkle 2018, Eq. 3.19)."""

    radius: float
    conic: float
    coefficients: tuple[float, ...]

    def over_conic(self, x: Array, y: Array) -> SagAndSlopes:
        """Return the powers and their slopes (Störkle 2018, Eq. 3.21 corrected)."""
        polynomial = np.polynomial.Polynomial([0.0, *self.coefficients])
        square = x**2 + y**2
        slope = 2.0 * polynomial.deriv()(square)
        return polynomial(square), slope * x, slope * y

    def packed(self) -> Packed:
        """Return the coefficients."""
        return Packed(even=self.coefficients)

    def require(self) -> None:
        """Raise UserError unless all coefficients are finite."""
        require_finite(self, self.coefficients)

    def added_curvature(self) -> float:
        """Return that of the term rho^2."""
        return 2.0 * self.coefficients[0] if self.coefficients else 0.0
