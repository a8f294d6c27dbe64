"""Motion of the whole line of sight with a given spectrum: wind shake and vibration, by mount or by M2."""

from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS, Motion, line_of_sight_motion
from wavequake.mechanics.disturbances.source import Randoms, Source, register
from wavequake.mechanics.disturbances.spectra import (
    Bands,
    Spectrum,
    power_and_floor,
    scaled,
    split,
    synthesize,
    tabulated,
    variance,
    windshake,
)
from wavequake.mechanics.disturbances.streams import Random
from wavequake.prepared import prepared

# The TMT wind shake's PSD at the 75th percentile of the wind over that at the 50th.
_PERCENTILE_POWER = {50: 1.0, 75: 28 / 13}


@register
class LineOfSight(Source):
    """Line-of-sight motion along one direction on the sky.

    ``tmt-windshake``: A f^2 / [(1 + (f/f0)^2)^2 |1 + i xi f/f1 - (f/f1)^2|^2], along the wind; 18.96 mas
    rms at the 50th percentile, 27.83 mas at the 75th. ``tmt-vibration``: a f^-4 + b between 1 and 50 Hz,
    14.93 mas. The defaults of both were fitted to the spectra that the adaptive-optics simulator MAOS has
    for the TMT. ``file``: a CSV of frequency_hz,psd, whose unit has to be stated or else replaced by an
    rms.
    """

    sight: ClassVar = True

    model: Literal["line-of-sight"] = "line-of-sight"
    spectrum: Literal["tmt-windshake", "tmt-vibration", "file"] = Field(
        default="tmt-windshake", description="power spectral density of the motion: one of those above"
    )
    duration_s: float = Field(
        default=120.0, gt=0, le=1e5, description="minutes: half the wind shake is below 0.4 Hz"
    )
    rms_mas: float | None = Field(
        default=None, gt=0, description="scales the spectrum to this rms on the sky"
    )
    percentile: Literal[50, 75] = Field(default=50, description="of the wind, for tmt-windshake")
    direction_deg: float = Field(
        default=0.0, ge=-360, le=360, description="of the motion on the sky, from x to y"
    )
    act: Literal["mount", "m2"] = Field(
        default="mount", description="what moves: the telescope, or M2 by tilting"
    )
    file: str | None = Field(
        default=None, exclude=True, description="CSV of frequency_hz,psd (read when the study is loaded)"
    )
    file_csv: str | None = Field(default=None, description="the text of that file")
    file_unit: Literal["mas2/Hz", "rad2/Hz"] | None = Field(
        default=None, description="unit of the psd in the file"
    )
    windshake_amplitude_rad2_s3: float = Field(default=1.158e-11, gt=0, description="A of tmt-windshake")
    windshake_corner_hz: float = Field(default=0.08, gt=0, description="f0 of tmt-windshake")
    windshake_mode_hz: float = Field(default=0.65, gt=0, description="f1 of tmt-windshake, a structural mode")
    windshake_damping: float = Field(
        default=0.25, gt=0, description="xi of tmt-windshake, twice the damping ratio"
    )
    vibration_power_rad2_hz3: float = Field(default=1.56789e-14, ge=0, description="a of tmt-vibration")
    vibration_floor_rad2_hz: float = Field(default=3.07142e-19, gt=0, description="b of tmt-vibration")
    vibration_low_hz: float = Field(default=1.0, gt=0, description="lowest frequency of tmt-vibration")
    vibration_high_hz: float = Field(default=50.0, gt=0, description="highest frequency of tmt-vibration")

    @model_validator(mode="after")
    def _spectrum_is_complete(self) -> Self:
        if (self.spectrum == "file") != (self.file_csv is not None):
            need = "needs a file, a CSV of frequency_hz,psd" if self.file_csv is None else "takes no file"
            raise ValueError(f"the spectrum {self.spectrum!r} {need}")
        if self.spectrum == "file" and self.file_unit is None and self.rms_mas is None:
            raise ValueError("a spectrum file without a file_unit gives the shape only; state its rms_mas")
        if self.vibration_low_hz >= self.vibration_high_hz:
            raise ValueError("vibration_low_hz has to be below vibration_high_hz")
        try:
            sight_spectrum(self)
        except UserError as error:
            raise ValueError(str(error)) from None
        return self

    def frequencies_hz(self) -> tuple[float, ...]:
        """Return that of the structure's mode under wind shake; other spectra have no lines."""
        return (self.windshake_mode_hz,) if self.spectrum == "tmt-windshake" else ()

    def draw(self, layout: SegmentLayout, time: NDArray[np.float64], randoms: Randoms) -> Motion:
        """Draw one realization."""
        return draw_sight(self, len(layout), time, randoms(self.name))

    def analytic_rms(self, layout: SegmentLayout) -> tuple[float, Literal["mas", "nm"]]:
        """Return that of the spectrum."""
        return sight_rms_mas(self), "mas"


def sight_spectrum(parameters: LineOfSight) -> Spectrum:
    """Return the PSD of the motion along its direction, rad^2/Hz.

    Raises
    ------
    UserError
        If a file's spectrum is no spectrum.
    """
    p = parameters
    match p.spectrum:
        case "tmt-windshake":
            shape = windshake(
                p.windshake_amplitude_rad2_s3, p.windshake_corner_hz, p.windshake_mode_hz, p.windshake_damping
            )
            spectrum = scaled(shape, _PERCENTILE_POWER[p.percentile])
        case "tmt-vibration":
            spectrum = power_and_floor(
                p.vibration_power_rad2_hz3, p.vibration_floor_rad2_hz, p.vibration_low_hz, p.vibration_high_hz
            )
        case "file":
            unit = 1.0 if p.file_unit == "rad2/Hz" else RAD_PER_MAS**2
            spectrum = scaled(tabulated(p.file_csv or "", p.file or "the spectrum"), unit)
    if p.rms_mas is None:
        return spectrum
    return scaled(spectrum, (p.rms_mas * RAD_PER_MAS) ** 2 / variance(spectrum))


def sight_rms_mas(parameters: LineOfSight) -> float:
    """Return the spectrum's analytic rms on the sky, mas."""
    return float(np.sqrt(_bands(parameters).variances.sum())) / RAD_PER_MAS


@prepared(maxsize=64)
def _bands(parameters: LineOfSight) -> Bands:
    return split(sight_spectrum(parameters))


def draw_sight(parameters: LineOfSight, segments: int, time: NDArray[np.float64], random: Random) -> Motion:
    """Draw one time series along the direction of motion."""
    along = synthesize(_bands(parameters), time, random)[:, 0]
    return line_of_sight_motion(
        parameters.act, along, np.zeros_like(along), parameters.direction_deg, segments
    )
