"""Shaking of the floor on which bodies stand."""

from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.mechanics.assembly.answers import Shaking, over_time, require_floor
from wavequake.mechanics.assembly.plant import FLOOR, Plant
from wavequake.mechanics.disturbances.plant_source import (
    PlantSource,
    SpectrumKeys,
    bands_about,
    harmonics,
    spectrum_of,
)
from wavequake.mechanics.disturbances.source import register
from wavequake.mechanics.disturbances.sources.surface_vibration import VibrationLine
from wavequake.mechanics.disturbances.streams import Random

Array = NDArray[np.float64]

_DERIVATIVES = {"displacement": 0, "velocity": 1, "acceleration": 2}


@register
class BaseMotion(PlantSource):
    """Steady shaking of the floor: sinusoids of random phase, or random vibration with a spectrum."""

    model: Literal["base-motion"] = "base-motion"
    lines: tuple[VibrationLine, ...] = Field(
        default=(),
        strict=False,
        description="frequency_hz and amplitude = { dx_um, ..., rz_urad }, about the origin of the system",
    )
    spectrum: SpectrumKeys | None = Field(default=None, description="alike and independent along each axis")
    quantity: Literal["displacement", "velocity", "acceleration"] = Field(
        default="acceleration", description="whose the spectrum is, in m, m/s or m/s^2"
    )
    axes: tuple[Literal["x", "y", "z"], ...] = Field(
        default=("x", "y", "z"), min_length=1, strict=False, description="along which the spectrum shakes"
    )

    @model_validator(mode="after")
    def _shakes(self) -> Self:
        if not self.lines and self.spectrum is None:
            raise ValueError(f"{self.name!r} shakes nothing; give it lines or a spectrum")
        if len(set(self.axes)) < len(self.axes):
            raise ValueError(f"{self.name!r} names an axis twice")
        return self

    def answer(self, plant: Plant, time: Array, random: Random) -> Array:
        """Return the steady vibration under one realization of the floor's motion."""
        require_floor(plant, f"the disturbance {self.name!r}")
        found = over_time(plant, self._sinusoids(plant, random), time)
        return found if self.spectrum is None else found + over_time(plant, self._noise(plant, random), time)

    def _sinusoids(self, plant: Plant, random: Random) -> Shaking:
        phase = random.uniform(0.0, 2.0 * np.pi, (len(self.lines), 6))
        patterns = np.zeros((len(self.lines), plant.modal.inputs.shape[1]), dtype=np.complex128)
        sizes = np.array([line.amplitude.si() for line in self.lines]).reshape(-1, 6)
        patterns[:, FLOOR] = sizes * np.exp(1j * phase)
        return Shaking(2.0 * np.pi * np.array([line.frequency_hz for line in self.lines]), patterns)

    def _noise(self, plant: Plant, random: Random) -> Shaking:
        assert self.spectrum is not None
        omega, drawn = harmonics(bands_about(plant, spectrum_of(self.spectrum)), random, len(self.axes))
        patterns = np.zeros((len(omega), plant.modal.inputs.shape[1]), dtype=np.complex128)
        integrated = (1j * omega[:, None]) ** -_DERIVATIVES[self.quantity]
        patterns[:, ["xyz".index(axis) for axis in self.axes]] = drawn * integrated
        return Shaking(omega, patterns)
