"""The spectrum of a history that is drawn."""

import numpy as np
from numpy.typing import NDArray

from wavequake.mechanics.disturbances.folded import has_spectrum

__all__ = ["has_spectrum", "spectrum"]

Array = NDArray[np.float64]


def spectrum(time: Array, values: Array) -> tuple[Array, Array]:
    """Return the one-sided power spectral density of a history about its mean, without a window.

    Parameters
    ----------
    time : ndarray, shape (T,)
        s, evenly spaced.
    values : ndarray, shape (T,)

    Returns
    -------
    hertz, density : ndarray, shape (T // 2,)
        From the lowest frequency on; the density, in the square of the unit per Hz, times the step of
        frequencies sums to the variance (Parseval).
    """
    count, step = len(time), float(time[1] - time[0])
    found = np.abs(np.fft.rfft(values - values.mean()))[1:] ** 2 * (2.0 * step / count)
    if count % 2 == 0:
        found[-1] /= 2.0  # the highest frequency has no twin
    return np.asarray(np.fft.rfftfreq(count, step)[1:], dtype=np.float64), found
