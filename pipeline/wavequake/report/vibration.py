"""Histories of one case and their spectra side by side: what moves, and at which frequencies."""

from collections.abc import Mapping

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wavequake.drawing.periodogram import spectrum
from wavequake.drawing.style import HEIGHT, STYLE, WIDTH, curve_style
from wavequake.drawing.ticks import in_inches, number_powers

Array = NDArray[np.float64]

_NOTHING = 1e-16  # of the largest power: what rounding and aiming leave
_STILL = 0.01  # of the largest value: what changes by less is drawn as still as it is


@rc_context(STYLE)
def histories_and_spectra(time: Array, series: Mapping[str, tuple[str, Mapping[str, Array]]]) -> Figure:
    """Draw quantities over time on the left and the spectra of their motion on the right.

    Parameters
    ----------
    time : ndarray, shape (T,)
        s.
    series : mapping of str to (str, mapping of str to ndarray of shape (T,))
        Name -> unit and curves by label.
    """
    high = 0.75 * HEIGHT
    figure = Figure(figsize=(2.0 * WIDTH, high * len(series)))
    for row, (name, (unit, curves)) in enumerate(series.items()):
        bottom = (len(series) - 1 - row) * high + 0.55
        left, right = (
            in_inches(figure, start + 0.8, bottom, WIDTH - 1.0, high - 1.05, label=0.6)
            for start in (0.0, WIDTH)
        )
        for number, (label, values) in enumerate(curves.items()):
            style = curve_style(number)
            left.plot(time, values, label=label, **style)
            hertz, density = spectrum(time, values)
            seen = density > _NOTHING * max(float(np.max(values**2)), 1e-300)
            if seen.any():
                right.loglog(hertz[seen], np.sqrt(density[seen]), label=label, **style)
        left.set(xlabel="time (s)", ylabel=f"{name} ({unit})")
        right.set(xlabel="frequency (Hz)", ylabel=f"{unit} / √Hz")
        for axes, title in ((left, f"{name} over time"), (right, f"{name}: amplitude spectral density")):
            axes.set_title(title, pad=14.0)  # above what numbers of an axis are to be multiplied by
        if len(curves) > 1:
            left.legend()
        most = _STILL * max((float(np.abs(values).max()) for values in curves.values()), default=0.0)
        left.set_ylim(_widened(left.get_ylim(), most))
        if right.get_xscale() == "log":
            first, last = map(float, np.log10(right.get_ylim()))
            first, last = _widened((first, last), 1.0)
            right.set_ylim(10.0**first, 10.0**last)
            for axis in (right.xaxis, right.yaxis):
                number_powers(axis)
    return figure


def _widened(limits: tuple[float, float], span: float) -> tuple[float, float]:
    """Return limits about the same middle that are so far apart or farther."""
    low, high = limits
    more = max(0.0, span - (high - low)) / 2.0
    return low - more, high + more
