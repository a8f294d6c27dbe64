"""A hexapod or tip-tilt stage that carries a mirror, lens or detector."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.chain.loops.actuators.m2_rigid import UNITS, Dofs
from wavequake.chain.loops.block import Actuator, register
from wavequake.chain.loops.light import Light
from wavequake.errors import UserError
from wavequake.optics.derivatives.central import DOFS
from wavequake.optics.systems.system import States


@register
class Stage(Actuator):
    """A surface or a body of surfaces, such as a lens: translations in nm, rotations in nrad.

    In segmented telescopes those after M1; a body has the axes of its first surface there, and turns about
    the middle between its first and last vertex.
    """

    # Lenses in slow beams do little: 20 um and 20 urad.
    step = 2e4

    model: Literal["optic"] = "optic"
    of: str = Field(description="name of the surface or body, as M3, camera lens or image")
    dofs: Dofs = Field(
        default=("dx", "dy"), min_length=1, strict=False, description="of dx, dy, dz, rx, ry, rz"
    )
    mass_kg: float | None = Field(
        default=None,
        gt=0,
        le=1e9,
        description="that it moves, of the mass of the body with mass that carries it, which it pushes back; "
        "default: that of a rigid body which it moves",
    )

    @property
    def carried_kg(self) -> float | None:
        """Mass that it moves."""
        return self.mass_kg

    def channels(self, light: Light) -> tuple[str, ...]:
        """Return the degrees of freedom.

        Raises
        ------
        UserError
            If there is no such surface or body.
        """
        if self.of not in light.movable:
            raise UserError(
                f"actuator.{self.name}.of: there is no surface or body {self.of!r} to move; there is "
                f"{', '.join(light.movable)}."
            )
        return self.dofs

    def motion(self, positions: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Return the motion of the surface or body."""
        moved = np.zeros((len(positions), 6))
        moved[:, [DOFS.index(one) for one in self.dofs]] = 1e-9 * positions
        return {self.of: moved}

    def put(self, light: Light, states: States, positions: NDArray[np.float64]) -> None:
        """Add positions to the motions of its surfaces."""
        places = [DOFS.index(one) for one in self.dofs]
        moved = light.movable[self.of][places] * UNITS[places][:, None, None]
        states.surface_motion[: len(positions)] += np.tensordot(positions, moved, 1)
