"""Integrator, with leak, proportional part and gains by mode."""

from typing import Literal

import numpy as np
from pydantic import Field

from wavequake.chain.loops.block import Controller, register
from wavequake.chain.loops.design import Design, decoupling
from wavequake.control.sampled.filters import crossover_gain, integrator
from wavequake.control.sampled.regulator import Regulator, shared_filter
from wavequake.errors import UserError


@register
class Integrator(Controller):
    """u_k = (1 - leak) u_(k-1) - gain z_k, z the decoupled reading, plus a proportional part."""

    model: Literal["integrator"] = "integrator"
    gain: float | None = Field(default=None, gt=0, description="default: 0.5, or that of bandwidth_hz")
    bandwidth_hz: float | None = Field(
        default=None, gt=0, description="where the loop gain is 1, in place of gain: 2 sin(pi f T)"
    )
    leak: float = Field(default=0.0, ge=0, le=1, description="share of the command that is lost per period")
    proportional: float = Field(default=0.0, ge=0, description="gain of the proportional part (PI)")
    mode_gains: dict[str, float] = Field(
        default_factory=dict, description="factors of the gain by channel, as Z7 = 0.5"
    )
    modes: int | None = Field(
        default=None, ge=1, description="so many best-seen motions are corrected; default: all"
    )

    def design(self, asked: Design) -> Regulator:
        """Return an integrator for every channel."""
        factors = np.ones(len(asked.channels))
        for name, value in self.mode_gains.items():
            if name not in asked.channels:
                raise UserError(
                    f"controller.{self.name}.mode_gains: {asked.actuator!r} has no channel {name!r}; it has "
                    f"{asked.channels[0]} to {asked.channels[-1]}."
                )
            factors[asked.channels.index(name)] = value
        model = integrator(self._gain(asked.timing.period), self.leak, self.proportional)
        return shared_filter(factors[:, None] * decoupling(asked, self.modes), model)

    def _gain(self, period: float) -> float:
        if self.bandwidth_hz is None:
            return 0.5 if self.gain is None else self.gain
        if self.gain is not None:
            raise UserError(f"controller.{self.name}: give gain or bandwidth_hz, not both.")
        if self.bandwidth_hz >= 0.5 / period:
            raise UserError(
                f"controller.{self.name}.bandwidth_hz is {self.bandwidth_hz:g}, not below half of its "
                f"{1 / period:g} commands per second."
            )
        return crossover_gain(self.bandwidth_hz, period)
