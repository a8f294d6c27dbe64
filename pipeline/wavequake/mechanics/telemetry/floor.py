"""What is left of a record beside its lines: densities of independent series, each with a direction."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from wavequake.mechanics.telemetry.line import Line
from wavequake.mechanics.telemetry.spectra import Fourier, background
from wavequake.mechanics.telemetry.whittle import oscillator

Array = NDArray[np.float64]

_PER_DECADE = 24
_FEWEST = 24  # coefficients in a band
_ROUNDS = 4
_UNSURE = 0.2  # of lines' flanks, which are no better known
_NONE = 1e-4  # of the density: lines that are as little are none
_COMMON = 0.3  # correlation from which on signals share a series


@dataclass(frozen=True)
class Floor:
    """Independent series, each times a direction in the space of the signals.

    Attributes
    ----------
    edges_hz : ndarray, shape (B + 1,)
        Of the bands.
    directions : ndarray, shape (k, c)
        What each series of unit density does to the signals, in their units.
    densities : ndarray, shape (k, B)
        One-sided PSD of each series, 1/Hz.
    """

    edges_hz: Array
    directions: Array
    densities: Array

    @property
    def middles_hz(self) -> Array:
        """Geometric middles (B,) of the bands."""
        return np.sqrt(self.edges_hz[1:] * self.edges_hz[:-1])


def bands_of(spectrum: Fourier, per_decade: int, fewest: int) -> NDArray[np.int64]:
    """Return where bands begin among the coefficients, and the end: even in log f, none too small."""
    starts, ratio = [0], 10.0 ** (1.0 / per_decade)
    count = len(spectrum.frequency)
    while count - starts[-1] >= 2 * fewest:
        first = starts[-1]
        after = int(np.searchsorted(spectrum.frequency, spectrum.frequency[first] * ratio))
        after = max(after, first + fewest)
        if count - after < fewest:
            break
        starts.append(after)
    return np.array([*starts, count])


def floor_of(spectrum: Fourier, lines: Sequence[Line]) -> Floor:
    """Return what is left of a record without sinusoids, beside its lines, along its principal axes.

    The covariance of the signals is kept, and so is the density along each principal axis; what axes share
    only at some frequencies is not.
    """
    channels = spectrum.values.shape[1]
    resolved = [line for line in lines if line.resolved]
    shapes = np.zeros((len(spectrum.frequency), len(resolved)))
    for j, line in enumerate(resolved):
        shapes[:, j] = oscillator(spectrum.frequency, line.frequency_hz, line.damping, spectrum.step)
    rms = np.array([line.rms for line in resolved]).reshape(-1, channels)
    starts = bands_of(spectrum, _PER_DECADE, _FEWEST)
    guess = shapes @ rms**2 + background(spectrum)
    filled = np.stack(
        [_rest(spectrum.values[a:b], shapes[a:b], rms, guess[a:b]) for a, b in pairwise(starts)]
    )
    edges = np.append(spectrum.frequency[starts[:-1]], spectrum.frequency[-1])
    covariance = np.einsum("b,bij->ij", np.diff(edges), filled)
    scale = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    # Signals that do not share a series at most frequencies have spectra of their own, which a turned axis
    # would mix up.
    own = np.sqrt(np.maximum(np.einsum("bii->bi", filled), np.finfo(float).tiny))
    common = np.median(filled / np.einsum("bi,bk->bik", own, own), axis=0)
    correlation = covariance / np.outer(scale, scale)
    shared = (np.abs(common) > _COMMON) | np.eye(channels, dtype=bool)
    _, vectors = np.linalg.eigh(np.where(shared, correlation, 0.0))
    along = vectors.T[::-1] / scale  # rows give series of the signals
    densities = np.maximum(np.einsum("ki,bij,kj->kb", along, filled, along), 0.0)
    return Floor(edges, vectors.T[::-1] * scale, densities)


def _rest(values: NDArray[np.complex128], shapes: Array, rms: Array, size: Array) -> Array:
    """Return the density (c, c) in a band beside lines (n, J) of `rms` (J, c), by weighted least squares.

    Coefficients weigh as they scatter, with the square of the whole density there, `size` (n, c) at first, so
    that those of a line say little. Where lines drown all else, nothing is left.
    """
    matter = [j for j, one in enumerate(rms) if (shapes[:, j, None] * one**2 > _NONE * size).any()]
    shapes, rms = shapes[:, matter], rms[matter]
    lines, before = shapes @ rms**2, np.inf
    parts = np.vstack([values.real, values.imag])
    for _ in range(_ROUNDS):
        weight = 1.0 / size  # of a pair of signals: the product of both
        weighted = parts * np.tile(weight, (2, 1))
        total = weighted.T @ weighted
        for shape, one in zip(shapes.T, rms, strict=True):
            total -= (weight.T @ (weight * shape[:, None])) * np.outer(one, one)
        found = total / (weight.T @ weight)
        own = np.maximum(np.diag(found), 1e-3 * lines.min(axis=0))
        if (np.abs(own - before) <= _NONE * own).all():
            break
        before = own
        size = lines + np.maximum(own, np.finfo(float).tiny)
    known = np.diag(found) > _UNSURE * np.sum(lines / size**2, axis=0) / np.sum(1.0 / size**2, axis=0)
    scale = np.sqrt(np.where(known, np.diag(found), 1.0))
    values_, vectors = np.linalg.eigh(np.where(np.outer(known, known), found / np.outer(scale, scale), 0.0))
    return np.asarray((vectors * np.maximum(values_, 0.0)) @ vectors.T * np.outer(scale, scale))
