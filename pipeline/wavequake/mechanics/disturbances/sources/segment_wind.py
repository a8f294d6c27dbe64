"""Wind on the segments of a primary mirror: gusts push each segment against its finite stiffness."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, Literal, Self

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.population import Positive
from wavequake.mechanics.disturbances.source import TOGETHER, Randoms, Source, register
from wavequake.mechanics.disturbances.spectra import (
    Bands,
    Spectrum,
    banded,
    frequencies,
    split,
    variance,
    von_karman,
)
from wavequake.mechanics.disturbances.streams import Random
from wavequake.prepared import prepared
from wavequake.tables import kept

Array = NDArray[np.float64]

# 12 factors of 492 x 492 are 23 MB: read once for all realizations that are drawn together.
_COHERENT_BANDS = 12
_INCOHERENT_BANDS = 20
_BLOCK = 128  # segments whose gusts are shaped at once
# Neighbors whose gusts are coherent to less than this are taken as independent.
_NO_COHERENCE = 1e-3


@register
class SegmentWind(Source):
    """Piston of every segment under gusts, along its normal.

    force = density x drag x area x mean speed x gust, the fluctuating part of the drag to first order in the
    gust; the mean force is left to the alignment of the telescope. Gusts have the von Karman spectrum and,
    between segments d apart, the coherence exp(-C f d / U). Stiffness and modes are those published for
    the TMT's segment support and position loop (10 N/um at low frequencies; 20 Hz bandwidth; structural
    modes 40, 90, 120 Hz). Wind speed, turbulence and drag inside the dome depend on the site and its vents,
    damping on the control: those defaults are plausible, not measured.
    """

    fits: ClassVar = ("segments",)
    stratified: ClassVar = False

    model: Literal["segment-wind"] = "segment-wind"
    duration_s: float = Field(default=60.0, gt=0, le=1e5, description="tens of seconds: gusts are slow")
    mean_speed_m_s: float = Field(default=1.0, gt=0, le=100, description="U, over the mirror")
    turbulence_intensity: float = Field(
        default=0.5, gt=0, le=2, description="rms of the gusts over the mean speed"
    )
    length_scale_m: float = Field(default=5.0, gt=0, description="L, integral scale of the turbulence")
    air_density_kg_m3: float = Field(default=0.79, gt=0, description="0.79 at 4050 m and 0 degrees Celsius")
    drag_coefficient: float = Field(default=1.0, gt=0, description="of a segment")
    coherence_decay: float = Field(default=10.0, gt=0, description="C of the coherence exp(-C f d / U)")
    area_filter: bool = Field(
        default=True,
        description="average gusts over a segment: 1 / (1 + (2 f sqrt(A) / U)^(4/3))^2 on their power",
    )
    stiffness_n_um: float = Field(default=10.0, gt=0, description="static force over piston")
    modes_hz: tuple[Positive, ...] = Field(
        default=(20.0, 40.0, 90.0, 120.0),
        min_length=1,
        strict=False,
        description="position loop and structure",
    )
    damping_ratios: tuple[Positive, ...] = Field(
        default=(0.5, 0.02, 0.02, 0.02),
        strict=False,
        description="of the modes; 0.5 for the closed position loop",
    )

    @model_validator(mode="after")
    def _every_mode_is_damped(self) -> Self:
        if len(self.modes_hz) != len(self.damping_ratios):
            raise ValueError(
                f"{len(self.modes_hz)} modes_hz need as many damping_ratios, not {len(self.damping_ratios)}"
            )
        return self

    def frequencies_hz(self) -> tuple[float, ...]:
        """Return those of the modes."""
        return self.modes_hz

    def draw(self, layout: SegmentLayout, time: Array, randoms: Randoms) -> Motion:
        """Draw one realization."""
        return self.draw_several([layout], time, [randoms], [0])[0]

    def draw_several(
        self,
        layouts: Sequence[SegmentLayout],
        time: Array,
        randoms: Sequence[Randoms],
        realizations: Sequence[int],
    ) -> list[Motion]:
        """Draw realizations whose gusts are shaped at once."""
        return draw_winds(self, layouts, time, [one(self.name) for one in randoms], realizations)

    def analytic_rms(self, layout: SegmentLayout) -> tuple[float, Literal["mas", "nm"]]:
        """Return that of the pistons."""
        return float(np.sqrt(np.mean(segment_wind_rms_nm(self, layout) ** 2))), "nm"


def compliance(
    parameters: SegmentWind, frequency_hz: Array, frequency: Array | float = 1.0, damping: Array | float = 1.0
) -> NDArray[np.complex128]:
    """Return piston over force, m/N: modes of equal modal mass whose static gains add up to 1 / stiffness.

    H(f) = 1/k sum_m w_m / (1 - (f/f_m)^2 + 2 i zeta_m f/f_m), w_m proportional to 1/f_m^2, sum w_m = 1.
    Factors on frequencies and damping ratios (..., M) keep the masses: stiffer modes give way less.
    """
    modes = np.array(parameters.modes_hz)
    weights = modes**-2 / np.sum(modes**-2) / np.square(frequency)
    ratio = np.asarray(frequency_hz)[..., None] / (modes * frequency)
    response = weights / (1 - ratio**2 + 2j * np.array(parameters.damping_ratios) * damping * ratio)
    total: NDArray[np.complex128] = response.sum(axis=-1) / (parameters.stiffness_n_um * 1e6)
    return total


def piston_spectrum(parameters: SegmentWind, mean_area_m2: float) -> Spectrum:
    """Return the PSD of piston per square of area, m^2/m^4/Hz; `mean_area_m2` enters the area filter."""
    p = parameters
    gusts = von_karman(p.turbulence_intensity * p.mean_speed_m_s, p.length_scale_m, p.mean_speed_m_s)
    pressure = p.air_density_kg_m3 * p.drag_coefficient * p.mean_speed_m_s
    width = math.sqrt(mean_area_m2) if p.area_filter else 0.0

    def density(f: Array) -> Array:
        averaged = 1 / (1 + (2 * f * width / p.mean_speed_m_s) ** (4 / 3)) ** 2
        return gusts.density(f) * averaged * (pressure * np.abs(compliance(p, f))) ** 2

    damping = np.array(p.damping_ratios)
    steps = (-8, -4, -2, -1, 0, 1, 2, 4, 8)
    flanks = np.concatenate([np.array(p.modes_hz) * (1 + step * damping) for step in steps])
    high = 3 * max(p.modes_hz)
    low = min(gusts.low_hz, min(p.modes_hz) / 10)
    return Spectrum(density, low, high, tuple(sorted(f for f in flanks.tolist() if low < f < high)))


def segment_wind_rms_nm(parameters: SegmentWind, layout: SegmentLayout) -> Array:
    """Return the analytic rms piston of every segment, nm, shape (S,)."""
    spectrum = piston_spectrum(parameters, float(layout.areas_m2.mean()))
    rms: Array = layout.areas_m2 * math.sqrt(variance(spectrum)) * 1e9
    return rms


def draw_winds(
    parameters: SegmentWind,
    layouts: Sequence[SegmentLayout],
    time: Array,
    randoms: Sequence[Random],
    realizations: Sequence[int],
) -> list[Motion]:
    """Draw time histories of all segments; the numbers drawn do not depend on `time`.

    A realization has a place of its own in products of a constant shape, so that its bits do not depend on
    what is drawn with it.
    """
    found = gusts_of(parameters, layouts[0])
    bands, count = len(found.factors), len(layouts[0])
    places = [realization % TOGETHER for realization in realizations]
    normals = np.zeros((bands, TOGETHER, 2, count))
    others = []
    for place, random in zip(places, randoms, strict=True):
        normals[:, place] = np.moveaxis(random.standard_normal((bands, count, 2)), 2, 1)
        apart = random.standard_normal((2, len(found.apart.variances), count))
        apart *= np.sqrt(found.apart.variances)[:, None]
        others.append((apart, frequencies(found.together, random), frequencies(found.apart, random)))
    shaped = np.empty_like(normals)
    for first in range(0, count, _BLOCK):  # nothing stands above the factors' diagonals
        last = min(first + _BLOCK, count)
        rows = np.swapaxes(found.factors[:, first:last, :last], 1, 2)
        shaped[..., first:last] = (normals[..., :last].reshape(bands, -1, last) @ rows).reshape(
            *normals.shape[:3], -1
        )
    together = np.moveaxis(shaped, 0, 2)
    return [
        _moved(parameters, layout, time, (slow, together[place]), (fast, apart))
        for layout, place, (apart, slow, fast) in zip(layouts, places, others, strict=True)
    ]


def _moved(
    parameters: SegmentWind,
    layout: SegmentLayout,
    time: Array,
    together: tuple[Array, Array],
    apart: tuple[Array, Array],
) -> Motion:
    """Return what gusts do to the segments: frequencies, and waves (cosine and sine, frequency, segment)."""
    waves = [together, apart]
    if layout.supports is not None:
        factors = layout.supports.factors(len(layout), len(parameters.modes_hz))
        waves = [(frequency, _through(parameters, frequency, one, factors)) for frequency, one in waves]
    motion = still(len(time), len(layout))
    piston = sum(_harmonics(time, frequency, one) for frequency, one in waves)
    motion.segment_motion[..., 2] = piston * layout.areas_m2
    return motion


def _through(parameters: SegmentWind, frequency: Array, waves: Array, factors: tuple[Array, Array]) -> Array:
    """Return the waves (cosine and sine, frequency, segment) of the same gusts on supports that are off."""
    off = compliance(parameters, frequency[:, None], *factors) / compliance(parameters, frequency)[:, None]
    changed = (waves[0] - 1j * waves[1]) * off
    return np.stack([changed.real, -changed.imag])


def _harmonics(time: Array, frequency: Array, waves: Array) -> Array:
    """Sum harmonics (cosine and sine, frequency, segment) at the instants: (n, S)."""
    phase = 2 * np.pi * np.outer(time, frequency)
    summed: Array = np.cos(phase) @ waves[0] + np.sin(phase) @ waves[1]
    return summed


@dataclass(frozen=True)
class Gusts:
    """Bands in which segments move together, each with a factor of their covariance, and the others.

    All is piston per area of a segment, m/m^2.
    """

    together: Bands
    factors: Array
    apart: Bands


@prepared(maxsize=3)
def gusts_of(parameters: SegmentWind, layout: SegmentLayout) -> Gusts:
    """Split wind into bands in which gusts are one size for all segments."""
    spectrum = piston_spectrum(parameters, float(layout.areas_m2.mean()))
    separation = np.linalg.norm(layout.centers_m[:, None] - layout.centers_m, axis=2)
    decay_s = parameters.coherence_decay * separation / parameters.mean_speed_m_s
    together = banded(spectrum, _coherent_edges(spectrum, decay_s))
    found = kept(_Factors, _factors, parameters, float(layout.areas_m2.mean()), decay_s, together.variances)
    rest = Spectrum(spectrum.density, float(together.edges_hz[-1]), spectrum.high_hz, spectrum.breaks_hz)
    return Gusts(together, found.factors, split(rest, _INCOHERENT_BANDS))


@dataclass(frozen=True)
class _Factors:
    factors: Array


def _factors(parameters: SegmentWind, mean_area_m2: float, decay_s: Array, variances: Array) -> _Factors:
    """Return a factor of the covariance of every band in which segments move together."""
    spectrum = piston_spectrum(parameters, mean_area_m2)
    edges = _coherent_edges(spectrum, decay_s)
    coherences = (_band_coherence(spectrum, decay_s, *band) for band in pairwise(edges))
    roots = [scipy.linalg.cholesky(one, lower=True) for one in coherences]
    return _Factors(np.sqrt(variances)[:, None, None] * roots)


def _coherent_edges(spectrum: Spectrum, decay_s: Array) -> Array:
    """Return band edges from the lowest frequency to where even neighbors are incoherent.

    The first band is all that the mirror feels as one; the others are equal in log f.
    """
    apart = decay_s[~np.eye(len(decay_s), dtype=bool)]
    if not len(apart):
        return np.array([spectrum.low_hz, spectrum.low_hz * 1.01])
    last = max(min(-math.log(_NO_COHERENCE) / apart.min(), 0.9 * spectrum.high_hz), 4 * spectrum.low_hz)
    first = min(max(0.1 / apart.max(), 1.01 * spectrum.low_hz), 0.5 * last)
    return np.concatenate([[spectrum.low_hz], np.geomspace(first, last, _COHERENT_BANDS)])


def _band_coherence(spectrum: Spectrum, decay_s: Array, low_hz: float, high_hz: float) -> Array:
    """Return the coherence exp(-f decay) of a band, averaged with its power: the covariance of its gusts.

    A mean of exponential kernels of distance, hence positive definite for distinct centers.
    """
    nodes, weights = np.polynomial.legendre.leggauss(6)
    f = np.sqrt(low_hz * high_hz) * (high_hz / low_hz) ** (nodes / 2)
    power = weights * f * spectrum.density(f)
    shares = power / power.sum()
    average = np.zeros_like(decay_s)
    for share, frequency in zip(shares, f, strict=True):
        average += share * np.exp(-frequency * decay_s)
    # Gusts that are the same everywhere make it singular: 1e-12 of independent power lets it be factored.
    average[np.diag_indices(len(average))] += 1e-12
    return average
