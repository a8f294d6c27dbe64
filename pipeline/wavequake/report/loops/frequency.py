"""Loops over frequency: Bode and Nyquist curves of the loop gain with margins, sensitivities."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from wavequake.drawing.ticks import label_powers
from wavequake.report.figures import COLORS, HEIGHT, STYLE, curve_style, one_panel, stacked

Array = NDArray[np.float64]
_GREY, _FLOOR, _REACH = "#444444", 1e-4, 2.5
# A phase that jumps by more is one that comes in again at the other side.
_JUMP = 180.0
# Between two frequencies a locus is an arc of such pieces; one that turns by more is not known in between.
_PIECE, _KNOWN = np.radians(4.0), np.radians(60.0)
NYQUIST = (
    "The nearer to the cross at -1, the nearer to instability. A curve has a gap where it turns by more than "
    "60 degrees between two frequencies that were computed. Marks on the real axis are gain margins, those "
    "on the unit circle phase margins."
)


@dataclass(frozen=True)
class Curve:
    """A loop over frequency.

    Attributes
    ----------
    label : str
    hertz : ndarray, shape (f,)
    gain : ndarray of complex, shape (f, m)
        Eigenvalues of the loop gain, which are the loop gain itself for one channel.
    sensitivity, complementary : ndarray, shape (f,)
        Largest singular values; NaN where the loop is unstable.
    gain_up, phase_deg : float
        Gain and phase margin; NaN for an unstable loop.
    """

    label: str
    hertz: Array
    gain: NDArray[np.complex128]
    sensitivity: Array
    complementary: Array
    gain_up: float
    phase_deg: float

    def critical(self) -> list[tuple[complex, float]]:
        """Return the points at which margins are measured, with the frequency of the nearest known one."""
        found = []
        if np.isfinite(self.gain_up):
            found.append(self._nearest(np.array([-1 / self.gain_up + 0j])))
        if np.isfinite(self.phase_deg) and self.phase_deg < 180:
            found.append(self._nearest(-np.exp(1j * np.radians(self.phase_deg) * np.array([1.0, -1.0]))))
        return found

    def _nearest(self, points: NDArray[np.complex128]) -> tuple[complex, float]:
        apart = np.abs(self.gain[..., None] - points)
        apart[np.isnan(apart)] = np.inf
        row, _, column = np.unravel_index(apart.argmin(), apart.shape)
        return complex(points[column]), float(self.hertz[row])


def logarithmic(axes: Axes, *, both: bool = True) -> None:
    """Give axes of frequency, and of size, powers of ten."""
    axes.set_xscale("log")
    if both:
        axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis) if both else (axes.xaxis,):
        label_powers(axis)


def show_rates(axes: Axes) -> None:
    """Give axes of rates and bandwidths, which are few, a logarithmic scale with plain numbers."""
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


@rc_context(STYLE)
def bode(curves: Sequence[Curve]) -> Figure:
    """Draw size and phase of loop gains; bars are gain and phase margins."""
    figure, (upper, lower) = stacked(height=1.25 * HEIGHT)
    for place, one in enumerate(curves):
        for column, values in enumerate(one.gain.T):
            # Down to -360 deg, so that -180 deg lies in the middle.
            phase = -(np.degrees(-np.angle(values)) % 360.0)
            turned = np.concatenate([[False], np.abs(np.diff(phase)) > _JUMP])
            upper.plot(
                one.hertz, np.abs(values), label=one.label if column == 0 else None, **curve_style(place)
            )
            lower.plot(one.hertz, np.where(turned, np.nan, phase), **curve_style(place))
        for point, hertz in one.critical():
            size, angle = abs(point), -(np.degrees(-np.angle(point)) % 360.0)
            upper.plot([hertz, hertz], [1.0, size], "-o", color=COLORS[place % len(COLORS)], markersize=3.5)
            lower.plot([hertz, hertz], [-180, angle], "-o", color=COLORS[place % len(COLORS)], markersize=3.5)
    logarithmic(upper)
    logarithmic(lower, both=False)
    upper.set_ylim(bottom=max(upper.get_ylim()[0], _FLOOR))
    upper.axhline(1.0, color=_GREY, linewidth=0.8)
    lower.axhline(-180.0, color=_GREY, linewidth=0.8)
    lower.set(ylim=(-365, 5), yticks=range(-360, 1, 90), xlabel="frequency (Hz)", ylabel="phase (deg)")
    bars = ", bars: gain and phase margins" if any(one.critical() for one in curves) else ""
    upper.set(ylabel="|loop gain|", title=f"Loop gain{bars}")
    upper.legend(fontsize=7.5)
    return figure


def arcs(locus: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return a locus (f,) as it is drawn: arcs about 0 between its points, NaN where it turns too far."""
    turns = np.angle(locus[1:] * locus[:-1].conj())
    pieces = np.maximum(np.ceil(np.abs(np.nan_to_num(turns)) / _PIECE), 1.0).astype(int)
    first = np.repeat(np.arange(len(turns)), pieces)
    share = (np.arange(len(first)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[first]
    size = np.abs(locus)
    drawn = (size[:-1][first] + share * np.diff(size)[first]) * np.exp(
        1j * (np.angle(locus)[first] + share * turns[first])
    )
    drawn[(np.abs(turns[first]) > _KNOWN) & (share > 0.0)] = np.nan
    return np.append(drawn, locus[-1:])


@rc_context(STYLE)
def nyquist(curves: Sequence[Curve]) -> Figure:
    """Draw loop gains in the complex plane about -1, with margins and the circle of the highest peak."""
    figure, axes = one_panel(height=1.25 * HEIGHT)
    axes.add_patch(Circle((0, 0), 1.0, facecolor="none", edgecolor="#999999", linewidth=0.8))
    for place, one in enumerate(curves):
        for column, values in enumerate(map(arcs, one.gain.T)):
            axes.plot(
                values.real, values.imag, label=one.label if column == 0 else None, **curve_style(place)
            )
        for point, _ in one.critical():
            axes.plot(point.real, point.imag, "o", color=COLORS[place % len(COLORS)], markersize=4.5)
    axes.plot(-1.0, 0.0, "+", color=_GREY, markersize=10)
    axes.axhline(0.0, color="#cccccc", linewidth=0.6, zorder=0)
    axes.axvline(0.0, color="#cccccc", linewidth=0.6, zorder=0)
    axes.set(xlim=(-_REACH, 1.5), ylim=(-2.0, 2.0), aspect="equal")
    axes.set(xlabel="real part", ylabel="imaginary part", title="Loop gain in the complex plane")
    axes.legend(fontsize=7.5)
    return figure


@rc_context(STYLE)
def sensitivities(curves: Sequence[Curve]) -> Figure:
    """Draw the sizes of sensitivity and complementary sensitivity."""
    figure, (upper, lower) = stacked(height=1.25 * HEIGHT)
    for place, one in enumerate(curves):
        upper.plot(one.hertz, one.sensitivity, label=one.label, **curve_style(place))
        lower.plot(one.hertz, one.complementary, **curve_style(place))
    for axes, label in ((upper, "sensitivity |S|"), (lower, "complementary |T|")):
        logarithmic(axes)
        axes.axhline(1.0, color=_GREY, linewidth=0.8)
        axes.set_ylim(bottom=max(axes.get_ylim()[0], _FLOOR))
        axes.set_ylabel(label)
    upper.set_title("What is left of a disturbance, and what comes of noise")
    upper.legend(fontsize=7.5)
    lower.set_xlabel("frequency (Hz)")
    return figure
