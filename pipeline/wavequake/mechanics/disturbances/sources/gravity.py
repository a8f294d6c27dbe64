"""Quasi-static gravity while a telescope moves in elevation."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from wavequake.mechanics.assembly.answers import STANDARD_GRAVITY, require_floor, sag
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.plant_source import PlantSource
from wavequake.mechanics.disturbances.source import register
from wavequake.mechanics.disturbances.sources.body_force import Direction
from wavequake.mechanics.disturbances.streams import Random

Array = NDArray[np.float64]
Degrees = Annotated[float, Field(ge=-90, le=90)]
Elevations = Annotated[tuple[Degrees, Degrees], Field(strict=False)]


@register
class Gravity(PlantSource):
    """Sag of what stands on the floor, less that at the elevation at which all was aligned.

    Light enters along +z, so gravity is along +z at the zenith. The elevation goes evenly from the first one
    to the second in its own ``duration_s``, where it stays in a longer combination; nothing is random.
    """

    random: ClassVar[bool] = False

    model: Literal["gravity"] = "gravity"
    elevation_deg: Elevations = Field(default=(90.0, 20.0), description="of the first and the last instant")
    aligned_deg: Degrees = Field(default=90.0, description="elevation at which the optics are as designed")
    down: Direction = Field(
        default=(0.0, -1.0, 0.0), description="where gravity points at the horizon, across z, in the system"
    )

    @field_validator("down")
    @classmethod
    def _is_across(cls, value: Direction) -> Direction:
        if value[2] != 0.0 or not np.hypot(value[0], value[1]) > 0.0:
            raise ValueError("down has to be a direction across z, such as [0.0, -1.0, 0.0]")
        return value

    def answer(self, plant: Plant, time: Array, random: Random) -> Array:
        """Return the sag at the instants, relative to that when aligned."""
        require_floor(plant, f"the disturbance {self.name!r}")
        first, last = self.elevation_deg
        step = self.duration_s / self.instants
        span = max(self.duration_s - step, step)
        elevation = first + (last - first) * np.clip((time - step) / span, 0.0, 1.0)
        both = sag(plant, gravity_at(self, np.append(elevation, self.aligned_deg)))
        return np.asarray(both[:-1] - both[-1])


def gravity_at(parameters: Gravity, elevation_deg: Array) -> Array:
    """Return gravity (n, 3) in the axes of the system, m/s^2."""
    angle = np.deg2rad(elevation_deg)
    down = np.array(parameters.down) / np.linalg.norm(parameters.down)
    return STANDARD_GRAVITY * (np.outer(np.sin(angle), [0.0, 0.0, 1.0]) + np.outer(np.cos(angle), down))
