"""LQR with a Kalman filter, which makes up for slow actuators."""

from typing import Literal

from pydantic import Field

from wavequake.chain.loops.block import register
from wavequake.chain.loops.controllers.lqg import Filtering
from wavequake.chain.loops.design import Design
from wavequake.control.frames.disturbance import Shaped
from wavequake.control.linear import LinearModel
from wavequake.control.sampled.filters import lqr


@register
class Lqr(Filtering):
    """The regulator that leaves least at a price of moving the actuator, with a Kalman filter."""

    model: Literal["lqr"] = "lqr"
    effort: float = Field(
        default=0.01, gt=0, le=1e6, description="price of a change of the command, against what is left"
    )

    def filtered(self, asked: Design, known: Shaped, noise: float) -> LinearModel:
        """Return regulator and filter."""
        return lqr(known, noise, self.effort, asked.follows, asked.timing, asked.shows)
