"""Vibration of surfaces, bodies and segments that are chosen by name."""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.rigid import RigidSizes
from wavequake.mechanics.disturbances.source import Names, Randoms, Source, register
from wavequake.mechanics.disturbances.streams import Random

Array = NDArray[np.float64]


class VibrationLine(BaseModel):
    """A sinusoid of fixed frequency and amplitude and of random phase."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    frequency_hz: float = Field(gt=0, le=1e6, description="of the sinusoid")
    amplitude: RigidSizes


@register
class SurfaceVibration(Source):
    """Vibration of surfaces and bodies: sinusoids whose phases are random and independent per motion."""

    independent: ClassVar = "element"

    model: Literal["surface-vibration"] = "surface-vibration"
    of: Names = Field(
        description="names of surfaces, bodies and segments, or patterns such as A*; each moves for itself"
    )
    lines: tuple[VibrationLine, ...] = Field(
        min_length=1,
        strict=False,
        description="frequency_hz and amplitude = { dx_um, ..., rz_urad }; a motion's rms is amplitude / "
        "sqrt(2)",
    )

    def draw(self, layout: SegmentLayout, time: Array, randoms: Randoms) -> Motion:
        """Draw the phases of each element."""
        moved = {
            name: _vibration(self, time, randoms(f"{self.name}/{name}")) for name in self.elements(layout)
        }
        return still(len(time), len(layout), rigid=moved)


def _vibration(part: SurfaceVibration, time: Array, random: Random) -> Array:
    """Return the sum of the lines; every phase is drawn whether its amplitude is zero or not."""
    phase = random.uniform(0.0, 2.0 * np.pi, (len(part.lines), 6))
    frequency = np.array([line.frequency_hz for line in part.lines])
    amplitude = np.array([line.amplitude.si() for line in part.lines])
    angle = 2.0 * np.pi * frequency[:, None] * time
    moved: Array = np.sum(amplitude[:, None] * np.sin(angle[..., None] + phase[:, None]), axis=0)
    return moved
