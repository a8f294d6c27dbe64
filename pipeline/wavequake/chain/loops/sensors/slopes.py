"""A Shack-Hartmann sensor: mean slopes of the wavefront over subapertures."""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.chain.loops.block import Centroids, Sensor, register
from wavequake.chain.loops.displaced import Placed, seen_through
from wavequake.chain.loops.light import Light
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS

Array = NDArray[np.float64]
# Points along one side of a subaperture, over which slopes are averaged.
_POINTS = 8


@register
class SlopeSensor(Sensor, Centroids, Placed):
    """Mean slopes along x, then along y, in mas of each lit subaperture of a square grid over the pupil."""

    units: ClassVar[str] = "mas"

    model: Literal["slopes"] = "slopes"
    across: int = Field(default=10, ge=2, le=200, description="subapertures across the pupil")
    lit: float = Field(
        default=0.5, gt=0, le=1, description="least share of light of a subaperture that counts"
    )

    def labels(self, light: Light) -> tuple[str, ...]:
        """Return x and y with column and row of each subaperture."""
        columns, rows = self._lit(light)[2:]
        return tuple(f"{axis}[{i},{j}]" for axis in "xy" for i, j in zip(columns, rows, strict=True))

    def matrix(self, light: Light, nominal: bool = False) -> Array:
        """Return mean slopes, as where the image of a subaperture goes, per what is seen."""
        x, y, *_ = self._lit(light)
        inside = np.hypot(x, y)
        inside = (inside <= 1.0) & (inside >= light.obscuration)
        seen = seen_through(None if nominal else self, x.ravel(), y.ravel(), light.terms, light.obscuration)
        weight = inside / inside.sum(axis=1, keepdims=True)
        # The image goes where the optical path falls; nm per radius to mas.
        to_mas = -1e-6 / light.radius_mm / RAD_PER_MAS
        slopes = [
            np.einsum("sq,sqj->sj", weight, values.reshape(*x.shape, -1)) for values in (seen.by_x, seen.by_y)
        ]
        return np.asarray(to_mas * np.vstack(slopes)[:, 1:] @ light.noll)

    def noise_rms(self, light: Light) -> float:
        """Return that of the sensor and of the photons of one subaperture."""
        return float(np.hypot(super().noise_rms(light), self.centroid_rms()))

    def _lit(self, light: Light) -> tuple[Array, Array, Array, Array]:
        """Return points x, y (s, q) of the lit subapertures, and their columns and rows (s,)."""
        size = 2.0 / self.across
        inner = (np.arange(_POINTS) + 0.5) / _POINTS * size
        corner = np.arange(self.across) * size - 1.0
        columns, rows = (one.ravel() for one in np.meshgrid(np.arange(self.across), np.arange(self.across)))
        along, up = (one.ravel() for one in np.meshgrid(inner, inner))
        x, y = corner[columns][:, None] + along, corner[rows][:, None] + up
        distance = np.hypot(x, y)
        share = ((distance <= 1.0) & (distance >= light.obscuration)).mean(axis=1)
        chosen = share >= self.lit
        if not chosen.any():
            raise UserError(f"sensor.{self.name}: no subaperture is lit by {self.lit:g}; raise across.")
        return x[chosen], y[chosen], columns[chosen], rows[chosen]
