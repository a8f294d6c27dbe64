"""A shape that the package does not have, as somebody else would add it: this file is all there is."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Polynomial, terms
from wavequake.optics.sections import FileSection
from wavequake.optics.shapes.shape import Packed, Shape, register
from wavequake.optics.zemax.rows import written

DEGREE = 24


class CylinderKeys(FileSection):
    """Keys of a study file."""

    cylinder_radius_mm: float = Field(description="along x; positive if the center lies on +z")


@register
@dataclass(frozen=True)
class Cylinder(Shape):
    """A conic plus a circular cylinder, curved along x; to 1e-13 mm where x < R / 4."""

    radius: float
    conic: float
    cylinder: float

    keys = CylinderKeys
    zemax = "USERSURF"

    def over_conic(self, x, y):
        """Return the circle's sag in closed form."""
        c = 1.0 / self.cylinder
        root = np.sqrt(1.0 - (c * x) ** 2)
        return c * x**2 / (1.0 + root), c * x / root, np.zeros_like(y)

    def packed(self):
        """Return the binomial series R (1 - sqrt(1 - (x / R)^2))."""
        coefficients, factor = np.zeros(terms(DEGREE)), 1.0
        for n in range(1, DEGREE // 2 + 1):
            factor *= (n - 1.5) / n  # -binomial(1/2, n) (-1)^n
            coefficients[n * (2 * n + 1)] = -factor * self.cylinder
        return Packed(polynomial=Polynomial(DEGREE, abs(self.cylinder), coefficients))

    def require(self):
        """Raise UserError unless it is curved."""
        if not 0.0 < abs(self.cylinder) < np.inf:
            raise UserError(f"the radius of a Cylinder along x is {self.cylinder} mm; it must not be 0")

    @classmethod
    def from_keys(cls, keys, radius, conic, norm):
        """Return the shape of a study file."""
        return cls(radius, conic, keys.cylinder_radius_mm)

    @classmethod
    def from_zemax(cls, row, scale, radius, conic):
        """Return the shape of a lens file."""
        return cls(radius, conic, row.table("PARM")[1] * scale)

    def zemax_lines(self, where):
        """Return the parameter of a lens file."""
        return [f"PARM 1 {written(self.cylinder)}"]
