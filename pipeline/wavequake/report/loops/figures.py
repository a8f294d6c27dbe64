"""Figures of controller-mor: poles, margins over order, open-loop error against what becomes of the loop."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from wavequake.drawing.ticks import label_powers
from wavequake.report.figures import COLORS, HEIGHT, STYLE, one_panel, stacked
from wavequake.report.loops.outcomes import Level

_STABLE, _UNSTABLE, _GROUND = COLORS[0], COLORS[1], "#999999"
_MODES = 14
_POINTS, _LETTER, _LINE = 72.0, 4.1, 8.5  # per inch; of the names' letters


def _names(axes: Axes, points: Sequence[tuple[str, float, float]]) -> None:
    """Write names beside points, each where it covers no earlier one."""
    axes.margins(0.08, 0.12)
    axes.autoscale_view()
    taken: list[tuple[float, float, float]] = []
    for name, x, y in points:
        left, base = axes.transData.transform((x, y)) / axes.figure.dpi * _POINTS
        width = _LETTER * len(name)
        if all(
            abs(base - other) > _LINE or left > there + long or there > left + width
            for there, other, long in taken
        ):
            taken.append((left, base, width))
            axes.annotate(name, (x, y), (3, 3), textcoords="offset points", fontsize=7, color="#444444")


@rc_context(STYLE)
def error_and_outcome(level: Level) -> Figure:
    """Draw wavefront over open-loop error; unstable loops stand on a line of their own at the top."""
    figure, axes = one_panel()
    stable = [one for one in level.outcomes if one.stable]
    worst = max((one["wavefront"] for one in stable), default=1.0)
    least = min((one["wavefront"] for one in stable), default=0.9)
    top = worst + 0.35 * max(worst - least, 0.02 * worst)
    points = []
    for one in level.outcomes:
        y = one["wavefront"] if one.stable else top
        x = max(one["error_median"], 1e-9)
        axes.plot(x, y, "o" if one.stable else "X", color=_STABLE if one.stable else _UNSTABLE, markersize=6)
        points.append((one.variant, x, y))
    axes.axhline(top, color=_UNSTABLE, linewidth=0.7, linestyle=(0, (5, 2)))
    axes.set_xscale("log")
    label_powers(axes.xaxis)
    axes.set_xlabel("error of the open-loop transfer function in the band, median")
    axes.set_ylabel("wavefront in the loop (nm rms)")
    axes.set_title(f"effort {level.effort:g}: ● stable, ✖ unstable")
    _names(axes, points)
    return figure


@rc_context(STYLE)
def margins_over_order(level: Level, peak: float) -> Figure:
    """Draw sensitivity peak, gain and phase margin over order."""
    figure, panels = stacked(3, height=1.35 * HEIGHT)
    stable = [one for one in level.outcomes if one.stable]
    orders = [one.order for one in stable]
    for axes, name, label in zip(
        panels,
        ("sensitivity_peak", "gain_up", "phase_margin"),
        ("sensitivity peak", "gain margin (factor)", "phase margin (deg)"),
        strict=True,
    ):
        axes.plot(orders, [one[name] for one in stable], "o", color=_STABLE, markersize=4.5)
        for one in level.outcomes:
            if not one.stable:
                axes.plot(
                    one.order, 0.03, "X", color=_UNSTABLE, transform=axes.get_xaxis_transform(), markersize=6
                )
        axes.set_ylabel(label)
        _names(axes, [(one.variant, one.order, one[name]) for one in stable if np.isfinite(one[name])])
    panels[0].axhline(peak, color="#444444", linewidth=0.8, linestyle=(0, (5, 2)))
    panels[0].set_title(f"effort {level.effort:g}: ✖ at the bottom, unstable")
    panels[-1].set_xlabel("order (coordinates of the variant)")
    return figure


@rc_context(STYLE)
def poles(dataset: xr.Dataset, level: Level) -> Figure:
    """Draw the least damped poles of all loops: real part over frequency, those that grow marked."""
    figure, axes = one_panel()
    hertz, zeta = dataset["mode_hz"].to_numpy(), dataset["mode_zeta"].to_numpy()
    rows = [one.row for one in level.outcomes]
    real, high = (dataset[name].to_numpy()[rows] for name in ("pole_real", "pole_hz"))
    grows = real >= 0
    axes.plot(hertz, -2 * np.pi * hertz * zeta, "s", color=_GROUND, markersize=4, fillstyle="none", zorder=1)
    axes.plot(high[~grows], real[~grows], ".", color=_STABLE, markersize=4)
    axes.plot(high[grows], real[grows], "X", color=_UNSTABLE, markersize=6)
    axes.axhline(0.0, color="#444444", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_yscale("symlog", linthresh=0.1)
    label_powers(axes.xaxis)
    axes.set_xlabel("frequency of the pole (Hz)")
    axes.set_ylabel("real part (1/s)")
    growing = sorted((one for one in level.outcomes if not one.stable), key=lambda one: -one["growth"])
    _names(axes, [(one.variant, one["growth_hz"], one["growth"]) for one in growing])
    axes.set_title(f"effort {level.effort:g}: □ without a controller, · loops that decay, ✖ that grow")
    return figure


@rc_context(STYLE)
def shifts(dataset: xr.Dataset, level: Level) -> Figure:
    """Draw |dw/w| over the damping ratio of every low mode; models whose loop grows are marked."""
    figure, axes = one_panel()
    hertz, zeta = (dataset[name].to_numpy()[:_MODES] for name in ("mode_hz", "mode_zeta"))
    every = dataset["mode_shift"].to_numpy()
    places = np.arange(1, len(hertz) + 1)
    for one in level.outcomes:
        ratio = np.maximum(every[one.row, : len(hertz)] / zeta, 1e-9)
        side = -0.12 if one.stable else 0.12
        axes.plot(
            places + side, ratio, "o" if one.stable else "X", color=_STABLE if one.stable else _UNSTABLE,
            markersize=4, alpha=0.7,
        )  # fmt: skip
    axes.axhline(1.0, color="#444444", linewidth=0.8, linestyle=(0, (5, 2)))
    axes.set_yscale("log")
    label_powers(axes.yaxis)
    axes.set_xticks(places, [f"{one:.0f}" for one in hertz], fontsize=7)
    axes.set_xlabel("mode of the full model (Hz)")
    axes.set_ylabel("|Δω/ω| of the variant over the damping ratio ζ")
    axes.set_title(f"effort {level.effort:g}: ● its loop is stable, ✖ unstable")
    return figure


def drawable(levels: Sequence[Level]) -> list[Level]:
    """Return the efforts of which there is something to draw."""
    return [level for level in levels if level.outcomes]
