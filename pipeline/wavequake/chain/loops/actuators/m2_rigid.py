"""A hexapod or tip-tilt stage that moves M2 as a rigid body."""

from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from wavequake.chain.loops.block import Actuator, each_once, register
from wavequake.chain.loops.light import Light
from wavequake.chain.loops.structure import Dof
from wavequake.optics.derivatives.central import DOFS
from wavequake.optics.segments.telescope import M2
from wavequake.optics.systems.system import States

Dofs = Annotated[tuple[Dof, ...], AfterValidator(each_once)]
# nm and nrad to mm and rad.
UNITS = np.repeat([1e-6, 1e-9], 3)


@register
class RigidM2(Actuator):
    """M2 as a rigid body: translations in nm, rotations in nrad (Störkle 2018, Eq. 4.24)."""

    step = 1000.0

    model: Literal["m2-rigid"] = "m2-rigid"
    dofs: Dofs = Field(
        default=("rx", "ry"), min_length=1, strict=False, description="of dx, dy, dz, rx, ry, rz"
    )

    def channels(self, light: Light) -> tuple[str, ...]:
        """Return the degrees of freedom."""
        return self.dofs

    def put(self, light: Light, states: States, positions: NDArray[np.float64]) -> None:
        """Add positions to the motion of M2."""
        places = [DOFS.index(one) for one in self.dofs]
        states.surface_motion[: len(positions), M2, places] += positions * UNITS[places]
