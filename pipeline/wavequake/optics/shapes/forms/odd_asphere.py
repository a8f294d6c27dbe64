"""Aspheres of all powers of the distance from the vertex, such as cones."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from pydantic import Field

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Form
from wavequake.optics.sections import FileSection
from wavequake.optics.shapes.heights import require_finite
from wavequake.optics.shapes.shape import Array, Packed, SagAndSlopes, Shape, register
from wavequake.optics.zemax.rows import Row, numbered, powers_scaled, written

MAX_TERMS = 8


class OddAsphereKeys(FileSection):
    """Keys of a study file."""

    odd_asphere: tuple[float, ...] = Field(
        strict=False, min_length=1, max_length=16, description="of r, r^2, r^3, ... in 1, mm^-1, mm^-2, ..."
    )


@register
@dataclass(frozen=True)
class OddAsphere(Shape):
    """A conic plus C_0 r + C_1 r^2 + ..., with r the distance from the axis."""

    radius: float
    conic: float
    coefficients: tuple[float, ...]

    keys = OddAsphereKeys
    zemax = "ODDASPHE"

    def over_conic(self, x: Array, y: Array) -> SagAndSlopes:
        """Return the powers and their slopes; at the tip of a cone these count as 0."""
        r = np.sqrt(x**2 + y**2)
        value, slope = np.zeros_like(r), np.zeros_like(r)
        for power, coefficient in enumerate(self.coefficients, start=1):
            value += coefficient * r**power
            slope += power * coefficient * r ** (power - 1)
        inverse = np.where(r > 0.0, 1.0 / np.where(r > 0.0, r, 1.0), 0.0)
        return value, slope * x * inverse, slope * y * inverse

    def packed(self) -> Packed:
        """Return the coefficients."""
        return Packed(form=Form("radial", self.coefficients)) if self.coefficients else Packed()

    def require(self) -> None:
        """Raise UserError unless all coefficients are finite."""
        require_finite(self, self.coefficients)

    def added_curvature(self) -> float:
        """Return that of the term r^2; a tip has none."""
        return 2.0 * self.coefficients[1] if len(self.coefficients) > 1 else 0.0

    @classmethod
    def from_keys(cls, keys: Any, radius: float, conic: float, norm: float) -> Self:
        """Return the shape of a study file."""
        return cls(radius, conic, keys.odd_asphere)

    @classmethod
    def from_zemax(cls, row: Row, scale: float, radius: float, conic: float) -> Self:
        """Return the shape of a row of the type ODDASPHE."""
        given = numbered(row, "PARM", 1, MAX_TERMS)
        return cls(radius, conic, powers_scaled(given, scale, first=1, step=1))

    def zemax_lines(self, where: str) -> list[str]:
        """Return the coefficients as parameters."""
        if len(self.coefficients) > MAX_TERMS:
            raise UserError(
                f"The surface {where} has powers up to r^{len(self.coefficients)}; a lens file holds "
                f"{MAX_TERMS}."
            )
        return [f"PARM {k} {written(value)}" for k, value in enumerate(self.coefficients, start=1)]
