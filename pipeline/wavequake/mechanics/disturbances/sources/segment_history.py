"""Sinusoid-like motion of every segment along the telescope's axis, starting from rest."""

from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.source import Randoms, SegmentSource, register
from wavequake.mechanics.disturbances.streams import Random

_HARMONICS = 12
_GRID = 256


@register
class SegmentHistory(SegmentSource):
    """Motion in the global z direction of the kind of Störkle 2018, Fig. 4.38: +-70 nm within 100 ms.

    The text gives the amplitude, the duration and a plot only. Here the history of each segment is
    band-limited noise, harmonics between `low_hz` and `high_hz` with Gaussian amplitudes of its own, that
    starts with zero displacement and velocity and is fully swung in after `ramp_s`; all are scaled together
    so that the largest excursion of any segment within the duration is `peak_nm`.
    """

    model: Literal["segment-history"] = "segment-history"
    peak_nm: float = Field(default=70.0, ge=0, description="largest excursion of all segments and times")
    low_hz: float = Field(default=10.0, gt=0, le=1e5, description="lowest frequency")
    high_hz: float = Field(default=40.0, gt=0, le=1e5, description="highest frequency")
    ramp_s: float = Field(default=0.02, ge=0, description="time in which the motion swings in")

    @model_validator(mode="after")
    def _band_is_a_band(self) -> Self:
        if self.low_hz > self.high_hz:
            raise ValueError(f"low_hz {self.low_hz:g} is above high_hz {self.high_hz:g}")
        if self.high_hz * self.duration_s > _GRID / 16:
            most = f"{_GRID // 16} periods of high_hz"
            raise ValueError(f"{self.duration_s:g} s hold more than {most}; shorten it or lower high_hz")
        return self

    def draw(self, layout: SegmentLayout, time: NDArray[np.float64], randoms: Randoms) -> Motion:
        """Draw one realization."""
        return draw_history(self, layout, time, randoms(self.name))


def draw_history(
    parameters: SegmentHistory, layout: SegmentLayout, time: NDArray[np.float64], random: Random
) -> Motion:
    """Draw one history per segment along z to the sky, turned into the segment's local frame."""
    count = len(layout)
    edges = np.linspace(parameters.low_hz, parameters.high_hz, _HARMONICS + 1)
    frequency = random.uniform(edges[:-1], edges[1:])
    amplitude = random.standard_normal((2 * _HARMONICS, count))

    def basis(at: NDArray[np.float64]) -> NDArray[np.float64]:
        phase = 2 * np.pi * np.outer(at, frequency)
        swing = np.sin(0.5 * np.pi * np.minimum(at / max(parameters.ramp_s, 1e-12), 1.0)) ** 2
        harmonics: NDArray[np.float64] = np.hstack([np.cos(phase), np.sin(phase)]) * swing[:, None]
        return harmonics

    grid = parameters.duration_s * np.arange(1, _GRID + 1) / _GRID
    largest = np.abs(basis(grid) @ amplitude).max()
    z = basis(time) @ amplitude * (parameters.peak_nm * 1e-9 / largest)
    motion = still(len(time), count)
    # The local components of the global z direction are the third row of each segment's axes.
    motion.segment_motion[..., :3] = z[..., None] * layout.axes[:, 2, :]
    return motion
