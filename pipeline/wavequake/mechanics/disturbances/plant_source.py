"""What sources that act on elastic bodies have in common: from forces and floor motion to surfaces."""

from abc import abstractmethod
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from wavequake.errors import UserError
from wavequake.mechanics.assembly.answers import moved
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.source import Randoms, Source
from wavequake.mechanics.disturbances.spectra import (
    Bands,
    Spectrum,
    banded,
    frequencies,
    scaled,
    tabulated,
    variance,
)
from wavequake.mechanics.disturbances.streams import Random

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Edges of bands: even ones in log f, and so many half-widths of a resonance to either side of it.
_EVEN = 65
_FLANKS = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
_APART = 1e-6  # relative distance below which two edges are one


class PlantSource(Source):
    """A source that acts on the bodies of a study."""

    stratified: ClassVar[bool] = False

    @abstractmethod
    def answer(self, plant: Plant, time: Array, random: Random) -> Array:
        """Return the outputs (n, m) of the plant at the instants `time` (n,) in s, of one realization."""

    def draw(self, layout: SegmentLayout, time: Array, randoms: Randoms) -> Motion:
        """Draw one realization."""
        plant = self.plant(layout)
        rigid, figure = moved(plant, self.answer(plant, time, randoms(self.name)))
        return still(len(time), len(layout), rigid=rigid, figure=figure)

    def plant(self, layout: SegmentLayout) -> Plant:
        """Return what it acts on.

        Raises
        ------
        UserError
            If there are no bodies with mass.
        """
        if layout.plant is None:
            raise UserError(
                f"The disturbance {self.name!r} acts on bodies with mass, but this study has none; give a "
                "[[body]] a mirror, imported, rigid, beams, matrices or modes."
            )
        return layout.plant

    def place(self, plant: Plant, at: str, what: Literal["force", "moment"]) -> slice:
        """Return which inputs are the force or moment at ``body.node``.

        Raises
        ------
        UserError
            If there is no such node, or it takes no moments.
        """
        if at not in plant.places:
            names = [name for name in plant.places if "/" not in name]
            some = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
            raise UserError(
                f"The disturbance {self.name!r} acts at {at!r}, which is no node; there are {some}."
            )
        force, moment = plant.places[at]
        if what == "force":
            return force
        if moment is None:
            raise UserError(
                f"The disturbance {self.name!r} turns {at!r}, a node that has no rotation of its own; act on "
                "a rigid body or beams."
            )
        return moment

    def figure_terms(self, layout: SegmentLayout) -> dict[str, int]:
        """Return how many coefficients the bodies' figures have, by surface."""
        outputs = self.plant(layout).outputs
        return {name: part.stop - part.start for (kind, name), part in outputs.items() if kind == "figure"}


class SpectrumKeys(BaseModel):
    """A power spectral density: flat in a band, or from a file."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    rms: float | None = Field(
        default=None, gt=0, le=1e12, description="of the whole spectrum; a file may do without"
    )
    low_hz: float = Field(default=5.0, ge=1e-6, le=1e9, description="where a flat spectrum begins")
    high_hz: float = Field(default=200.0, ge=1e-6, le=1e9, description="where a flat spectrum ends")
    file: str | None = Field(
        default=None,
        exclude=True,
        description="CSV of frequency_hz,psd instead of a flat spectrum (read when the study is loaded)",
    )
    file_csv: str | None = Field(default=None, description="the text of that file")

    @model_validator(mode="after")
    def _is_complete(self) -> Self:
        if self.rms is None and self.file_csv is None:
            raise ValueError("a spectrum needs its rms, or a file")
        if self.low_hz >= self.high_hz:
            raise ValueError(f"low_hz {self.low_hz:g} has to be below high_hz {self.high_hz:g}")
        try:
            spectrum_of(self)
        except UserError as error:
            raise ValueError(str(error)) from None
        return self


def spectrum_of(keys: SpectrumKeys) -> Spectrum:
    """Return the power spectral density, per Hz."""
    if keys.file_csv is not None:
        shape = tabulated(keys.file_csv, keys.file or "file_csv")
    else:
        shape = Spectrum(np.ones_like, keys.low_hz, keys.high_hz)
    return shape if keys.rms is None else scaled(shape, keys.rms**2 / variance(shape))


def bands_about(plant: Plant, spectrum: Spectrum) -> Bands:
    """Split a spectrum into bands that are narrow about the resonances of a plant.

    There are 64 even in log f, and edges up to 16 half-widths to either side of each frequency.
    """
    low, high = spectrum.low_hz, spectrum.high_hz
    own = plant.resonances[0] / (2.0 * np.pi)
    flanks = np.outer(own * np.maximum(plant.resonances[1], 1e-6), _FLANKS)
    edges = np.concatenate(
        [np.geomspace(low, high, _EVEN), (own[:, None] + flanks).ravel(), (own[:, None] - flanks).ravel()]
    )
    edges = np.unique(edges[(edges >= low) & (edges <= high)])
    kept = np.concatenate([[True], np.diff(edges) > _APART * edges[1:]])
    return banded(spectrum, edges[kept])


def harmonics(bands: Bands, random: Random, channels: int) -> tuple[Array, Complex]:
    """Draw one harmonic in each band: angular frequencies (B,) and complex amplitudes (B, channels).

    A channel's real part of the sum of amplitude exp(i omega t) is Gaussian with the spectrum's variance.
    """
    omega = 2.0 * np.pi * frequencies(bands, random)
    drawn = random.standard_normal((2, len(omega), channels)) * np.sqrt(bands.variances)[:, None]
    return omega, drawn[0] - 1j * drawn[1]
