"""Zernike polynomials over a conic."""

from dataclasses import dataclass

import numpy as np

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Polynomial
from wavequake.optics.shapes.basis import zernike_basis
from wavequake.optics.shapes.heights import require_finite, zernike_heights
from wavequake.optics.shapes.shape import SMALLEST_RADIUS, Array, Packed, SagAndSlopes, Shape, register


@register
@dataclass(frozen=True)
class ZernikeSag(Shape):
    """A conic plus Noll Zernike polynomials over a pupil, annular where ``obscuration`` > 0.

    ``coefficients`` in mm, from j = 1.
    """

    radius: float
    conic: float
    coefficients: tuple[float, ...]
    pupil_radius: float
    obscuration: float = 0.0

    def over_conic(self, x: Array, y: Array) -> SagAndSlopes:
        """Return the sum of the polynomials by their recurrences."""
        return zernike_heights(np.asarray(self.coefficients), self.pupil_radius, self.obscuration, x, y)

    def packed(self) -> Packed:
        """Return the sum as monomials, or as the polynomials that the trace has recurrences for."""
        if not self.coefficients:
            return Packed()
        zernike = zernike_basis(len(self.coefficients), self.obscuration)
        coefficients = zernike.matrix @ np.asarray(self.coefficients)
        return Packed(polynomial=Polynomial(zernike.degree, self.pupil_radius, coefficients, zernike.basis))

    def require(self) -> None:
        """Raise UserError unless the coefficients are finite and the pupil has a size."""
        require_finite(self, self.coefficients)
        if not SMALLEST_RADIUS <= self.pupil_radius < np.inf:
            raise UserError(
                f"the pupil radius of a {type(self).__name__} is {self.pupil_radius}; it must be "
                f"{SMALLEST_RADIUS:g} mm at least"
            )

    def added_curvature(self) -> float:
        """Return it from slopes close to the vertex."""
        return self._by_slopes(1e-4 * self.pupil_radius)
