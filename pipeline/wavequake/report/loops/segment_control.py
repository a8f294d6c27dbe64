"""The report of a segment-control store: how fast the loop may be, and what remains of the surface."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from rich.table import Table

from wavequake.campaign.contract import DONE
from wavequake.report.figures import COLORS, HEIGHT, STYLE, curve_style, one_panel, stacked
from wavequake.report.loops.frequency import logarithmic
from wavequake.report.loops.over_frequency import curves_of, loops_over_frequency, noise_picture, spectra_of
from wavequake.report.loops.spectra import of_density, spectra
from wavequake.report.page import Page, Picture, Section, picture
from wavequake.report.populations import left_out
from wavequake.report.table import MISSING, number, table_of_rows

_GREY: dict[str, Any] = {"color": "#444444", "linewidth": 0.8, "linestyle": (0, (5, 2))}
_PARTS = ("wind", "structure", "noise", "total")
_DEFINITIONS = (
    ("bandwidth", "Where the loop gain of an integrator is 1; modes of `control.slow` have less."),
    ("wind, structure, noise", "Surface rms over all segments that the loop leaves, without piston, tip and "
     "tilt of the whole mirror, which edge sensors do not see."),
    ("|S| max", "Largest amplification over frequency of any motion of the mirror."),
    ("limit", "Bandwidth from which on the loop is unstable."),
    ("multiplier", "Surface rms per rms of sensor noise through the inverse of the interaction matrix."),
)  # fmt: skip


@dataclass(frozen=True)
class Bandwidth:
    """A loop; surface in nm, NaN where it is unstable."""

    hertz: float
    wind: float
    structure: float
    noise: float
    total: float
    peak: float
    peak_hz: float
    growth: float
    growth_hz: float

    @property
    def stable(self) -> bool:
        """Whether all that moves decays."""
        return self.growth < 0


def bandwidths_of(dataset: xr.Dataset) -> list[Bandwidth]:
    """Return the loops of a store, the slowest first."""
    names = ("bandwidth", *_PARTS, "sensitivity_peak", "peak_hz", "growth", "growth_hz")
    return [
        Bandwidth(*map(float, row)) for row in zip(*(dataset[one].to_numpy() for one in names), strict=True)
    ]


def limits_of(dataset: xr.Dataset) -> np.ndarray:
    """Return the limits of the cases that drew errors; the first one has none."""
    done = (dataset["status"].to_numpy() == DONE) & (dataset["realization"].to_numpy() > 0)
    return np.asarray(dataset["limit_hz"].to_numpy()[done])


def answer(dataset: xr.Dataset) -> str:
    """Say how fast the loop may be, what remains, and what errors of the interaction matrix take of that."""
    loops = bandwidths_of(dataset)
    accepted = json.loads(dataset.attrs["study"])["criterion"]["peak"]
    limit, rigid = (float(dataset[one]) for one in ("nominal_limit", "rigid_limit"))
    shaken = float(np.hypot(dataset["open_wind"], dataset["open_structure"]))
    good = [one for one in loops if one.stable and one.peak <= accepted]
    if good:
        fastest, best = good[-1], min(good, key=lambda one: one.total)
        words = (
            f"The loop may have {number(fastest.hertz)} Hz: the fastest of the bandwidths with |S| up to "
            f"{number(accepted)} ({number(fastest.peak)} at {number(fastest.peak_hz)} Hz). "
            f"Of {number(shaken)} nm of surface the least, {number(best.total)} nm, remains at "
            f"{number(best.hertz)} Hz: {number(best.wind)} of wind, {number(best.structure)} of the "
            f"structure and {number(best.noise)} of sensor noise."
        )
    else:
        words = f"No bandwidth keeps |S| up to {number(accepted)}."
    words += f" It is unstable from {_limit(limit)} on" + (
        f" ({_limit(rigid)} on a structure that does not move)." if limit < rigid else "."
    )
    found = limits_of(dataset)
    if len(found):
        draws = "1 draw" if len(found) == 1 else f"{len(found)} draws"
        words += f" With {draws} of errors of the interaction matrix the limit is {_range(found)}."
    return words


def _limit(hertz: float) -> str:
    return f"{number(hertz)} Hz" if np.isfinite(hertz) else "no bandwidth"


def _range(found: np.ndarray) -> str:
    low, high = float(found.min()), float(found.max())
    if low == 0.0:
        return f"gone in {int((found == 0).sum())} of them: a mode has lost its sign"
    return _limit(low) if low == high else f"{_limit(low)} to {_limit(high)}"


def row_of(one: Bandwidth) -> dict[str, tuple[str, str]]:
    """Return header -> (value, small print) of a loop."""
    parts = {f"{key} (nm)": (number(getattr(one, key)) if one.stable else MISSING, "") for key in _PARTS}
    return {
        "bandwidth (Hz)": (f"{one.hertz:g}", ""),
        **parts,
        "|S| max": (number(one.peak), f"at {number(one.peak_hz)} Hz") if one.stable else (MISSING, ""),
        "unstable": ("", "")
        if one.stable
        else (f"{number(one.growth)} 1/s", f"at {number(one.growth_hz)} Hz"),
    }


def rows_of(loops: Sequence[Bandwidth]) -> list[dict[str, tuple[str, str]]]:
    """Return the rows of loops; how one grows is said where one does."""
    rows = [row_of(one) for one in loops]
    empty = {"unstable"} if all(one.stable for one in loops) else set()
    return [{name: cell for name, cell in row.items() if name not in empty} for row in rows]


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    return table_of_rows(rows_of(bandwidths_of(dataset)), answer(dataset), 0, " {}")


def page_of(store: Path, dataset: xr.Dataset, device: str) -> Page:
    """Return the HTML report."""
    dataset = dataset.load()
    loops = bandwidths_of(dataset)
    focus, others = float(dataset["multiplier"][0]), float(dataset["multiplier_rest"])
    return Page(
        answer=answer(dataset),
        table=rows_of(loops),
        small_print="Surface rms over all segments; the wavefront is twice as large.",
        overview=_overview(dataset, loops),
        sections=[
            *_over_frequency(dataset, loops),
            Section(
                "The mirror",
                [
                    picture(
                        "singular",
                        "Modes by how well the sensors see them",
                        _modes(dataset),
                        f"The least seen mode alone multiplies sensor noise by {number(focus)}, all others "
                        f"together by {number(others)}.",
                    )
                ],
            ),
            Section(
                "Errors of the interaction matrix",
                [
                    picture(
                        "errors",
                        "Limit of the bandwidth over the gain of the least seen mode",
                        _errors(dataset),
                        "Each mark is a draw of errors, the square the mirror without any. Lines lead from "
                        "the smallest to the largest gain of all modes.",
                    )
                ],
            ),
        ],
        definitions=list(_DEFINITIONS),
        kind="case",
        left_out=left_out(dataset, ["realization"]),
    )


@rc_context(STYLE)
def _remains(dataset: xr.Dataset, loops: Sequence[Bandwidth]) -> Figure:
    figure, axes = one_panel()
    hertz = [one.hertz for one in loops]
    for place, key in enumerate(_PARTS):
        wide: dict[str, Any] = (
            {"linewidth": 2.4, "color": "#222222"} if key == "total" else curve_style(place)
        )
        axes.plot(hertz, [getattr(one, key) for one in loops], marker="o", markersize=3, label=key, **wide)
    for place, key in enumerate(("open_wind", "open_structure")):
        axes.axhline(float(dataset[key]), color=COLORS[place], linestyle=":", linewidth=1.2)
    logarithmic(axes)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set(xlabel="bandwidth (Hz)", ylabel="surface (nm rms)", title="What remains")
    axes.legend()
    return figure


@rc_context(STYLE)
def _peaks(dataset: xr.Dataset) -> Figure:
    figure, axes = one_panel()
    hertz, peaks = dataset["bandwidth"].to_numpy(), dataset["peak_by_mode"].to_numpy()
    for place, name in enumerate(map(str, dataset["structure_mode"].to_numpy())):
        axes.plot(hertz, peaks[:, place], marker="o", markersize=3, label=name, **curve_style(place))
    axes.axhline(json.loads(dataset.attrs["study"])["criterion"]["peak"], **_GREY)
    if np.isfinite(limit := float(dataset["nominal_limit"])) and limit > 0:
        axes.axvline(limit, **_GREY)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set(xlabel="bandwidth (Hz)", ylabel="largest |S|", title="Control and structure")
    axes.legend(fontsize=7)
    return figure


def _overview(dataset: xr.Dataset, loops: Sequence[Bandwidth]) -> list[Picture]:
    """Return what remains and peaks over the bandwidth; of unstable loops nothing is known."""
    if not any(one.stable for one in loops):
        return []
    return [
        picture(
            "remains",
            "What remains over the bandwidth",
            _remains(dataset, loops),
            "Dotted: wind and the structure's motion without a loop.",
        ),
        picture(
            "peaks",
            "Peak of the sensitivity by mode of the structure",
            _peaks(dataset),
            "Along the shape of each mode of the structure. Broken lines are what is accepted (across) "
            "and the bandwidth from which on the nominal loop is unstable (upright).",
        ),
    ]


def _over_frequency(dataset: xr.Dataset, loops: Sequence[Bandwidth]) -> list[Section]:
    """Return the section of what is known over frequency; unstable loops have no sensitivity."""
    if not any(one.stable for one in loops) or "loop_gain" not in dataset:  # 0.3 kept sensitivities alone
        return []
    rows = [(f"{one.hertz:g} Hz", dataset.isel(bandwidth=k)) for k, one in enumerate(loops) if one.stable]
    hertz, density = dataset["frequency"].to_numpy(), dataset["open_psd"].to_numpy()
    calm = of_density("without a loop", hertz, density, calm=True)
    left = [calm, *spectra_of(rows, "left_psd", flat=False)]
    shown = [
        *loops_over_frequency(
            "",
            curves_of(rows),
            "Of each bandwidth the eigenvalues of the loop gain that have the gain and the phase margin.",
            "Largest singular values: |S| is what is left of a motion of the mirror, |T| what comes of the "
            "sensors' noise. Above 1 a loop amplifies.",
        ),
        picture(
            "spectrum",
            "Spectrum of the surface, and how its rms adds up",
            spectra(left, "What is left of wind and structure", "nm"),
            "Integrals over frequency, exact but for the steps between the frequencies that are drawn; the "
            "thick line is the surface without a loop. Below is the rms of all that is faster than a "
            "frequency, up to half the rate of frames. The sensors' noise is not in it.",
        ),
    ]
    if noise := spectra_of(rows, "noise_psd"):
        words = "Noise of all edge sensors through the loop. The faster a loop, the more of it."
        shown.append(noise_picture("noise", "surface", "nm", noise, words))
    return [Section("Over frequency", shown)]


@rc_context(STYLE)
def _modes(dataset: xr.Dataset) -> Figure:
    figure, panels = stacked(height=1.4 * HEIGHT)
    modes = dataset["mirror_mode"].to_numpy()
    for axes, key, label in zip(
        panels, ("singular", "multiplier"), ("reading per stroke (m/m)", "noise multiplier"), strict=True
    ):
        axes.plot(modes, dataset[key].to_numpy(), ".", markersize=4, color=COLORS[0])
        logarithmic(axes)
        axes.set_ylabel(label)
    panels[-1].set_xlabel("mode of the mirror, the least seen first")
    return figure


@rc_context(STYLE)
def _errors(dataset: xr.Dataset) -> Figure:
    figure, axes = one_panel()
    done = dataset.isel(case=np.flatnonzero(dataset["status"].to_numpy() == DONE))
    limit, least, low, high = (
        done[name].to_numpy() for name in ("limit_hz", "least_gain", "gain_low", "gain_high")
    )
    nominal = done["realization"].to_numpy() == 0
    shown = np.isfinite(limit)
    axes.hlines(limit[shown], low[shown], high[shown], color="#bbbbbb", linewidth=1.0)
    axes.plot(least[shown & ~nominal], limit[shown & ~nominal], "o", color=COLORS[0], markersize=4)
    axes.plot(least[shown & nominal], limit[shown & nominal], "s", color=COLORS[1], markersize=6)
    axes.set_ylim(0, 1.15 * max(limit[shown].max(initial=0.0), 1e-3))
    axes.set(xlabel="gain of the least seen mode (focus)", ylabel="unstable from (Hz)", title="Errors")
    return figure
