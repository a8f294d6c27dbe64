"""Whether two sets of pieces of signals have the same spectra, band by band.

Both are seen in the same way: pieces of one length and step under one window. Where spectra are equal, the
ratio of band powers has Fisher's distribution with the degrees of freedom of both sides, which gives an
interval of the ratio of the true powers. Bands are as narrow as lines, octaves, and the whole: each of these
scales has a third of the false alarms, and each band of a scale and signal an equal part of that.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal.windows import hann
from scipy.stats import f as fisher

from wavequake.mechanics.telemetry.spectra import freedom

Array = NDArray[np.float64]

SCALES = ("line", "octave", "whole")
FEWEST = 32
"""Samples of a piece."""
_LINE = 0.015
_SCATTER = 8  # pieces from which on their scatter is known well enough
_FEWER = 0.6  # of the degrees of freedom of Gaussian noise: less is no chance
_NEIGHBORS = (1.0, 4.0 / 9.0, 1.0 / 36.0)  # squared correlation of coefficients under a Hann window


@dataclass(frozen=True)
class Pieces:
    """Averaged periodograms of pieces, and how many independent ones they are worth.

    Attributes
    ----------
    frequency : ndarray, shape (F,)
        Hz.
    density : ndarray, shape (F, c)
        unit^2/Hz.
    averages : float
    each : ndarray, shape (k, F, c)
        The density of each piece.
    """

    frequency: Array
    density: Array
    averages: float
    each: Array

    def freedom(self, band: slice, signal: int) -> float:
        """Return the degrees of freedom of the power in a band.

        Cases of a model are sums of few harmonics: where these are fewer than coefficients, bands scatter
        more from case to case than those of Gaussian noise do, and that counts.
        """
        theory = 2.0 * self.averages * _independent(self.density[band, signal])
        sums = self.each[:, band, signal].sum(axis=1)
        if len(sums) < _SCATTER or not sums.var() > 0.0:
            return theory
        seen = 2.0 * self.averages * float(sums.mean() ** 2 / sums.var(ddof=1))
        return seen if seen < _FEWER * theory else theory


@dataclass(frozen=True)
class Band:
    """What two sides have in a band of one signal.

    Attributes
    ----------
    scale : str
        One of `SCALES`.
    signal : int
    low_hz, high_hz : float
    model_rms, data_rms : float
    ratio, low, high : float
        Power of the data over that of the model, and its 95 % interval.
    agrees : bool
        Whether the ratio is one that equal spectra have, with all bands together at the stated rate.
    margin : float
        Probability of a ratio as far off, over that at which a band is said to disagree.
    """

    scale: str
    signal: int
    low_hz: float
    high_hz: float
    model_rms: float
    data_rms: float
    ratio: float
    low: float
    high: float
    agrees: bool
    margin: float


def independent_pieces(values: Array, step: float) -> Pieces:
    """Return the averages of independent pieces, values (k, n, c)."""
    return _averaged(values, step, float(len(values)))


def overlapping_pieces(values: Array, step: float, length: int, every: int = 1) -> Pieces:
    """Cut a record (n, c) into half-overlapping pieces of `length` samples, one in `every` of the record.

    `step` is that of the record, s.
    """
    span = length * every
    shift = max(1, span // 2)
    starts = range(0, len(values) - span + 1, shift)
    pieces = np.stack([values[start : start + span : every] for start in starts])
    averages = 0.5 * freedom(hann(length, sym=False), max(1, round(shift / every)), len(starts))
    return _averaged(pieces, step * every, averages)


def _averaged(pieces: Array, step: float, averages: float) -> Pieces:
    count = pieces.shape[1]
    window = hann(count, sym=False)
    kept = slice(2, (count + 1) // 2)  # the mean reaches into the first
    each = np.empty((len(pieces), (count + 1) // 2 - 2, pieces.shape[2]))
    for number, piece in enumerate(pieces):
        flat = piece - np.average(piece, axis=0, weights=window)
        each[number] = np.abs(np.fft.rfft(flat * window[:, None], axis=0)[kept]) ** 2
    each *= 2.0 * step / np.sum(window**2)
    frequency = np.arange(count // 2 + 1) / (count * step)
    return Pieces(frequency[kept], each.mean(axis=0), averages, each)


def agreement(model: Pieces, data: Pieces, doubt: float = 0.05) -> list[Band]:
    """Compare two sides of equal frequencies, band by band.

    Parameters
    ----------
    model, data : Pieces
    doubt : float
        Probability of any false alarm where both have the same spectra.
    """
    spacing = float(model.frequency[1] - model.frequency[0])
    found = []
    for scale in SCALES:
        bands = list(_bands(model.frequency, scale))
        each = 1.0 - (1.0 - doubt / len(SCALES)) ** (1.0 / (len(bands) * model.density.shape[1]))
        for signal in range(model.density.shape[1]):
            for part in bands:
                ours, theirs = model.density[part, signal], data.density[part, signal]
                freedoms = [side.freedom(part, signal) for side in (data, model)]
                mine, other = float(ours.sum()), float(theirs.sum())
                ratio = other / mine if mine > 0.0 else np.inf if other > 0.0 else 1.0
                tail = 2.0 * min(fisher.cdf(ratio, *freedoms), fisher.sf(ratio, *freedoms))
                low, high = (ratio / fisher.ppf(one, *freedoms) for one in (0.975, 0.025))
                edges = model.frequency[part][[0, -1]] + 0.5 * spacing * np.array([-1.0, 1.0])
                found.append(
                    Band(
                        scale, signal, float(edges[0]), float(edges[1]),
                        float(np.sqrt(mine * spacing)), float(np.sqrt(other * spacing)),
                        ratio, float(low), float(high), bool(tail >= each), float(tail / each),
                    )
                )  # fmt: skip
    return found


def _bands(frequency: Array, scale: str) -> Iterator[slice]:
    """Yield the bands of a scale: at least two coefficients each."""
    ratio = {"line": 1.0 + _LINE, "octave": 2.0, "whole": np.inf}[scale]
    first, count = 0, len(frequency)
    while first < count:
        after = int(np.searchsorted(frequency, frequency[first] * ratio)) if np.isfinite(ratio) else count
        after = max(after, first + 2)
        if count - after < 2:
            after = count
        yield slice(first, after)
        first = after


def _independent(density: Array) -> float:
    """Return how many independent coefficients of equal power a band's sum is worth."""
    total = float(density.sum()) ** 2
    if total == 0.0:
        return float(len(density))
    spread = sum(
        (1.0 if lag == 0 else 2.0) * square * float(density[lag:] @ density[: len(density) - lag])
        for lag, square in enumerate(_NEIGHBORS)
        if lag < len(density)
    )
    return total / spread
