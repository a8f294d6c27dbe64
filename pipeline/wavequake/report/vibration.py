"""Histories of one case and their spectra side by side: what moves, and at which frequencies."""

from collections.abc import Mapping

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray

from wavequake.drawing.periodogram import spectrum
from wavequake.drawing.style import COLORS, HEIGHT, LINES, STYLE, WIDTH

Array = NDArray[np.float64]

_NOTHING = 1e-24  # of the largest power: what rounding leaves


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
    figure = Figure(figsize=(2.0 * WIDTH, 0.75 * HEIGHT * len(series)), layout="constrained")
    for (left, right), (name, (unit, curves)) in zip(
        figure.subplots(len(series), 2, squeeze=False), series.items(), strict=True
    ):
        for number, (label, values) in enumerate(curves.items()):
            style = {
                "color": COLORS[number % len(COLORS)],
                "linestyle": LINES[number % len(LINES)],
                "lw": 1.2,
            }
            left.plot(time, values, label=label, **style)
            hertz, density = spectrum(time, values)
            seen = density > _NOTHING * max(float(np.max(values**2)), 1e-300)
            if seen.any():
                right.loglog(hertz[seen], np.sqrt(density[seen]), label=label, **style)
        left.set(xlabel="time (s)", ylabel=f"{name} ({unit})", title=f"{name} over time")
        right.set(
            xlabel="frequency (Hz)", ylabel=f"{unit} / √Hz", title=f"{name}: amplitude spectral density"
        )
        if len(curves) > 1:
            left.legend()
    return figure
