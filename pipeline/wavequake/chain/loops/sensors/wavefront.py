"""A wavefront sensor that gives Zernike modes."""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.chain.loops.block import Sensor, register
from wavequake.chain.loops.displaced import Placed, seen_through
from wavequake.chain.loops.light import Light
from wavequake.errors import UserError
from wavequake.optics.rays.pupils import sunflower

Array = NDArray[np.float64]


@register
class WavefrontSensor(Sensor, Placed):
    """Noll coefficients 2..j of the wavefront in nm, the line of sight as its tilt."""

    units: ClassVar[str] = "nm"

    model: Literal["wavefront"] = "wavefront"
    terms: int | None = Field(
        default=None, ge=3, description="highest Noll index; default: that of wavefront.zernike_terms"
    )

    def labels(self, light: Light) -> tuple[str, ...]:
        """Return Z2, Z3, ..."""
        return tuple(f"Z{j}" for j in range(2, self._last(light) + 1))

    def matrix(self, light: Light, nominal: bool = False) -> Array:
        """Return Noll coefficients 2..j per what is seen."""
        last = self._last(light) - 1
        if nominal or (self.shift == (0.0, 0.0) and self.rotation_deg == 0.0 and self.magnification == 1.0):
            return light.noll[:last]
        points = sunflower(light.obscuration, 1.0, 40 * light.terms)
        right, wrong = (
            seen_through(placed, points.x, points.y, light.terms, light.obscuration).values
            for placed in (None, self)
        )
        turned = np.linalg.lstsq(right, wrong, rcond=None)[0][1:, 1:]
        return np.asarray(turned[:last] @ light.noll)

    def _last(self, light: Light) -> int:
        if self.terms is not None and self.terms > light.terms:
            raise UserError(
                f"sensor.{self.name}.terms is {self.terms}, more than wavefront.zernike_terms {light.terms}."
            )
        return self.terms or light.terms
