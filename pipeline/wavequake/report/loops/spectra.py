"""Spectra of what loops leave and of what noise does, and how their rms adds up from high frequencies."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import periodogram

from wavequake.report.figures import HEIGHT, STYLE, curve_style, stacked
from wavequake.report.loops.frequency import logarithmic
from wavequake.report.table import number

Array = NDArray[np.float64]
# Decades below the largest density that are drawn.
_DECADES = 12


@dataclass(frozen=True)
class Spectrum:
    """A one-sided spectrum of a motion.

    Attributes
    ----------
    label : str
    hertz : ndarray, shape (f,)
        Rising, above 0.
    density : ndarray, shape (f,)
        unit^2/Hz.
    above : ndarray, shape (f,)
        Rms of all from this frequency on upwards; the first is that of all.
    calm : bool
        Whether it is without a loop.
    """

    label: str
    hertz: Array
    density: Array
    above: Array
    calm: bool = False


def of_histories(label: str, step: float, values: Array, calm: bool = False) -> Spectrum:
    """Return the mean spectrum of histories (c, n, axes) at even steps, s, each about its mean.

    Densities are seen through a Hann window, so that what is slow does not leak over all frequencies. The
    rms is of the bare Fourier sum, and that of all is that of the histories to rounding (Parseval).
    """
    hertz, density = periodogram(values, 1 / step, "hann", axis=1)
    powers = periodogram(values, 1 / step, "boxcar", axis=1)[1].sum(axis=2).mean(axis=0) * hertz[1]
    above = np.sqrt(np.cumsum(powers[:0:-1])[::-1])
    return Spectrum(label, hertz[1:], density.sum(axis=2).mean(axis=0)[1:], above, calm)


def of_density(
    label: str, hertz: Array, density: Array, *, flat: bool = False, calm: bool = False
) -> Spectrum:
    """Return a spectrum of known densities (NaN: unknown), below the first frequency nothing or flat."""
    known = np.isfinite(density)
    hertz, density = hertz[known], density[known]
    powers = np.append(0.5 * (density[1:] + density[:-1]) * np.diff(hertz), 0.0)
    if flat:
        powers[0] += density[0] * hertz[0]
    return Spectrum(label, hertz, density, np.sqrt(np.cumsum(powers[::-1])[::-1]), calm)


@rc_context(STYLE)
def spectra(found: Sequence[Spectrum], what: str, unit: str) -> Figure:
    """Draw densities, and below them the rms from each frequency on upwards."""
    figure, (upper, lower) = stacked(height=1.25 * HEIGHT)
    shaped = iter(range(len(found)))
    for one in found:
        look = {"color": "#999999", "linewidth": 2.6} if one.calm else curve_style(next(shaped))
        upper.plot(one.hertz, one.density, **look)
        lower.plot(one.hertz, one.above, label=f"{one.label}: {number(one.above[0])} {unit} rms", **look)
    logarithmic(upper)
    logarithmic(lower, both=False)
    most = max(one.density.max() for one in found)
    upper.set_ylim(bottom=max(upper.get_ylim()[0], most / 10**_DECADES))
    lower.set_ylim(bottom=0.0)
    upper.set(ylabel=f"spectrum ({unit}²/Hz)", title=what)
    lower.set(ylabel=f"rms from here up ({unit})", xlabel="frequency (Hz)")
    lower.legend(fontsize=7.5, loc="upper right")  # where all curves fall
    return figure
