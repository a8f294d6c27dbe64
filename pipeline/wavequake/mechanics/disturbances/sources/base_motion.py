"""Shaking from below: of the floor on which bodies stand, and of the cell on which elastic segments do."""

from functools import lru_cache
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.errors import UserError
from wavequake.mechanics.assembly.answers import Shaking, over_time, require_floor, steady
from wavequake.mechanics.assembly.plant import FLOOR, Plant
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.plant_source import (
    PlantSource,
    SpectrumKeys,
    bands_about,
    harmonics,
    spectrum_of,
)
from wavequake.mechanics.disturbances.source import Randoms, SegmentSource, register
from wavequake.mechanics.disturbances.sources.surface_vibration import VibrationLine
from wavequake.mechanics.disturbances.streams import Random

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_RIGID, _FIGURE = ("rigid", "segment"), ("figure", "segment")
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
        _require_shaking(self)
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


def _require_shaking(one: "BaseMotion | SegmentShaking") -> None:
    if not one.lines and one.spectrum is None:
        raise ValueError(f"{one.name!r} shakes nothing; give it lines or a spectrum")
    if len(set(one.axes)) < len(one.axes):
        raise ValueError(f"{one.name!r} names an axis twice")


@register
class SegmentShaking(SegmentSource):
    """Steady vibration of the cell below the segments, which move and deform as the section [segment] says.

    Sinusoids of random phase, or a spectrum. The cell moves as one, along the axes of the telescope as on the
    sky, z to the sky; or below every segment by itself, alike and independently along the segment's own axes.
    """

    stratified: ClassVar[bool] = False

    model: Literal["segment-shaking"] = "segment-shaking"
    cell: Literal["apart", "as one"] = Field(
        default="apart", description="whether it moves below every segment by itself, or as one"
    )
    lines: tuple[VibrationLine, ...] = Field(
        default=(),
        strict=False,
        description="frequency_hz and amplitude = { dx_um, ..., rz_urad }, about the center of each segment, "
        "or the origin of the telescope",
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
        _require_shaking(self)
        return self

    def draw(self, layout: SegmentLayout, time: Array, randoms: Randoms) -> Motion:
        """Draw one realization."""
        plant, random = self._plant(layout), randoms(self.name)
        count = len(layout) if self.cell == "apart" else 1
        phase = random.uniform(0.0, 2.0 * np.pi, (len(self.lines), count, 6))
        sizes = np.array([line.amplitude.si() for line in self.lines]).reshape(-1, 1, 6)
        omega = 2.0 * np.pi * np.array([line.frequency_hz for line in self.lines])
        moved = sizes * np.exp(1j * phase)
        if self.spectrum is not None:
            bands = bands_about(plant, spectrum_of(self.spectrum))
            noise, drawn = harmonics(bands, random, count * len(self.axes))
            drawn = drawn * ((1j * noise) ** -_DERIVATIVES[self.quantity])[:, None]
            shaken = np.zeros((len(noise), count, 6), dtype=np.complex128)
            shaken[..., ["xyz".index(axis) for axis in self.axes]] = drawn.reshape(len(noise), count, -1)
            omega, moved = np.concatenate([omega, noise]), np.concatenate([moved, shaken])
        local = moved if self.cell == "apart" else below(layout, moved[:, 0])
        values = answers(plant, omega, local, time)
        parts = plant.outputs
        motion = still(len(time), len(layout))
        motion.segment_motion[:] = values[..., parts[_RIGID]]
        return Motion(motion.segment_motion, values[..., parts[_FIGURE]], motion.mount, motion.m2)

    def figure_terms(self, layout: SegmentLayout) -> dict[str, int]:
        """Return how many coefficients the figures of segments have."""
        part = self._plant(layout).outputs[_FIGURE]
        return dict.fromkeys(layout.names, part.stop - part.start)

    def _plant(self, layout: SegmentLayout) -> Plant:
        if layout.segment is None:
            raise UserError(
                f"The disturbance {self.name!r} shakes elastic segments, of which this study says nothing; "
                "add the section [segment]."
            )
        return layout.segment


def below(layout: SegmentLayout, moved: Complex) -> Complex:
    """Return a motion (w, 6) of the whole cell as that below each segment, in its local axes, (w, S, 6)."""
    shift, turn = moved[:, None, :3], moved[:, None, 3:]
    there = shift + np.cross(turn, layout.centers_m)
    both = np.concatenate([there, np.broadcast_to(turn, there.shape)], axis=-1)
    split = both.reshape(len(moved), len(layout), 2, 3)
    return np.asarray(np.einsum("wsha,sab->wshb", split, layout.axes).reshape(both.shape))


def answers(plant: Plant, omega: Array, moved: Complex, time: Array) -> Array:
    """Return the outputs (n, S, m) of segments whose cell moves with amplitudes (w, S, 6)."""
    swing: Complex = moved @ _gains(plant, omega.tobytes())  # (w, S, m)
    flat = swing.reshape(len(omega), -1)
    phase = np.outer(time, omega)
    found = np.cos(phase) @ flat.real - np.sin(phase) @ flat.imag
    return np.asarray(found.reshape(len(time), *swing.shape[1:]))


@lru_cache(maxsize=2)
def _gains(plant: Plant, frequencies: bytes) -> Complex:
    """Return the outputs (w, 6, m) per unit motion of the cell along each axis: lines are those of all cases."""
    omega = np.frombuffer(frequencies)
    units = np.zeros((6, len(omega), 6), dtype=np.complex128)
    for axis in range(6):
        units[axis, :, axis] = 1.0
    return np.stack([steady(plant, Shaking(omega, unit)) for unit in units], axis=1)
