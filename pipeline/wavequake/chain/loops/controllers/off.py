"""No controller."""

from typing import Literal

from wavequake.chain.loops.block import Controller, register
from wavequake.chain.loops.design import Design


@register
class Off(Controller):
    """Nothing is done about the disturbance."""

    model: Literal["off"] = "off"

    def design(self, asked: Design) -> None:
        """Return nothing."""
        return
