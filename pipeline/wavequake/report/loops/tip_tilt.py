"""The report of a tip-tilt-vibration store: what integrator and LQG leave, exactly and in runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from rich.table import Table

from wavequake.campaign.contract import DONE
from wavequake.report.figures import COLORS, STYLE, curve_style, one_panel
from wavequake.report.loops.over_frequency import (
    SENSITIVITY,
    curves_of,
    loops_over_frequency,
    noise_picture,
    spectra_of,
)
from wavequake.report.loops.spectra import Spectrum, spectra
from wavequake.report.page import Page, Picture, Section, picture
from wavequake.report.populations import left_out
from wavequake.report.table import MISSING, number, table_of_rows

_DEFINITIONS = (
    ("exact", "From the joint stationary covariance of disturbance and loop (Van Loan, Lyapunov)."),
    ("integral", "The spectrum times 1 - sinc²(fT)(1 - |S|²) over all frequencies, and the noise."),
    ("runs", "Root of the mean square over all runs, ± its standard error."),
    ("|S| max", "Largest amplification of frame means over frequency."),
    ("gain margin, phase", "By which factor, or phase, the loop gain may change before it is unstable."),
)


@dataclass(frozen=True)
class Loop:
    """A controller at a rate; rms in mas, with the standard error of the runs' (NaN for one run)."""

    controller: str
    rate_hz: float
    row: int
    runs: int
    exact: float
    integral: float
    simulated: float
    error: float
    gain: float
    peak: float
    gain_up: float
    phase_deg: float

    @property
    def label(self) -> str:
        """Name of its curves."""
        return f"{self.controller}, {self.rate_hz:g} Hz"


def loops_of(dataset: xr.Dataset) -> list[Loop]:
    """Return the loops of a store in the order of its cases."""
    done = dataset["status"].to_numpy() == DONE
    names, rates = dataset["controller"].to_numpy(), dataset["rate_hz"].to_numpy()
    found = []
    for name, rate in dict.fromkeys(zip(names.tolist(), rates.tolist(), strict=True)):
        rows = np.flatnonzero(done & (names == name) & (rates == rate))
        if not len(rows):
            continue
        squares = dataset["simulated_mas"].to_numpy()[rows] ** 2
        rms = float(np.sqrt(squares.mean()))
        error = float(squares.std(ddof=1) / np.sqrt(len(rows)) / (2 * rms)) if len(rows) > 1 else np.nan
        exact, integral, *others = (
            float(dataset[one].to_numpy()[rows[0]])
            for one in ("exact_mas", "integral_mas", "gain", "sensitivity_peak", "gain_up", "phase_margin")
        )
        found.append(Loop(name, float(rate), int(rows[0]), len(rows), exact, integral, rms, error, *others))
    return found


_WORDS = {"lqg": "LQG", "integrator": "the integrator"}


def answer(dataset: xr.Dataset, loops: Sequence[Loop]) -> str:
    """Say what the best loop leaves, what a model of the vibration gains, and whether all ways agree."""
    if not loops:
        return "No case is done yet."
    best = min(loops, key=lambda one: one.exact)
    shaken = float(dataset["open_mas"].to_numpy()[best.row])
    words = (
        f"Of {number(shaken)} mas, {_WORDS.get(best.controller, best.controller)} at {best.rate_hz:g} Hz "
        "leaves the least, "
        f"{number(best.exact)} mas."
    )
    for rate in dict.fromkeys(one.rate_hz for one in loops):
        pair = {one.controller: one for one in loops if one.rate_hz == rate}
        if len(pair) == 2:
            words += (
                f" At {rate:g} Hz the integrator leaves {number(pair['integrator'].exact)} and LQG "
                f"{number(pair['lqg'].exact)} mas."
            )
    apart = max(abs(one.exact - one.integral) for one in loops)
    away = [abs(one.simulated - one.exact) / one.error for one in loops if one.error > 0]
    words += f" Covariances and integrals over frequency agree to {apart:.0e} mas"
    return words + (f", runs lie within {max(away):.1f} standard errors." if away else ".")


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    loops = loops_of(dataset)
    return table_of_rows([row_of(one) for one in loops], answer(dataset, loops), small=" {}")


def row_of(one: Loop) -> dict[str, tuple[str, str]]:
    """Return header -> (value, small print) of a loop."""
    return {
        "controller": (one.controller, ""),
        "rate (Hz)": (f"{one.rate_hz:g}", ""),
        "exact (mas)": (f"{one.exact:.4f}", ""),
        "integral (mas)": (f"{one.integral:.4f}", ""),
        "runs (mas)": (f"{one.simulated:.3f}", f"± {one.error:.3f}" if one.error > 0 else ""),
        "gain": (MISSING if np.isnan(one.gain) else number(one.gain), ""),
        "|S| max": (number(one.peak), ""),
        "gain margin": (number(one.gain_up), ""),
        "phase (deg)": (number(one.phase_deg), ""),
    }


def page_of(store: Path, dataset: xr.Dataset, device: str) -> Page:
    """Return the HTML report."""
    dataset = dataset.load()
    loops = loops_of(dataset)
    return Page(
        answer=answer(dataset, loops),
        table=[row_of(one) for one in loops],
        small_print="The rms over time of the line of sight along one axis; ± is a standard error of runs.",
        overview=[
            picture(
                "rates",
                "Residual over the rate of frames",
                _rates(loops),
                "Marks with bars are runs in time with three standard errors; lines join the exact values.",
            )
        ]
        if loops
        else [],
        sections=[
            Section(f"Over frequency, {rate:g} Hz", _over_frequency(dataset, rate, mine))
            for rate in dict.fromkeys(one.rate_hz for one in loops)
            if (mine := [one for one in loops if one.rate_hz == rate])
        ],
        definitions=list(_DEFINITIONS),
        kind="controller",
        left_out=left_out(dataset, ["controller", "rate_hz"], most=1000),
    )


def _over_frequency(dataset: xr.Dataset, rate: float, loops: Sequence[Loop]) -> list[Picture]:
    rows = [(one.label, dataset.isel(case=one.row)) for one in loops]
    shown = loops_over_frequency(
        f"{rate:g}-",
        curves_of(rows),
        "Curves end at half the rate of frames.",
        f"{SENSITIVITY} LQG digs notches where it knows lines to be.",
    )
    heard = spectra_of(rows, "noise_psd") if "noise_psd" in dataset else []  # 0.3 kept none
    words = (
        "Noise of frames through the loop, |T|² of it, up to half the rate of frames. It adds to what is "
        "left of the disturbance."
    )
    return [
        *shown,
        picture(
            f"spectrum-{rate:g}",
            "Spectrum of the disturbance and of what is left, and how their rms adds up",
            spectra(spectra_left(dataset, loops), "What is left of the line of sight", "mas"),
            "The thick line is the motion without a loop. Below is the rms of all that is faster than a "
            "frequency, by integrals: the residual comes from where a curve rises to the left. What the "
            "sensor's noise adds is not in it.",
        ),
        *([noise_picture(f"noise-{rate:g}", "line of sight", "mas", heard, words)] if heard else []),
    ]


def spectra_left(dataset: xr.Dataset, loops: Sequence[Loop]) -> list[Spectrum]:
    """Return the disturbance over frequency, and what loops leave of it.

    Their rms from a frequency on upwards is of integrals: the store has those up to it, to which the noise is
    added from the start, and that of all.
    """
    hertz, found = dataset["frequency"].to_numpy(), []
    calm, own = ("open_psd", "open_cumulative", "open_mas"), ("left_psd", "cumulative", "integral_mas")
    every = [("without a loop", loops[0].row, calm), *((one.label, one.row, own) for one in loops)]
    for label, row, names in every:
        density, below, whole = (dataset.isel(case=row)[name].to_numpy() for name in names)
        above = np.sqrt(np.maximum(whole**2 - below**2, 0.0))
        found.append(Spectrum(label, hertz, density, above, names is calm))
    return found


@rc_context(STYLE)
def _rates(loops: Sequence[Loop]) -> Figure:
    figure, axes = one_panel()
    for place, name in enumerate(dict.fromkeys(one.controller for one in loops)):
        mine = sorted((one for one in loops if one.controller == name), key=lambda one: one.rate_hz)
        rates = [one.rate_hz for one in mine]
        axes.plot(rates, [one.exact for one in mine], label=name, **curve_style(place))
        bars = [0.0 if np.isnan(one.error) else 3 * one.error for one in mine]
        axes.errorbar(
            rates,
            [one.simulated for one in mine],
            bars,
            fmt="o",
            color=COLORS[place],
            markersize=4,
            capsize=3,
        )
    axes.set_xscale("log")
    axes.set_xticks(sorted({one.rate_hz for one in loops}))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylim(bottom=0)
    axes.set(xlabel="frames per second (Hz)", ylabel="line of sight (mas rms)", title="What is left")
    axes.legend()
    return figure
