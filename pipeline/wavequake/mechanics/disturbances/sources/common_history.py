"""Pistons of random amplitude that all follow one history: what is separable in segment and time.

All that is linear in the motion is then needed once per case, not once per instant, and the random numbers
of many cases are drawn at once: made for campaigns of a million cases.
"""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.kernels.device.opencl import NUMPY, Device
from wavequake.kernels.random.normals import WORDS, normal_numbers, normal_quantiles
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, counted_generator, counted_key, still
from wavequake.mechanics.disturbances.population import time_axis
from wavequake.mechanics.disturbances.source import Randoms, SegmentSource, register
from wavequake.mechanics.disturbances.streams import Random


@register
class CommonHistory(SegmentSource):
    """Pistons (along the segments' normals) of independent amplitudes that all swing alike, from rest.

    The displacement of a segment is its amplitude times sin(2 pi frequency t), swung in within `ramp_s`. The
    random numbers of a realization are addressed by a counter, so that any run of cases is drawn at once.
    """

    independent: ClassVar = "element"

    model: Literal["common-history"] = "common-history"
    piston_nm: float = Field(default=20.0, ge=0, description="rms over segments and cases of the amplitude")
    piston_distribution: Literal["gaussian", "uniform"] = Field(
        default="gaussian", description="uniform: between -sqrt(3) and +sqrt(3) times piston_nm"
    )
    frequency_hz: float = Field(default=10.0, gt=0, le=1e5, description="of the common history")
    ramp_s: float = Field(default=0.02, ge=0, description="time in which the motion swings in")

    def frequencies_hz(self) -> tuple[float, ...]:
        """Return that of the common history."""
        return (self.frequency_hz,)

    def draw(self, layout: SegmentLayout, time: NDArray[np.float64], randoms: Randoms) -> Motion:
        """Draw one realization."""
        return draw_common(self, layout, time, randoms(self.name))

    def generator(self, stream: str, segments: int, seed: int, realization: int) -> np.random.Generator:
        """Return numbers that are addressed by a counter."""
        return amplitude_generator(self, segments, seed, realization)

    def analytic_rms(self, layout: SegmentLayout) -> tuple[float, Literal["mas", "nm"]]:
        """Return that of the pistons over the instants."""
        return self.piston_nm * float(np.sqrt(np.mean(history(self, time_axis(self)) ** 2))), "nm"


def history(parameters: CommonHistory, time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the common history (n,) at the instants `time` (n,) in s; its largest value is 1 at most."""
    swing = np.sin(0.5 * np.pi * np.minimum(time / max(parameters.ramp_s, 1e-12), 1.0)) ** 2
    return np.asarray(swing * np.sin(2.0 * np.pi * parameters.frequency_hz * time), dtype=np.float64)


def amplitudes(parameters: CommonHistory, segments: int, random: Random) -> NDArray[np.float64]:
    """Return the amplitudes (segments,), m, of one realization."""
    return _scaled(parameters, random.random(WORDS * _steps(segments)))[:segments]


def amplitudes_of_run(
    parameters: CommonHistory, segments: int, seed: int, first: int, cases: int, device: Device = NUMPY
) -> NDArray[np.float64]:
    """Return the amplitudes (cases, segments), m, of as many realizations one after the other.

    Each takes the same steps of a counter: the bits of a realization do not depend on how many are drawn.
    """
    steps = _steps(segments)
    if parameters.piston_distribution == "gaussian":
        key = counted_key(seed, parameters.name)
        unit = normal_numbers(key, first * steps, cases * steps, device)
        unit *= parameters.piston_nm * 1e-9
    else:
        random = amplitude_generator(parameters, segments, seed, first)
        unit = _scaled(parameters, random.random(WORDS * steps * cases))
    return unit.reshape(cases, -1)[:, :segments]


def _scaled(parameters: CommonHistory, uniform: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return amplitudes in m by numbers that are uniform between 0 and 1."""
    gaussian = parameters.piston_distribution == "gaussian"
    unit = normal_quantiles(uniform) if gaussian else np.sqrt(12.0) * (uniform - 0.5)
    return np.asarray(unit * (parameters.piston_nm * 1e-9), dtype=np.float64)


def amplitude_generator(
    parameters: CommonHistory, segments: int, seed: int, realization: int
) -> np.random.Generator:
    """Return the random numbers of `realization` and, after them, of those that follow."""
    return counted_generator(seed, parameters.name, realization * _steps(segments))


def _steps(segments: int) -> int:
    return -(-segments // WORDS)


def draw_common(
    parameters: CommonHistory, layout: SegmentLayout, time: NDArray[np.float64], random: Random
) -> Motion:
    """Draw one realization."""
    motion = still(len(time), len(layout))
    motion.segment_motion[..., 2] = np.outer(
        history(parameters, time), amplitudes(parameters, len(layout), random)
    )
    return motion
