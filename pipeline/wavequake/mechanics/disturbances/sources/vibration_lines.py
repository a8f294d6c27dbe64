"""Narrow vibration lines in the line of sight: pumps, coolers, structural modes."""

from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS, Motion, line_of_sight_motion
from wavequake.mechanics.disturbances.source import Randoms, Source, register
from wavequake.mechanics.disturbances.spectra import Bands, resonance, split, synthesize, total
from wavequake.mechanics.disturbances.streams import Random
from wavequake.prepared import prepared

# Line frequencies in Hz along (tip) and across (tilt), from the spectra that the AO simulator TIPTOP ships.
# The unit of those files is not proven, so they give places of lines and nothing else.
_SETS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "vlt-eris": (
        (5.99, 8.01, 8.46, 8.9, 10.0, 11.2, 13.33, 15.99, 17.22, 24.22, 25.84, 45.5),
        (5.99, 8.46, 10.0, 10.39, 14.0, 15.99, 24.22, 45.22, 48.33, 49.31, 72.55, 96.74),
    ),
    "elt-windshake-8ms": ((2.75, 3.5, 5.25, 16.5, 17.5, 19.75), ()),
}


class Line(BaseModel):
    """One line: an oscillator shaken by white noise, narrow-band Gaussian."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    frequency_hz: float = Field(
        gt=0, le=1e5, description="resonance of the oscillator, the middle of the line"
    )
    fwhm_hz: float = Field(gt=0, description="full width at half maximum of the PSD")
    rms_mas: float = Field(gt=0, description="on the sky")
    across: bool = Field(
        default=False, description="perpendicular to the direction of motion instead of along it"
    )

    @model_validator(mode="after")
    def _is_a_line(self) -> Self:
        if self.fwhm_hz > self.frequency_hz:
            raise ValueError(
                f"a line at {self.frequency_hz:g} Hz cannot be {self.fwhm_hz:g} Hz wide; it is no line"
            )
        return self


# Measured on the Keck spectrum of the AO simulator MAOS.
_KECK = Line(frequency_hz=29.71, fwhm_hz=6.77, rms_mas=6.7)


@register
class VibrationLines(Source):
    """Independent vibration lines, listed one by one or as a named set.

    ``keck``: the 29.71 Hz line, 6.77 Hz wide, 6.7 mas rms (or `rms_mas`). ``vlt-eris`` and
    ``elt-windshake-8ms``: places of lines only, here of equal power and of the width `fwhm_hz`; `rms_mas`,
    per axis that has lines, is required.
    """

    sight: ClassVar = True

    model: Literal["vibration-lines"] = "vibration-lines"
    lines: tuple[Line, ...] = Field(default=(), strict=False, description="one by one, in place of a set")
    set: Literal["keck", "vlt-eris", "elt-windshake-8ms"] | None = Field(
        default=None, description="lines that are known by a name, in place of lines"
    )
    rms_mas: float | None = Field(default=None, gt=0, description="of a set, per axis on the sky")
    fwhm_hz: float = Field(
        default=0.2, gt=0, le=2.0, description="width of a set's lines where it gives none"
    )
    direction_deg: float = Field(
        default=0.0, ge=-360, le=360, description="of the motion on the sky, from x to y"
    )
    act: Literal["mount", "m2"] = Field(
        default="mount", description="what moves: the telescope, or M2 by tilting"
    )

    @model_validator(mode="after")
    def _lines_or_set(self) -> Self:
        if bool(self.lines) == (self.set is not None):
            raise ValueError("give either lines or the name of a set")
        if self.lines and self.rms_mas is not None:
            raise ValueError("every line has its own rms_mas; the common one belongs to a set")
        if self.set in _SETS and self.rms_mas is None:
            raise ValueError(
                f"the unit of {self.set} is not proven, so it gives the shape only; state its rms_mas"
            )
        return self

    def draw(self, layout: SegmentLayout, time: NDArray[np.float64], randoms: Randoms) -> Motion:
        """Draw one realization."""
        return draw_lines(self, len(layout), time, randoms(self.name))

    def analytic_rms(self, layout: SegmentLayout) -> tuple[float, Literal["mas", "nm"]]:
        """Return that of all lines."""
        return lines_rms_mas(self), "mas"

    def frequencies_hz(self) -> tuple[float, ...]:
        """Return those of the lines, listed or named."""
        return tuple(line.frequency_hz for line in lines_of(self))


def lines_of(parameters: VibrationLines) -> tuple[Line, ...]:
    """Return the lines one by one, whether they were listed or named."""
    if parameters.set is None:
        return parameters.lines
    if parameters.set == "keck":
        return (_KECK.model_copy(update={"rms_mas": parameters.rms_mas or _KECK.rms_mas}),)
    rms = parameters.rms_mas or 0.0
    return tuple(
        Line(
            frequency_hz=f, fwhm_hz=parameters.fwhm_hz, rms_mas=rms / np.sqrt(len(axis)), across=bool(across)
        )
        for across, axis in enumerate(_SETS[parameters.set])
        for f in axis
    )


def lines_rms_mas(parameters: VibrationLines) -> float:
    """Return the analytic rms of all lines together, radial on the sky, mas."""
    return float(np.sqrt(sum(line.rms_mas**2 for line in lines_of(parameters))))


@prepared(maxsize=64)
def _bands(parameters: VibrationLines, across: bool) -> Bands | None:
    chosen = [line for line in lines_of(parameters) if line.across == across]
    if not chosen:
        return None
    spectra = [resonance(line.frequency_hz, line.fwhm_hz, line.rms_mas * RAD_PER_MAS) for line in chosen]
    # Two dozen harmonics in each line and a few in its flanks.
    return split(total(spectra), 64 + 48 * len(chosen))


def draw_lines(
    parameters: VibrationLines, segments: int, time: NDArray[np.float64], random: Random
) -> Motion:
    """Draw the lines along and across the direction of motion."""
    series = []
    for across in (False, True):
        bands = _bands(parameters, across)
        series.append(np.zeros(len(time)) if bands is None else synthesize(bands, time, random)[:, 0])
    return line_of_sight_motion(parameters.act, series[0], series[1], parameters.direction_deg, segments)
