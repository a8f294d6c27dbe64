"""A controller by its own matrices."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from wavequake.chain.loops.block import Controller, register
from wavequake.chain.loops.design import Design, decoupling
from wavequake.control.linear import LinearModel, linear_model
from wavequake.control.sampled.regulator import Regulator, shared_filter, whole
from wavequake.errors import UserError

Matrix = tuple[Annotated[tuple[float, ...], Field(strict=False)], ...]


@register
class StateSpace(Controller):
    """x_(k+1) = A x_k + B y_k, u_k = C x_k + D y_k, of all readings y and commands u in their units.

    Or, with `each`, from one channel's position as its readings say it to its command, the same in all.
    """

    fuses: ClassVar[bool] = True

    model: Literal["state-space"] = "state-space"
    a: Matrix = Field(
        default=(), strict=False, description="A by rows; default: no states, commands are D times readings"
    )
    b: Matrix = Field(
        default=(), strict=False, description="B by rows, from readings to states; default: no states"
    )
    c: Matrix = Field(
        default=(), strict=False, description="C by rows, from states to commands; default: no states"
    )
    d: Matrix | None = Field(default=None, strict=False, description="default: zero")
    each: bool = Field(default=False, description="the matrices are one filter for every channel")

    def design(self, asked: Design) -> Regulator:
        """Return the controller.

        Raises
        ------
        UserError
            If the matrices do not fit each other, sensor and actuator.
        """
        given = [one for one in (self.a, self.b, self.c, self.d) if one is not None]
        if any(len(set(map(len, one))) > 1 for one in given):
            raise UserError(f"controller.{self.name}: rows of a matrix have different lengths.")
        try:
            model = self._static() or linear_model(self.a, self.b, self.c, self.d)
        except UserError as error:
            raise UserError(f"controller.{self.name}: {error}") from None
        if self.each:
            if len(asked.watched) > 1:
                raise UserError(f"controller.{self.name}.each: a filter for every channel reads one sensor.")
            if model.d.shape != (1, 1):
                raise UserError(
                    f"controller.{self.name}.each: the matrices lead from {model.d.shape[1]} readings to "
                    f"{model.d.shape[0]} commands; a filter for every channel has one of each."
                )
            return shared_filter(decoupling(asked, rates=True), model)
        wanted = (len(asked.channels), asked.read)
        if model.d.shape != wanted:
            names = " and ".join(one.sensor for one in asked.watched)
            raise UserError(
                f"controller.{self.name} leads from {model.d.shape[1]} readings to {model.d.shape[0]} "
                f"commands, but the sensor {names!r} has {wanted[1]} and the actuator "
                f"{asked.actuator!r} {wanted[0]}."
            )
        return whole(model)

    def _static(self) -> LinearModel | None:
        """Return D alone; None if there are states."""
        if self.a or self.b or self.c:
            return None
        if not self.d:
            raise UserError("give a, b and c, or d alone.")
        d = np.array(self.d)
        return LinearModel(np.zeros((0, 0)), np.zeros((0, d.shape[1])), np.zeros((len(d), 0)), d)
