"""H-infinity: bounds on the sensitivity and on the effort that hold at every frequency."""

from typing import Literal

from pydantic import Field

from wavequake.chain.loops.block import Controller, register
from wavequake.chain.loops.design import Design, decoupling
from wavequake.control.sampled.regulator import Regulator, shared_filter
from wavequake.control.sampled.robust import robust
from wavequake.errors import UserError


@register
class HInfinity(Controller):
    """|S| stays below f / bandwidth_hz up to it and below peak beyond, |K S| below effort."""

    model: Literal["h-infinity"] = "h-infinity"
    bandwidth_hz: float = Field(gt=0, description="up to it |S| rises from 1e-4, at most as f / bandwidth_hz")
    peak: float = Field(default=2.0, gt=1, le=100, description="largest |S|")
    effort: float = Field(default=2.0, gt=0, le=1e6, description="largest command per disturbance of 1")
    modes: int | None = Field(
        default=None, ge=1, description="so many best-seen motions are corrected; default: all"
    )

    def design(self, asked: Design) -> Regulator:
        """Return a filter for every channel."""
        matrix = decoupling(asked, self.modes)
        if self.bandwidth_hz >= 0.5 / asked.timing.period:
            raise UserError(
                f"controller.{self.name}.bandwidth_hz is {self.bandwidth_hz:g}, not below half of its "
                f"{1 / asked.timing.period:g} commands per second."
            )
        try:
            model = robust(self.bandwidth_hz, self.peak, self.effort, asked.dynamics, asked.timing)
        except UserError as error:
            raise UserError(f"controller.{self.name}: {error}") from None
        return shared_filter(matrix, model)
