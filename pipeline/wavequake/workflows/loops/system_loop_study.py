"""Study files of ``system-loop``: any optical system, what disturbs it, and loops."""

from pydantic import model_validator

from wavequake.chain.loops.blocks import LoopBlocks
from wavequake.chain.loops.sensors.displacement import OfBodies
from wavequake.workflows.systems.study import SystemStudy

_OTHERS = ("reduction", "allow", "budget")


class SystemLoopStudy(SystemStudy, LoopBlocks):
    """A validated study file of ``system-loop``."""

    @model_validator(mode="after")
    def _loops_fit_the_system(self) -> "SystemLoopStudy":
        for key in _OTHERS:
            if getattr(self, key) is not None:
                raise ValueError(f"the section {key} belongs to system-disturbance; leave it out")
        if self.optics.light != "traced":
            raise ValueError("loops trace what they leave; optics.light must be 'traced'")
        self.check_runs(self.disturbance, self.wavefront.method, self.wavefront.reference)
        for sensor in self.sensor:
            nodes = isinstance(sensor, OfBodies) and sensor.nodes and not (sensor.m2 or sensor.segments)
            if sensor.sees != "light" and not nodes:
                raise ValueError(
                    f"the sensor {sensor.name!r} reads segments or M2 of a telescope; loops of other "
                    "systems take sensors of light, as line-of-sight, wavefront, slopes and camera, and "
                    "displacement and accelerometer on nodes of bodies with mass (nodes)"
                )
        return self

    @property
    def disturbed(self) -> SystemStudy:
        """The same without loops."""
        sections = self.model_dump(include=set(SystemStudy.model_fields))
        sections["study"]["workflow"] = "system-disturbance"
        return SystemStudy.model_validate(sections, strict=False)
