"""A reaction wheel: forces and moments at harmonics of its speed, which grow with its square."""

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from wavequake.mechanics.assembly.answers import Shaking, over_time
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.plant_source import PlantSource
from wavequake.mechanics.disturbances.source import register
from wavequake.mechanics.disturbances.sources.body_force import Direction, unit
from wavequake.mechanics.disturbances.streams import Random

Array = NDArray[np.float64]
Speeds = Annotated[tuple[float, float], Field(strict=False)]

_KG_M, _KG_M2 = 1e-6, 1e-9


class WheelHarmonic(BaseModel):
    """What a wheel does at a multiple of its speed W: coefficient times W^2."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    number: float = Field(gt=0, le=1000, description="times the speed; 1: imbalance")
    radial_g_mm: float = Field(default=0.0, ge=0, description="force across the axis, turning with the wheel")
    axial_g_mm: float = Field(default=0.0, ge=0, description="force along the axis")
    rocking_g_mm2: float = Field(default=0.0, ge=0, description="moment about axes across, turning")


@register
class ReactionWheel(PlantSource):
    """Steady vibration by a wheel at a constant speed, another one in each case (Masterson et al., 2002).

    At each harmonic h the force is C W^2 cos(h W t + phase): of the first one, C is the static imbalance and
    the dynamic one, of the moment.
    """

    stratified = True

    model: Literal["reaction-wheel"] = "reaction-wheel"
    at: str = Field(description="node, as body.node, or a rigid body, at its center of mass")
    axis: Direction = Field(default=(0.0, 0.0, 1.0), description="of the wheel, in the axes of the system")
    speed_rpm: Speeds = Field(description="slowest and fastest; each case has one between them")
    harmonics: tuple[WheelHarmonic, ...] = Field(
        min_length=1,
        strict=False,
        description="number and radial_g_mm, axial_g_mm, rocking_g_mm2",
    )

    @model_validator(mode="after")
    def _turns(self) -> Self:
        unit(self.axis)
        if not 0.0 < self.speed_rpm[0] <= self.speed_rpm[1]:
            raise ValueError(f"speed_rpm is {list(self.speed_rpm)}; it must be above 0 and not fall")
        return self

    def frequencies_hz(self) -> tuple[float, ...]:
        """Return those of the harmonics of the fastest speed."""
        return tuple(one.number * self.speed_rpm[1] / 60.0 for one in self.harmonics)

    def answer(self, plant: Plant, time: Array, random: Random) -> Array:
        """Return the steady vibration at one speed."""
        share = float(random.random(1)[0])
        phase = np.exp(1j * random.uniform(0.0, 2.0 * np.pi, (len(self.harmonics), 3)))
        slow, fast = self.speed_rpm
        speed = (slow + share * (fast - slow)) * 2.0 * np.pi / 60.0
        return over_time(plant, wheel_shaking(self, plant, speed, phase), time)


def wheel_shaking(wheel: ReactionWheel, plant: Plant, speed: float, phase: NDArray[np.complex128]) -> Shaking:
    """Return what a wheel does at a speed in rad/s; `phase` (harmonics, 3) of force, thrust and moment."""
    axis = unit(wheel.axis)
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    turning = first - 1j * np.cross(axis, first)  # cos along the first axis, sin along the second
    patterns = np.zeros((len(wheel.harmonics), plant.modal.inputs.shape[1]), dtype=np.complex128)
    force = wheel.place(plant, wheel.at, "force")
    for row, one in enumerate(wheel.harmonics):
        patterns[row, force] = phase[row, 0] * one.radial_g_mm * _KG_M * turning
        patterns[row, force] += phase[row, 1] * one.axial_g_mm * _KG_M * axis
        if one.rocking_g_mm2:
            moment = wheel.place(plant, wheel.at, "moment")
            patterns[row, moment] = phase[row, 2] * one.rocking_g_mm2 * _KG_M2 * turning
    numbers = np.array([one.number for one in wheel.harmonics])
    return Shaking(speed * numbers, patterns * speed**2)
