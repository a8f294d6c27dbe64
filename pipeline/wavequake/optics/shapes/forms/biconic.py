"""Biconics: conics of different radii and conic constants along x and y."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from pydantic import Field

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Form
from wavequake.optics.sections import FileSection, Radius
from wavequake.optics.shapes.shape import SMALLEST_RADIUS, Array, Packed, SagAndSlopes, Shape, register
from wavequake.optics.zemax.rows import Row, numbered, written


class BiconicKeys(FileSection):
    """Keys of a study file."""

    biconic_radius_mm: Radius = Field(description="along x; radius_mm is along y; infinite for a plane")
    biconic_conic: float = Field(default=0.0, description="along x; conic is along y")


@register
@dataclass(frozen=True)
class Biconic(Shape):
    """z = (c_x x^2 + c_y y^2) / (1 + sqrt(1 - (1 + k_x) c_x^2 x^2 - (1 + k_y) c_y^2 y^2)).

    ``radius`` and ``conic`` are those along y.
    """

    radius: float
    conic: float
    x_radius: float
    x_conic: float = 0.0

    keys = BiconicKeys
    zemax = "BICONICX"

    def sag(self, x: Array, y: Array) -> SagAndSlopes:
        """Return height and slopes in closed form."""
        along = ((1.0 / self.x_radius, self.x_conic, x), (1.0 / self.radius, self.conic, y))
        square = sum(c * t * t for c, _, t in along)
        with np.errstate(invalid="ignore", divide="ignore"):
            root = np.sqrt(1.0 - sum((1.0 + k) * np.square(c * t) for c, k, t in along))
            z = square / (1.0 + root)
            slopes = [c * t * (2.0 + (1.0 + k) * c * z / root) / (1.0 + root) for c, k, t in along]
        return z, slopes[0], slopes[1]

    def packed(self) -> Packed:
        """Return curvatures and what limits their reach."""
        x, y = 1.0 / self.x_radius, 1.0 / self.radius
        squares = (1.0 + self.x_conic) * x * x, (1.0 + self.conic) * y * y
        return Packed(form=Form("biconic", (x, y, *squares), near=(x + y) / 2.0))

    def require(self) -> None:
        """Raise UserError unless the radius along x has a size and the conic constant is finite."""
        if not abs(self.x_radius) >= SMALLEST_RADIUS or not np.isfinite(self.x_conic):
            raise UserError(
                f"radius and conic constant of a {type(self).__name__} along x are {self.x_radius} mm and "
                f"{self.x_conic}; the size of the radius must be {SMALLEST_RADIUS:g} mm at least"
            )

    def added_curvature(self) -> float:
        """Return how much the mean curvature differs from that along y."""
        return 0.5 / self.x_radius - 0.5 / self.radius

    @classmethod
    def from_keys(cls, keys: Any, radius: float, conic: float, norm: float) -> Self:
        """Return the shape of a study file."""
        return cls(
            radius,
            conic,
            np.inf if keys.biconic_radius_mm is None else keys.biconic_radius_mm,
            keys.biconic_conic,
        )

    @classmethod
    def from_zemax(cls, row: Row, scale: float, radius: float, conic: float) -> Self:
        """Return the shape of a row of the type BICONICX, where the radius 0 is infinite."""
        given = numbered(row, "PARM", 1, 2)
        return cls(radius, conic, given.get(1, 0.0) * scale or np.inf, given.get(2, 0.0))

    def zemax_lines(self, where: str) -> list[str]:
        """Return radius and conic constant along x as parameters."""
        x_radius = 0.0 if np.isinf(self.x_radius) else self.x_radius
        return [f"PARM 1 {written(x_radius)}", f"PARM 2 {written(self.x_conic)}"]
