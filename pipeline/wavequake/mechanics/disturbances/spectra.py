"""One-sided power spectral densities, their exact variance by bands, and time series that have them.

A time series is a sum of harmonics, one per band, whose Gaussian cosine and sine amplitudes carry the band's
exact variance (spectral representation). Frequencies need not be multiples of 1 / duration: a slow spectrum
keeps its whole variance over realizations however short a case is; a short case shows an offset and a drift.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.streams import Random

Array = NDArray[np.float64]

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)
_CHUNK = 1 << 20
# Fewer instants are not worth a second way to sum them.
_MANY = 256


@dataclass(frozen=True)
class Spectrum:
    """A one-sided PSD in unit^2/Hz between two frequencies; zero elsewhere.

    ``breaks_hz`` are frequencies between which the density is smooth (knots of a table, flanks of a line).
    """

    density: Callable[[Array], Array]
    low_hz: float
    high_hz: float
    breaks_hz: tuple[float, ...] = ()


@dataclass(frozen=True)
class Bands:
    """Adjacent frequency bands of a spectrum.

    ``edges_hz`` (B + 1,), the variance of each band (B,), and the variance `below` each frequency of a fine
    grid (G,), counted from the lowest edge.
    """

    edges_hz: Array
    variances: Array
    grid_hz: Array
    below: Array


def scaled(spectrum: Spectrum, factor: float) -> Spectrum:
    """Return the spectrum times `factor` (a power, so the rms grows with its square root)."""
    density = spectrum.density
    return Spectrum(lambda f: factor * density(f), spectrum.low_hz, spectrum.high_hz, spectrum.breaks_hz)


def total(spectra: list[Spectrum]) -> Spectrum:
    """Return the sum of spectra."""

    def density(frequency: Array) -> Array:
        summed = np.zeros_like(frequency)
        for part in spectra:
            inside = (frequency >= part.low_hz) & (frequency <= part.high_hz)
            summed[inside] += part.density(frequency[inside])
        return summed

    ends = [end for part in spectra for end in (part.low_hz, part.high_hz)]
    breaks = sorted({*ends, *(knot for part in spectra for knot in part.breaks_hz)})
    return Spectrum(density, min(ends), max(ends), tuple(breaks))


def band_variance(spectrum: Spectrum, edges_hz: Array) -> Array:
    """Integrate a PSD over adjacent bands.

    Gauss-Legendre in log f between the edges, the spectrum's breaks and a grid of 1/32 octave: close to
    rounding where the density is smooth in between.

    Parameters
    ----------
    edges_hz : ndarray, shape (B + 1,)
        Increasing frequencies > 0.

    Returns
    -------
    ndarray, shape (B,), unit^2
    """
    low, high = edges_hz[0], edges_hz[-1]
    grid = np.geomspace(low, high, 2 + math.ceil(32 * math.log2(high / low)))
    fine = np.unique(
        np.concatenate([edges_hz, grid[1:-1], [f for f in spectrum.breaks_hz if low < f < high]])
    )
    middle, half = 0.5 * np.log(fine[1:] * fine[:-1]), 0.5 * np.log(fine[1:] / fine[:-1])
    frequency = np.exp(middle[:, None] + half[:, None] * _NODES)
    inside = (frequency >= spectrum.low_hz) & (frequency <= spectrum.high_hz)
    pieces = half * np.sum(np.where(inside, spectrum.density(frequency), 0.0) * frequency * _WEIGHTS, axis=1)
    summed: Array = np.add.reduceat(pieces, np.searchsorted(fine, edges_hz[:-1]))
    return summed


def variance(spectrum: Spectrum) -> float:
    """Return the variance over the whole spectrum, unit^2."""
    return float(band_variance(spectrum, np.array([spectrum.low_hz, spectrum.high_hz]))[0])


def banded(spectrum: Spectrum, edges_hz: Array) -> Bands:
    """Split a spectrum at given edges (B + 1,), increasing, in Hz."""
    low, high = edges_hz[0], edges_hz[-1]
    breaks = [f for f in spectrum.breaks_hz if low < f < high]
    grid = np.unique(np.concatenate([np.geomspace(low, high, 2049)[1:-1], edges_hz, breaks]))
    below = np.concatenate([[0.0], np.cumsum(band_variance(spectrum, grid))])
    return Bands(edges_hz, np.diff(below[np.searchsorted(grid, edges_hz)]), grid, below)


def split(spectrum: Spectrum, count: int = 128) -> Bands:
    """Split a spectrum into about `count` bands: half of them equal in log f, half of them equal in variance.

    The first half keeps slopes and weak tails, the second puts harmonics where the power is (narrow lines).
    """
    half = count // 2
    even = np.geomspace(spectrum.low_hz, spectrum.high_hz, half + 1)
    fine = banded(spectrum, even)
    quantiles = np.interp(np.linspace(0.0, fine.below[-1], half + 1)[1:-1], fine.below, fine.grid_hz)
    edges = np.unique(np.concatenate([even, quantiles]))
    # Edges closer than 1e-9 are one edge: a harmonic of no width has no variance to carry.
    return banded(spectrum, edges[np.concatenate([[True], np.diff(edges) > 1e-9 * edges[1:]])])


def frequencies(bands: Bands, random: Random) -> Array:
    """Draw one frequency in each band, (B,), distributed as the band's power."""
    first = bands.below[np.searchsorted(bands.grid_hz, bands.edges_hz[:-1])]
    level = first + bands.variances * random.random(len(bands.variances))
    drawn: Array = np.interp(level, bands.below, bands.grid_hz)
    return drawn


def synthesize(bands: Bands, time: Array, random: Random, channels: int = 1) -> Array:
    """Draw independent time series of a spectrum.

    Each band has one harmonic, at a frequency drawn from the band's power, with Gaussian cosine and sine
    amplitudes of the band's variance: at any instant the series is Gaussian with the spectrum's variance, and
    its expected spectrum is the PSD. The numbers drawn do not depend on `time`.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Instants in s, in any order and spacing.

    Returns
    -------
    ndarray, shape (n, channels)
    """
    count = len(bands.variances)
    frequency = frequencies(bands, random)
    amplitude = random.standard_normal((2, count, channels)) * np.sqrt(bands.variances)[:, None]
    step = _even_step(time)
    if step:
        return _evenly(time, step, frequency, amplitude)
    rows = max(1, _CHUNK // count)
    series = np.empty((len(time), channels))
    for first in range(0, len(time), rows):
        phase = 2 * np.pi * np.outer(time[first : first + rows], frequency)
        series[first : first + rows] = np.cos(phase) @ amplitude[0] + np.sin(phase) @ amplitude[1]
    return series


def _even_step(time: Array) -> float:
    """Return the distance of many instants that are evenly spaced but for rounding; 0 of all others."""
    if len(time) < _MANY:
        return 0.0
    even = np.linspace(time[0], time[-1], len(time))
    rounding = 4.0 * np.finfo(np.float64).eps * np.abs(time).max()
    return float(time[-1] - time[0]) / (len(time) - 1) if np.abs(time - even).max() <= rounding else 0.0


def _evenly(time: Array, step: float, frequency: Array, amplitude: Array) -> Array:
    """Sum harmonics at evenly spaced instants by few cosines: the phase of an instant is the sum of two."""
    short = math.isqrt(len(time) - 1) + 1
    starts = time[0] + np.arange(-(-len(time) // short)) * (short * step)
    coarse = np.exp(2j * np.pi * np.outer(starts, frequency))
    fine = np.exp(2j * np.pi * np.outer(frequency, np.arange(short) * step))
    waves = amplitude[0] - 1j * amplitude[1]  # whose real part turns from the cosine's to the sine's
    series = [((coarse * one) @ fine).real.ravel()[: len(time)] for one in waves.T]
    return np.asarray(np.stack(series, axis=1))


def windshake(amplitude: float, corner_hz: float, mode_hz: float, damping: float) -> Spectrum:
    """Return the PSD of telescope wind shake, A f^2 / [(1 + (f/f0)^2)^2 |1 + i xi f/f1 - (f/f1)^2|^2].

    The parametric form of the TMT wind shake used by public adaptive-optics simulators; 1 mHz to 1 kHz.
    """

    def density(f: Array) -> Array:
        mode = (1 - (f / mode_hz) ** 2) ** 2 + (damping * f / mode_hz) ** 2
        return amplitude * f**2 / ((1 + (f / corner_hz) ** 2) ** 2 * mode)

    return Spectrum(density, 1e-3, 1e3, (corner_hz, mode_hz))


def power_and_floor(slope: float, floor: float, low_hz: float, high_hz: float) -> Spectrum:
    """Return the PSD slope f^-4 + floor between two frequencies: vibration as AO simulators have it."""
    return Spectrum(lambda f: slope / f**4 + floor, low_hz, high_hz)


def resonance(center_hz: float, fwhm_hz: float, rms: float) -> Spectrum:
    """Return the PSD of an oscillator shaken by white noise: a line of given width and rms.

    S = rms^2 (2 D f0^2 / pi) / ((f0^2 - f^2)^2 + (D f)^2), whose integral from 0 to infinity is rms^2. D
    follows from the full width at half maximum w: D^2 = 2 f0^2 + w^2 - sqrt(4 f0^4 + 2 w^4). From f0 / 300 to
    300 f0, which holds all but about w / (400 f0) of the variance.
    """
    f0, w = center_hz, fwhm_hz
    width = math.sqrt(2 * f0**2 + w**2 - math.sqrt(4 * f0**4 + 2 * w**4))
    peak = rms**2 * 2 * width * f0**2 / math.pi
    flanks = sorted(f0 + side * w * 2.0**k for side in (-1, 1) for k in range(-3, 8))
    low, high = f0 / 300, 300 * f0
    return Spectrum(
        lambda f: peak / ((f0**2 - f**2) ** 2 + (width * f) ** 2),
        low,
        high,
        tuple(f for f in (*flanks, f0) if low < f < high),
    )


def von_karman(sigma: float, length_m: float, speed_m_s: float) -> Spectrum:
    """Return the PSD of longitudinal gusts, 4 sigma^2 (L/U) / (1 + 70.7 (f L/U)^2)^(5/6), in (m/s)^2/Hz.

    From 1e-3 to 1e4 U/L, which holds 99.5 % of the variance, 1.00057 sigma^2; the tail falls with f^(-5/3).
    """
    turn_s = length_m / speed_m_s
    return Spectrum(
        lambda f: 4 * sigma**2 * turn_s / (1 + 70.7 * (f * turn_s) ** 2) ** (5 / 6),
        1e-3 / turn_s,
        1e4 / turn_s,
    )


def tabulated(text: str, name: str) -> Spectrum:
    """Read a PSD from CSV text with the columns frequency_hz and psd (and perhaps a header).

    Raises
    ------
    UserError
        If a number is missing, not finite or negative, frequencies do not increase from above zero, or there
        are fewer than two rows; names the file and the line.
    """
    rows: list[tuple[float, float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#") and (rows or not _is_header(stripped)):
            rows.append(_row(stripped, f"{name}, line {number}", rows[-1][0] if rows else 0.0))
    if len(rows) < 2:
        raise UserError(f"{name} has {len(rows)} rows of frequency_hz,psd; a spectrum needs at least 2.")
    frequency, psd = np.array(rows).T
    if not psd.max() > np.finfo(float).tiny:
        raise UserError(f"{name} holds no power: every psd is zero.")
    return Spectrum(
        lambda f: np.interp(f, frequency, psd),
        float(frequency[0]),
        float(frequency[-1]),
        tuple(frequency.tolist()),
    )


def _is_header(text: str) -> bool:
    return text[0].isalpha() and not text.lower().startswith(("nan", "inf"))


def _row(text: str, where: str, previous: float) -> tuple[float, float]:
    cells = text.split(",")
    try:
        frequency, psd = (float(cell) for cell in cells)
    except ValueError:
        raise UserError(f"{where}: {text!r} is not two numbers, frequency_hz,psd.") from None
    if not (math.isfinite(frequency) and math.isfinite(psd)):
        raise UserError(f"{where}: {text!r} has a value that is not finite; leave such rows out.")
    if psd < 0:
        raise UserError(f"{where}: the psd {psd:g} is negative; a power spectral density is at least 0.")
    if frequency <= previous:
        bound = f"above the previous {previous:g} Hz" if previous else "above 0"
        raise UserError(
            f"{where}: the frequency {frequency:g} Hz is not {bound}; sort the rows by frequency."
        )
    return frequency, psd
