"""Rigid-body sizes as study files give them."""

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from wavequake.mechanics.disturbances.population import NonNegative

_MICRO = 1e-6


class RigidSizes(BaseModel):
    """How much an element moves in its own frame at rest: shifts along x, y, z and turns about them."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    dx_um: NonNegative = Field(default=0.0, description="shift along x; 0: none")
    dy_um: NonNegative = Field(default=0.0, description="shift along y; 0: none")
    dz_um: NonNegative = Field(default=0.0, description="shift along z; 0: none")
    rx_urad: NonNegative = Field(default=0.0, description="turn about x; 0: none")
    ry_urad: NonNegative = Field(default=0.0, description="turn about y; 0: none")
    rz_urad: NonNegative = Field(default=0.0, description="turn about z; 0: none")

    def si(self) -> NDArray[np.float64]:
        """Return the six numbers in m and rad."""
        return _MICRO * np.array(
            [self.dx_um, self.dy_um, self.dz_um, self.rx_urad, self.ry_urad, self.rz_urad]
        )
