"""Sensors, actuators and controllers of a study file: that they are there, and fit each other."""

from collections.abc import Iterable, Sequence
from typing import Annotated, Any

from pydantic import Field, field_validator, model_validator

from wavequake.campaign.schema import Section, require_own_names
from wavequake.chain.loops.block import (
    ACTUATORS,
    CONTROLLERS,
    SENSORS,
    Actuator,
    AnyBlock,
    Controller,
    Sensor,
)
from wavequake.chain.loops.closing import check_part, check_rates, check_sensors
from wavequake.chain.loops.controllers.off import Off
from wavequake.chain.loops.controllers.perfect import Perfect
from wavequake.mechanics.disturbances.population import Population


class LoopBlocks(Section):
    """The blocks of a study with loops, in which a case is run under every controller on the same draw."""

    sensor: tuple[Annotated[Sensor, AnyBlock(SENSORS)], ...] = Field(default=(), strict=False)
    actuator: tuple[Annotated[Actuator, AnyBlock(ACTUATORS)], ...] = Field(default=(), strict=False)
    controller: tuple[Annotated[Controller, AnyBlock(CONTROLLERS)], ...] = Field(min_length=1, strict=False)

    @field_validator("controller")
    @classmethod
    def _varied_values_are_controllers(cls, value: tuple[Controller, ...]) -> tuple[Controller, ...]:
        return tuple(one for each in value for one in each.varied())

    @model_validator(mode="after")
    def _blocks_fit_each_other(self) -> "LoopBlocks":
        for kind in ("sensor", "actuator", "controller"):
            require_own_names(kind, getattr(self, kind))
        for controller in self.controller:
            self._parts_are_there(controller)
        return self

    def _parts_are_there(self, one: Controller) -> None:
        if isinstance(one, Off):
            return
        for kind in ("sensor", "actuator"):
            check_part(one, kind, [part.name for part in getattr(self, kind)])
        check_sensors(one, self.sensor)
        for name in one.beside:
            other = next((each for each in self.controller if each.name == name), None)
            if other is None or other is one or isinstance(other, Off | Perfect) or other.beside:
                raise ValueError(
                    f"the controller {one.name!r} cannot run beside {name!r}: it must be another one that "
                    "reads a sensor, moves an actuator and has none beside it"
                )
            if other.actuator == one.actuator:
                raise ValueError(
                    f"the controllers {one.name!r} and {name!r} move one actuator, {one.actuator!r}; give "
                    "each its own"
                )

    def check_runs(self, populations: Iterable[Population], method: str, reference: str) -> None:
        """Raise ValueError if a controller does not fit its runs, or wavefronts are not those of loops."""
        runs = [(repr(one.name), one.duration_s) for one in populations if one.share]
        for one in self.controller:
            if not isinstance(one, Off | Perfect):
                check_rates(one, self.part("sensor", one.sensor), runs)
        if method != "opd" or reference != "chief":
            raise ValueError("loops need wavefront.method = 'opd' and wavefront.reference = 'chief'")

    def part(self, kind: str, name: str) -> Any:
        """Return the sensor, actuator or controller of a name."""
        return next(one for one in getattr(self, kind) if one.name == name)

    def sensors(self, one: Controller) -> tuple[Sensor, ...]:
        """Return the sensors of a controller."""
        return tuple(self.part("sensor", name) for name in (one.sensor, *one.also_reads))

    def running(self, one: Controller) -> Sequence[Controller]:
        """Return the controllers that run together under the name of one."""
        return (one, *(self.part("controller", name) for name in one.beside))
