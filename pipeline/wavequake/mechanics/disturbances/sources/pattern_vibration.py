"""Vibration of a whole pattern, such as a mode shape: elements and line of sight move in step."""

from dataclasses import replace
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.history_facts import ElementHistory, history_from, place_of
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.plant_source import SpectrumKeys, spectrum_of
from wavequake.mechanics.disturbances.source import Randoms, Source, register
from wavequake.mechanics.disturbances.spectra import Bands, Spectrum, resonance, split, synthesize, total
from wavequake.prepared import prepared

Array = NDArray[np.float64]


class PatternLine(BaseModel):
    """A line: an oscillator shaken by white noise, or a sinusoid of random phase."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    frequency_hz: float = Field(
        gt=0, le=1e6, description="resonance of the oscillator, or frequency of the sinusoid"
    )
    fwhm_hz: float = Field(default=0.0, ge=0, description="full width at half maximum; 0: a sinusoid")
    rms: float = Field(default=1.0, gt=0, description="of the pattern")

    @model_validator(mode="after")
    def _is_a_line(self) -> Self:
        if self.fwhm_hz > self.frequency_hz:
            raise ValueError(
                f"a line at {self.frequency_hz:g} Hz cannot be {self.fwhm_hz:g} Hz wide; it is no line"
            )
        return self


@register
class PatternVibration(Source):
    """One motion of several elements at once, times a random series: `wavequake identify` writes such ones.

    The series is Gaussian where it is no sinusoid, and the same for all parts of the pattern.
    """

    model: Literal["pattern-vibration"] = "pattern-vibration"
    pattern: dict[str, float] = Field(
        min_length=1,
        description="what moves by how much: ELEMENT.dx_um ... .rz_urad, SURFACE.zN_nm, line_of_sight.x_mas "
        'and .y_mas, as { "M2.dx_um" = 1.5, "line_of_sight.x_mas" = -0.2 }',
    )
    lines: tuple[PatternLine, ...] = Field(default=(), strict=False, description="independent lines")
    spectrum: SpectrumKeys | None = Field(default=None, description="of the series, per Hz")

    @field_validator("pattern")
    @classmethod
    def _names_what_moves(cls, value: dict[str, float]) -> dict[str, float]:
        try:
            _parts(tuple(value.items()))
        except UserError as error:
            raise ValueError(str(error)) from None
        return value

    @model_validator(mode="after")
    def _moves(self) -> Self:
        if not self.lines and self.spectrum is None:
            raise ValueError(f"{self.name!r} moves nothing; give it lines or a spectrum")
        return self

    def draw(self, layout: SegmentLayout, time: Array, randoms: Randoms) -> Motion:
        """Draw one realization."""
        self.elements(layout)
        series = self._series(time, randoms)
        pattern = _parts(tuple(self.pattern.items()))
        moved = still(
            len(time),
            len(layout),
            rigid={name: series[:, None] * values for name, values in pattern.rigid.items()},
            figure={name: series[:, None] * values for name, values in pattern.figure.items()},
        )
        return replace(moved, mount=series[:, None] * pattern.sight)

    def _series(self, time: Array, randoms: Randoms) -> Array:
        random, found = randoms(self.name), np.zeros(len(time))
        phase = random.uniform(0.0, 2.0 * np.pi, (len(self.lines),))
        for line, shift in zip(self.lines, phase, strict=True):
            if line.fwhm_hz == 0.0:
                found += np.sqrt(2.0) * line.rms * np.sin(2.0 * np.pi * line.frequency_hz * time + shift)
        bands = _bands(self.lines, self.spectrum)
        return found if bands is None else found + synthesize(bands, time, random)[:, 0]

    def elements(self, layout: SegmentLayout) -> tuple[str, ...]:
        """Return the elements in the pattern."""
        return layout.chosen(_parts(tuple(self.pattern.items())).names, self.name)

    def figure_terms(self, layout: SegmentLayout) -> dict[str, int]:
        """Return up to which Noll coefficient it deforms surfaces, by their names."""
        figure = _parts(tuple(self.pattern.items())).figure
        return {name: values.shape[1] for name, values in figure.items()}


def _parts(pattern: tuple[tuple[str, float], ...]) -> ElementHistory:
    """Return a pattern as a history of one instant, in SI units."""
    names, values = zip(*pattern, strict=True)
    places = [place_of(name) for name in names]
    return history_from(np.zeros(1), places, np.array([values]), {})


@prepared(maxsize=64)
def _bands(lines: tuple[PatternLine, ...], spectrum: SpectrumKeys | None) -> Bands | None:
    spectra: list[Spectrum] = [
        resonance(one.frequency_hz, one.fwhm_hz, one.rms) for one in lines if one.fwhm_hz > 0.0
    ]
    count = 64 + 48 * len(spectra) if spectra else 128
    if spectrum is not None:
        spectra.append(spectrum_of(spectrum))
    return split(total(spectra), count) if spectra else None
