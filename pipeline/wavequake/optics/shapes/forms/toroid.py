"""Toroids and cylinders: a curve in the plane of y and z that turns about an axis parallel to y."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from pydantic import Field

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Form
from wavequake.kernels.trace.surfaces import conic_sag, conic_slopes, even_sag_and_slopes
from wavequake.optics.sections import FileSection, Radius
from wavequake.optics.shapes.heights import require_finite
from wavequake.optics.shapes.shape import SMALLEST_RADIUS, Array, Packed, SagAndSlopes, Shape, register
from wavequake.optics.zemax.rows import Row, numbered, powers_scaled, require_no_numbers, written

MAX_TERMS = 7


class ToroidKeys(FileSection):
    """Keys of a study file."""

    toroid_radius_mm: Radius = Field(
        description="of the turn, along x; infinite for a cylinder that is curved along y"
    )
    toroid_coefficients: tuple[float, ...] = Field(
        default=(), strict=False, max_length=16, description="of y^2, y^4, ... in mm^-1, mm^-3, ..."
    )


@register
@dataclass(frozen=True)
class Toroid(Shape):
    """A conic in y plus C_0 y^2 + C_1 y^4 + ..., turned about the parallel to y through z = x_radius.

    An infinite ``x_radius`` makes a cylinder that is curved along y, an infinite ``radius`` one along x.
    """

    radius: float
    conic: float
    x_radius: float
    coefficients: tuple[float, ...] = ()

    keys = ToroidKeys
    zemax = "TOROIDAL"

    def sag(self, x: Array, y: Array) -> SagAndSlopes:
        """Return the height on the circle about the axis, and its slopes."""
        zero = np.zeros_like(y)
        curve = conic_sag(zero, y, 1.0 / self.radius, self.conic)
        steep = conic_slopes(zero, y, 1.0 / self.radius, self.conic)[1]
        if self.coefficients:
            more = even_sag_and_slopes(zero, y, self.coefficients)
            curve, steep = curve + more[0], steep + more[2]
        if np.isinf(self.x_radius):
            return curve, zero, steep
        around = self.x_radius - curve
        with np.errstate(invalid="ignore", divide="ignore"):
            cosine = np.sqrt(1.0 - np.square(x / around))
            return (
                curve + around * np.square(x / around) / (1.0 + cosine),
                x / around / cosine,
                steep / cosine,
            )

    def packed(self) -> Packed:
        """Return the curvatures and the coefficients."""
        x, y = 1.0 / self.x_radius, 1.0 / self.radius
        numbers = (x, y, (1.0 + self.conic) * y * y, *self.coefficients)
        return Packed(form=Form("toroid", numbers, near=1.0 / self.radius + self.added_curvature()))

    def require(self) -> None:
        """Raise UserError unless the radius of the turn has a size and the coefficients are finite."""
        require_finite(self, self.coefficients)
        if not abs(self.x_radius) >= SMALLEST_RADIUS:
            raise UserError(
                f"the radius along x of a {type(self).__name__} is {self.x_radius} mm; its size must be "
                f"{SMALLEST_RADIUS:g} mm at least (a cylinder: infinite)"
            )

    def added_curvature(self) -> float:
        """Return how much the mean curvature differs from that of the conic along y."""
        return 0.5 / self.x_radius - 0.5 / self.radius + sum(self.coefficients[:1])

    @classmethod
    def from_keys(cls, keys: Any, radius: float, conic: float, norm: float) -> Self:
        """Return the shape of a study file."""
        return cls(
            radius,
            conic,
            np.inf if keys.toroid_radius_mm is None else keys.toroid_radius_mm,
            keys.toroid_coefficients,
        )

    @classmethod
    def from_zemax(cls, row: Row, scale: float, radius: float, conic: float) -> Self:
        """Return the shape of a row of the type TOROIDAL, whose Zernike terms are refused."""
        extra = row.table("XDAT")
        if extra.get(1, 0.0):
            require_no_numbers(row, "XDAT", {k: value for k, value in extra.items() if k > 2})
        given = numbered(row, "PARM", 1, 1 + MAX_TERMS)
        powers = {k - 1: value for k, value in given.items() if k > 1}
        return cls(radius, conic, given.get(1, 0.0) * scale or np.inf, powers_scaled(powers, scale, 2, 2))

    def zemax_lines(self, where: str) -> list[str]:
        """Return radius and coefficients as parameters."""
        if len(self.coefficients) > MAX_TERMS:
            raise UserError(
                f"The surface {where} has powers up to y^{2 * len(self.coefficients)}; a lens file holds "
                f"{2 * MAX_TERMS}."
            )
        x_radius = 0.0 if np.isinf(self.x_radius) else self.x_radius
        return [
            f"PARM {k} {written(value)}" for k, value in enumerate((x_radius, *self.coefficients), start=1)
        ]
