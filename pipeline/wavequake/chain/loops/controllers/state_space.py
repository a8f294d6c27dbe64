"""A controller by its own matrices."""

from typing import Annotated, Literal

from pydantic import Field

from wavequake.chain.loops.block import Controller, Design, decoupling, register
from wavequake.control.linear import linear_model
from wavequake.control.sampled.regulator import Regulator, shared_filter, whole
from wavequake.errors import UserError

Matrix = tuple[Annotated[tuple[float, ...], Field(strict=False)], ...]


@register
class StateSpace(Controller):
    """x_(k+1) = A x_k + B y_k, u_k = C x_k + D y_k, of all readings y and commands u in their units.

    Or, with `each`, from one channel's position as its readings say it to its command, the same in all.
    """

    model: Literal["state-space"] = "state-space"
    a: Matrix = Field(strict=False, description="A by rows")
    b: Matrix = Field(strict=False)
    c: Matrix = Field(strict=False)
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
            model = linear_model(self.a, self.b, self.c, self.d)
        except UserError as error:
            raise UserError(f"controller.{self.name}: {error}") from None
        if self.each:
            if model.d.shape != (1, 1):
                raise UserError(
                    f"controller.{self.name}.each: the matrices lead from {model.d.shape[1]} readings to "
                    f"{model.d.shape[0]} commands; a filter for every channel has one of each."
                )
            return shared_filter(decoupling(asked, rates=True), model)
        wanted = (len(asked.channels), len(asked.readings))
        if model.d.shape != wanted:
            raise UserError(
                f"controller.{self.name} leads from {model.d.shape[1]} readings to {model.d.shape[0]} "
                f"commands, but the sensor {asked.sensor!r} has {wanted[1]} and the actuator "
                f"{asked.actuator!r} {wanted[0]}."
            )
        return whole(model)
