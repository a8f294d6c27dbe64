"""Rigid-body sizes as study files give them."""

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from wavequake.mechanics.disturbances.population import NonNegative

_MICRO = 1e-6


class RigidSizes(BaseModel):
    """How much an element moves in its own frame at rest: shifts along x, y, z and turns about them."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)

    dx_um: NonNegative = 0.0
    dy_um: NonNegative = 0.0
    dz_um: NonNegative = 0.0
    rx_urad: NonNegative = 0.0
    ry_urad: NonNegative = 0.0
    rz_urad: NonNegative = 0.0

    def si(self) -> NDArray[np.float64]:
        """Return the six numbers in m and rad."""
        return _MICRO * np.array(
            [self.dx_um, self.dy_um, self.dz_um, self.rx_urad, self.ry_urad, self.rz_urad]
        )
