"""An observer of the disturbance, and poles of the actuator where one wants them."""

from typing import Literal

from pydantic import Field

from wavequake.chain.loops.block import Controller, register
from wavequake.chain.loops.design import Design, decoupling
from wavequake.control.sampled.placed import placed
from wavequake.control.sampled.regulator import Regulator, shared_filter
from wavequake.errors import UserError


@register
class PolePlacement(Controller):
    """The loop has the pole of the observer, the actuator's where they are placed, and those of the delay."""

    model: Literal["pole-placement"] = "pole-placement"
    observer_hz: float = Field(gt=0, description="of the pole that follows the disturbance")
    actuator_hz: float | None = Field(
        default=None, gt=0, description="where the actuator's poles go; default: they stay"
    )
    damping: float = Field(default=0.7, gt=0, le=10, description="of pairs of the actuator's poles")
    modes: int | None = Field(
        default=None, ge=1, description="so many best-seen motions are corrected; default: all"
    )

    def design(self, asked: Design) -> Regulator:
        """Return a filter for every channel."""
        matrix = decoupling(asked, self.modes)
        try:
            model = placed(self.observer_hz, self.actuator_hz, self.damping, asked.dynamics, asked.timing)
        except UserError as error:
            raise UserError(f"controller.{self.name}: {error}") from None
        return shared_filter(matrix, model)
