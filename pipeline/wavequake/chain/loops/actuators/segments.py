"""Actuators of the segments of M1."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.chain.loops.block import Actuator, register
from wavequake.chain.loops.light import Light
from wavequake.optics.derivatives.central import DOFS
from wavequake.optics.segments.states import SurfaceStates

_UNITS = np.repeat([1e-6, 1e-9], 3)


@register
class SegmentActuators(Actuator):
    """All segments of M1 along or about their own axes: pistons (dz) in nm, tips and tilts in nrad."""

    model: Literal["segments"] = "segments"
    dofs: tuple[Literal["dz", "rx", "ry"], ...] = Field(
        default=("dz",), min_length=1, strict=False, description="of dz, rx, ry"
    )

    @property
    def segment_dofs(self) -> tuple[int, ...]:
        """Places of `dofs` among the six of a rigid body."""
        return tuple(map(DOFS.index, self.dofs))

    def channels(self, light: Light) -> tuple[str, ...]:
        """Return the degree of freedom and the segment, one degree of freedom after the other."""
        return tuple(f"{dof}[{name}]" for dof in self.dofs for name in light.layout.names)

    def put(self, light: Light, states: SurfaceStates, positions: NDArray[np.float64]) -> None:
        """Add positions to the motions of the segments."""
        count, segments = len(positions), states.segment_motion.shape[1]
        for index, dof in enumerate(self.segment_dofs):
            part = positions[:, index * segments : (index + 1) * segments]
            states.segment_motion[:count, :, dof] += part * _UNITS[dof]
