"""Study files of ``telescope-loop``: the segments of a telescope, what disturbs them, and loops."""

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from wavequake.campaign.schema import Section
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
from wavequake.chain.loops.structure import CarryingMode
from wavequake.workflows.exposures.exposure_study import TelescopeExposureStudy
from wavequake.workflows.segments.segment_study import SegmentStudy

_ROUNDING = 1e-9


class LookSection(Section):
    """What is looked at of a run."""

    traced: int = Field(
        default=16,
        ge=0,
        le=4096,
        description="instants of a case that are traced in full, evenly spread: they make the exposure, and "
        "the error of the loop's own linear light is stored",
    )
    share: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="share of a disturbance's cases that are traced, evenly spread from the first one on; "
        "what is traced is missing (NaN) of the others",
    )
    sensors: Literal["linear", "traced"] = Field(
        default="linear",
        description="light that sensors see in the loop; traced: anew in every frame of every case",
    )

    def traces(self, realization: int) -> bool:
        """Return whether a realization is traced: a share of any number of them, but for rounding."""
        before, now = (np.floor(self.share * k + _ROUNDING) for k in (realization - 1, realization))
        return bool(self.traced) and bool(now > before)


class TelescopeLoopStudy(SegmentStudy):
    """A validated study file of ``telescope-loop``: a case is run under every controller on the same draw."""

    sensor: tuple[Annotated[Sensor, AnyBlock(SENSORS)], ...] = Field(default=(), strict=False)
    actuator: tuple[Annotated[Actuator, AnyBlock(ACTUATORS)], ...] = Field(default=(), strict=False)
    controller: tuple[Annotated[Controller, AnyBlock(CONTROLLERS)], ...] = Field(min_length=1, strict=False)
    mode: tuple[CarryingMode, ...] = Field(default=(), strict=False)
    look: LookSection = LookSection()

    @field_validator("controller")
    @classmethod
    def _varied_values_are_controllers(cls, value: tuple[Controller, ...]) -> tuple[Controller, ...]:
        return tuple(one for each in value for one in each.varied())

    @model_validator(mode="after")
    def _blocks_fit_each_other(self) -> "TelescopeLoopStudy":
        for kind in ("sensor", "actuator", "controller", "mode"):
            names = [one.name for one in getattr(self, kind)]
            twice = next((name for name in names if names.count(name) > 1), None)
            if twice is not None:
                raise ValueError(f"two {kind}s are called {twice!r}; each needs a name of its own")
        most = self.wavefront.zernike_terms
        for each in self.actuator:
            if each.mirror_terms > most:
                raise ValueError(
                    f"actuator.{each.name}.terms is {each.mirror_terms}, more than wavefront.zernike_terms "
                    f"{most}, which cannot tell such deformations apart"
                )
        for controller in self.controller:
            self._parts_are_there(controller)
            self._rates_divide(controller)
        if self.wavefront.method != "opd" or self.wavefront.reference != "chief":
            raise ValueError("loops need wavefront.method = 'opd' and wavefront.reference = 'chief'")
        if self.store.keep or self.rare is not None:
            raise ValueError("store.keep and rare belong to segment-disturbance; leave them out")
        if self.object is not None and not self.look.traced:
            raise ValueError("[object] is imaged at traced instants; look.traced must be 1 or more")
        if self.look.traced > self.fewest_instants:
            raise ValueError(
                f"look.traced is {self.look.traced}, but there are cases of {self.fewest_instants} instants"
            )
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

    def _rates_divide(self, one: Controller) -> None:
        if not isinstance(one, Off | Perfect):
            runs = [(repr(entry.name), entry.duration_s) for entry in self.disturbance if entry.share]
            check_rates(one, self.part("sensor", one.sensor), runs)

    def part(self, kind: str, name: str) -> Any:
        """Return the sensor, actuator or controller of a name."""
        return next(one for one in getattr(self, kind) if one.name == name)

    def sensors(self, one: Controller) -> tuple[Sensor, ...]:
        """Return the sensors of a controller."""
        return tuple(self.part("sensor", name) for name in (one.sensor, *one.also_reads))

    def running(self, one: Controller) -> Sequence[Controller]:
        """Return the controllers that run together under the name of one."""
        return (one, *(self.part("controller", name) for name in one.beside))

    @property
    def stores_images(self) -> bool:
        """Whether images are computed of a case."""
        return bool(self.look.traced)

    @property
    def exposed(self) -> TelescopeExposureStudy:
        """The study of the same telescope's images, with a deformable M2 if an actuator is one."""
        sections = self.model_dump(include=set(SegmentStudy.model_fields) - {"rare"})
        sections["store"] = {}
        sections["study"]["workflow"] = "telescope-exposure"
        terms = max([one.mirror_terms for one in self.actuator], default=0)
        sections["exposure"] = {"scale": 1.0, "figure_terms": max(4, terms)}
        return TelescopeExposureStudy.model_validate(sections, strict=False)
