"""Forces at nodes of bodies: pumps, drives, wind on a part."""

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from wavequake.mechanics.assembly.answers import Shaking, over_time
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.plant_source import (
    PlantSource,
    SpectrumKeys,
    bands_about,
    harmonics,
    spectrum_of,
)
from wavequake.mechanics.disturbances.source import Names, register
from wavequake.mechanics.disturbances.streams import Random

Array = NDArray[np.float64]
Direction = Annotated[tuple[float, float, float], Field(strict=False)]


class ForceLine(BaseModel):
    """A sinusoidal force of fixed frequency and amplitude and of random phase."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    frequency_hz: float = Field(gt=0, le=1e6, description="of the sinusoid")
    force_n: float = Field(ge=0, description="amplitude of the sinusoid, in N")


def unit(direction: Direction) -> Array:
    """Return a direction of length 1; ValueError if it has none."""
    along = np.array(direction)
    if not np.linalg.norm(along) > 0.0:
        raise ValueError("a direction of length 0 points nowhere")
    return np.asarray(along / np.linalg.norm(along))


@register
class BodyForce(PlantSource):
    """Steady forces at nodes, independent of each other: sinusoids of random phase, or with a spectrum."""

    model: Literal["body-force"] = "body-force"
    at: Names = Field(description="nodes, as body.node, or rigid bodies at their centers of mass")
    direction: Direction = Field(default=(0.0, 0.0, 1.0), description="in the axes of the system")
    lines: tuple[ForceLine, ...] = Field(
        default=(), strict=False, description="frequency_hz and force_n at each node"
    )
    spectrum: SpectrumKeys | None = Field(default=None, description="of the force at each node, N")

    @model_validator(mode="after")
    def _acts(self) -> Self:
        unit(self.direction)
        if not self.lines and self.spectrum is None:
            raise ValueError(f"{self.name!r} is no force; give it lines or a spectrum")
        return self

    def answer(self, plant: Plant, time: Array, random: Random) -> Array:
        """Return the steady vibration under one realization of the forces."""
        columns = [self.place(plant, at, "force") for at in self.at]
        count, along = plant.modal.inputs.shape[1], unit(self.direction)
        onto = np.zeros((len(columns), count))
        for row, part in enumerate(columns):
            onto[row, part] = along
        phase = random.uniform(0.0, 2.0 * np.pi, (len(self.lines), len(columns)))
        sizes = np.array([line.force_n for line in self.lines]).reshape(-1, 1)
        omega = 2.0 * np.pi * np.array([line.frequency_hz for line in self.lines])
        found = over_time(plant, Shaking(omega, (sizes * np.exp(1j * phase)) @ onto), time)
        if self.spectrum is None:
            return found
        bands = bands_about(plant, spectrum_of(self.spectrum))
        omega, drawn = harmonics(bands, random, len(columns))
        return found + over_time(plant, Shaking(omega, drawn @ onto), time)
