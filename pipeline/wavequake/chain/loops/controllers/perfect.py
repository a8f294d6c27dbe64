"""The correction that knows the same instant's reading without delay or error, and acts at once."""

from typing import Literal

from pydantic import Field

from wavequake.chain.loops.block import Controller, register
from wavequake.chain.loops.design import Design, decoupling
from wavequake.control.sampled.regulator import Instant


@register
class Perfect(Controller):
    """Minus the pseudo-inverse of the sensitivities times the reading (Störkle 2018, Eq. 4.25 and 4.27).

    Sensor and actuator have no dynamics, frames, noise or limits here.
    """

    model: Literal["perfect"] = "perfect"
    modes: int | None = Field(
        default=None, ge=1, description="so many best-seen motions are corrected; default: all"
    )

    def design(self, asked: Design) -> Instant:
        """Return the pseudo-inverse."""
        return Instant(decoupling(asked, self.modes))
