"""Random but constant misalignment of surfaces, bodies and segments that are chosen by name."""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.rigid import RigidSizes
from wavequake.mechanics.disturbances.source import Names, Randoms, Source, register


@register
class SurfaceRandom(Source):
    """Independent Gaussian misalignment of surfaces and bodies, constant over the instants of a case."""

    independent: ClassVar = "element"

    model: Literal["surface-random"] = "surface-random"
    instants: int = Field(default=1, ge=1, le=4096, description="all alike")
    of: Names = Field(
        description="names of surfaces, bodies and segments, or patterns such as A*; each moves for itself"
    )
    rms: RigidSizes = Field(description="dx_um, dy_um, dz_um, rx_urad, ry_urad, rz_urad of each element")

    def draw(self, layout: SegmentLayout, time: NDArray[np.float64], randoms: Randoms) -> Motion:
        """Draw six numbers for each element."""
        sizes = self.rms.si()
        moved = {
            name: np.tile(randoms(f"{self.name}/{name}").standard_normal(6) * sizes, (len(time), 1))
            for name in self.elements(layout)
        }
        return still(len(time), len(layout), rigid=moved)
