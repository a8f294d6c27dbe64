"""The few directions of many signals in which lines are seen, and what lines do across them.

Of signals whose noise is independent and of one size, only those combinations say anything of frequencies and
damping in which lines are seen; across them noise is left, of which the series of the lines say how much of
them is in it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.mechanics.telemetry.whittle import Fit, oscillator

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

FEW = 8
"""Signals that are fitted as they are."""
_MOST = 8
_ABOVE = 1.2  # times the largest eigenvalue of noise
_APART = 0.3  # sine of the angle from which on directions are two


@dataclass(frozen=True)
class Subspace:
    """Signals (n, c) of unit noise along a few directions, and across them.

    Attributes
    ----------
    basis : ndarray, shape (c, k)
    rest : ndarray, shape (c, c - k)
    along : ndarray, shape (n, k)
    across : ndarray, shape (n, c - k)
    """

    basis: Array
    rest: Array
    along: Complex
    across: Complex


def subspace(white: Complex, parts: Sequence[NDArray[np.bool_]]) -> Subspace:
    """Return the directions of signals (n, c) that rise above unit noise in parts (n,) of a band."""
    channels = white.shape[1]
    if channels <= FEW:
        return Subspace(np.eye(channels), np.zeros((channels, 0)), white, white[:, :0])
    found = []
    for number, part in enumerate([*parts, np.ones(len(white), dtype=bool)]):
        few = white[part]
        values, vectors = np.linalg.eigh((few.T @ few.conj()).real / len(few))
        edge = _ABOVE * (1.0 + np.sqrt(channels / (2.0 * len(few)))) ** 2
        chosen = values > edge
        chosen[-1] |= number < len(parts)
        found.append(vectors[:, chosen])
    left, sizes, _ = np.linalg.svd(np.hstack(found), full_matrices=True)
    count = min(int(np.sum(sizes > _APART)), _MOST)
    basis, rest = left[:, :count], left[:, count:]
    return Subspace(basis, rest, white @ basis, white @ rest)


def across(
    seen: Subspace, frequency: Array, step: float, fit: Fit, color: Array, taper: float
) -> tuple[Array, Array]:
    """Return what lines do across the directions, (J, c - k), and the covariance of each (J, c - k, c - k).

    By regression on the expectation of each line's series by what is seen along them.

    Parameters
    ----------
    seen : Subspace
    frequency : ndarray, shape (n,)
    step : float
    fit : Fit
        Of the signals along the directions, solved by `color` (k, k).
    color : ndarray
    taper : float
        By which the taper increases variances.
    """
    lines = np.stack(
        [oscillator(frequency, float(np.exp(one[0])), float(np.exp(one[1])), step) for one in fit.logs],
        axis=1,
    )
    total = (lines[:, None] * fit.shapes.T) @ fit.shapes + np.diag(np.exp(fit.noise[0]))
    values = np.linalg.solve(color, seen.along.T).T
    series = lines * (np.linalg.solve(total, values[..., None])[..., 0] @ fit.shapes.T)
    gram = (series.conj().T @ series).real
    inverse = np.linalg.pinv(gram, hermitian=True)
    shapes = inverse @ (series.conj().T @ seen.across).real
    left = seen.across - series @ shapes
    noise = (left.T @ left.conj()).real / len(left)
    return shapes, 0.5 * taper * np.diag(inverse)[:, None, None] * noise
