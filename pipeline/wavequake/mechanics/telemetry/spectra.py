"""Spectra of records: Fourier coefficients of a whole one, and averages over pieces with their confidence."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft
from scipy.signal.windows import hann, tukey
from scipy.stats import chi2

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_TAPERED = 0.1  # share of a record over which it is led in and out
_OVERLAP = 0.5
_BINS = 48  # per decade, of the robust background
_ABOUT = 9  # bins over which its median is taken


@dataclass(frozen=True)
class Fourier:
    """Fourier coefficients of a record, scaled so that mean squares are one-sided densities.

    Attributes
    ----------
    frequency : ndarray, shape (F,)
        Hz, above zero and below half the sampling frequency, 1 / duration apart.
    values : ndarray, shape (F, c)
        E |value|^2 is the one-sided PSD in unit^2/Hz.
    step : float
        s, of the record.
    duration : float
        s.
    loss : float
        By which the variance of estimates is larger than without taper.
    """

    frequency: Array
    values: Complex
    step: float
    duration: float
    loss: float


def fourier(values: Array, step: float) -> Fourier:
    """Return the coefficients of tapered signals (n, c), whose mean and slope are taken out.

    The first four are left out: slopes and the taper bend them.
    """
    count = len(values)
    taper = tukey(count, _TAPERED)
    taper /= np.sqrt(np.mean(taper**2))
    line = np.linspace(-1.0, 1.0, count)
    flat = values - values.mean(axis=0)
    flat -= np.outer(line, line @ flat / (line @ line))
    found = rfft(flat * taper[:, None], axis=0) * np.sqrt(2.0 * step / count)
    kept = slice(4, (count + 1) // 2)
    frequency = np.arange(len(found)) / (count * step)
    return Fourier(frequency[kept], found[kept], step, count * step, float(np.mean(taper**4)))


def background(spectrum: Fourier) -> Array:
    """Return a density (F, c) that single lines do not raise: medians over bins, and over their neighbors."""
    frequency, power = spectrum.frequency, np.abs(spectrum.values) ** 2
    width = 10.0 ** (1.0 / _BINS) - 1.0
    edges = [0]
    while edges[-1] < len(frequency):
        first = edges[-1]
        edges.append(min(len(frequency), first + max(8, round(width * frequency[first] * spectrum.duration))))
    if len(edges) > 2 and edges[-1] - edges[-2] < edges[-2] - edges[-3]:
        del edges[-2]  # what is left at the end is too little for a median
    starts = np.array(edges[:-1])
    middles = np.array([np.log(frequency[a:b]).mean() for a, b in pairwise(edges)])
    levels = np.array([np.median(power[a:b], axis=0) for a, b in pairwise(edges)]) / np.log(2.0)
    logarithms = np.log(np.maximum(levels, np.finfo(float).tiny))
    smooth = np.empty_like(logarithms)
    for k in range(len(starts)):  # windows shrink evenly towards the ends, where a slope would bend them
        reach = min(_ABOUT // 2, k, len(starts) - 1 - k)
        smooth[k] = np.median(logarithms[k - reach : k + reach + 1], axis=0)
    at = np.log(frequency)
    return np.asarray(np.exp(np.stack([np.interp(at, middles, column) for column in smooth.T], axis=1)))


@dataclass(frozen=True)
class Averaged:
    """Densities averaged over pieces of a record, after Welch.

    Attributes
    ----------
    frequency : ndarray, shape (F,)
        Hz.
    density : ndarray, shape (F, c)
        One-sided PSD, unit^2/Hz.
    freedom : float
        Equivalent degrees of freedom of each density.
    """

    frequency: Array
    density: Array
    freedom: float

    def interval(self, confidence: float = 0.95) -> tuple[Array, Array]:
        """Return lower and upper ends (F, c) of the densities' intervals (chi-squared)."""
        low, high = chi2.ppf([0.5 - confidence / 2.0, 0.5 + confidence / 2.0], self.freedom)
        return self.density * self.freedom / high, self.density * self.freedom / low


def welch(values: Array, step: float, length: int) -> Averaged:
    """Average the periodograms of half-overlapping pieces of `length` samples under Hann windows.

    Parameters
    ----------
    values : ndarray, shape (n, c)
    step : float
        s.
    length : int
        At most n.
    """
    window = hann(length, sym=False)
    shift = max(1, round(length * (1.0 - _OVERLAP)))
    starts = range(0, len(values) - length + 1, shift)
    total = np.zeros((length // 2 + 1, values.shape[1]))
    for start in starts:
        piece = values[start : start + length]
        total += np.abs(rfft((piece - piece.mean(axis=0)) * window[:, None], axis=0)) ** 2
    density = total * (2.0 * step / np.sum(window**2) / len(starts))
    kept = slice(2, (length + 1) // 2)
    frequency = np.arange(len(density)) / (length * step)
    return Averaged(frequency[kept], density[kept], freedom(window, shift, len(starts)))


def freedom(window: Array, shift: int, pieces: int) -> float:
    """Return the degrees of freedom of the mean of periodograms of overlapping pieces (Welch 1967)."""
    shared = [
        (window[lag * shift :] @ window[: len(window) - lag * shift] / (window @ window)) ** 2
        for lag in range(1, -(-len(window) // shift))
    ]
    spread = 1.0 + 2.0 * sum(
        (1.0 - lag / pieces) * one for lag, one in enumerate(shared, start=1) if lag < pieces
    )
    return float(2.0 * pieces / spread)
