"""The report of a controller-mor store: controllers of reduced models on the full one, and a verdict."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import xarray as xr
from rich.table import Table
from rich.text import Text

from wavequake.report.exposures.figures import Panel, exposure_panels
from wavequake.report.loops import figures as draw
from wavequake.report.loops.outcomes import Level, Outcome, answer, certificate, levels_of, spilled
from wavequake.report.loops.over_frequency import curves_of, loops_over_frequency, noise_picture, spectra_of
from wavequake.report.loops.spectra import of_density, spectra
from wavequake.report.page import Page, Picture, Section, picture
from wavequake.report.populations import left_out
from wavequake.report.table import MISSING, empty_table, number

_DEFINITIONS = (
    ("error", "‖G - G_rom‖ / ‖G‖ of the transfer matrix from forces to sensors: median in the band."),
    ("above", "The largest such error above the band, up to reduction.beyond_hz."),
    ("Δω/ζ", "Largest |Δω/ω| of the modes in the band that the variant has, over their damping ratio."),
    ("growth", "Largest real part of the closed loop's poles with the full model."),
    ("loop", "With the full model; if it grows, the mode with the most energy in the growing motion."),
    ("S peak", "Largest singular value of (I + G H)^-1 over frequency, with the full model."),
    ("gain, phase", "By how much all channels may change together, or come later, before it is unstable."),
    ("wavefront", "Twice the surface's motion along z, rms over surface and time, piston included."),
    ("Strehl", "Peak of the long exposure of a star by the mirror alone, at image.wavelength_nm."),
    ("promised", "The same of the reduced model in its own loop: what its designer would expect."),
)
_SMALL_PRINT = "Margins and wavefronts are those of the full model; an unstable loop has none."


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    levels = levels_of(dataset)
    words = f"{answer(levels)} {certificate(levels)}"
    model = "variant", "error\n(%)", "Δω/ζ", "grows at\n(1/s, Hz)"
    headers = (*model, "S\npeak", "gain", "phase\n(deg)", "WFE\n(nm)")
    table = empty_table(headers, fixed=True, caption=words, padding=(0, 1, 0, 0), pad_edge=False)
    for level in levels:
        table.add_row(Text(f"effort {level.effort:g}", style="bold"))
        for one in level.outcomes:
            grows = "" if one.stable else f"{number(one['growth'])}, {number(one['spill_hz'])}"
            table.add_row(
                one.variant + (" ←" if one is level.enough else ""),
                _percent(one["error_median"]),
                _short(one["shift_over_zeta"]),
                Text(grows, style="red"),
                number(one["sensitivity_peak"]),
                number(one["gain_up"]),
                number(one["phase_margin"]),
                number(one["wavefront"]),
            )
    return table


def page_of(store: Path, dataset: xr.Dataset, device: str) -> Page:
    """Return the HTML report."""
    dataset = dataset.load()
    levels = levels_of(dataset)
    return Page(
        answer=answer(levels),
        table=[row_of(level, one) for level in levels for one in level.outcomes],
        small_print=f"{_SMALL_PRINT} {certificate(levels)}",
        overview=[
            picture(
                f"outcome-{number_}",
                f"Open-loop error and what becomes of the loop, effort {level.effort:g}",
                draw.error_and_outcome(level),
                "If the open-loop error decided, crosses would stand at the right and points rise to them. "
                "An unstable loop has no wavefront: its cross lies on the dashed line. Names stand where "
                "there is room.",
            )
            for number_, level in enumerate(draw.drawable(levels))
        ],
        sections=[
            Section(f"Effort {level.effort:g}", [*_figures(dataset, level, place)])
            for place, level in enumerate(draw.drawable(levels))
        ],
        definitions=list(_DEFINITIONS),
        kind="variant",
        left_out=left_out(dataset, ["variant", "effort"], most=1000),
    )


def row_of(level: Level, one: Outcome) -> dict[str, tuple[str, str]]:
    """Return header -> (value, small print) of one case."""
    own = "" if one["controller_growth"] < 0 else "controller unstable by itself"
    exact = one["growth_full"]
    return {
        "effort": (f"{one.effort:g}", ""),
        "variant": (one.variant + (" ←" if one is level.enough else ""), own),
        "order": (str(one.order), ""),
        "error (%)": (_percent(one["error_median"]), f"max {_percent(one['error_max'])}"),
        "above (%)": (_percent(one["error_beyond"]), ""),
        "Δω/ζ": (
            _short(one["shift_over_zeta"]),
            f"{one['missing_modes']:.0f} modes missing" if one["missing_modes"] else "",
        ),
        "loop": (
            "stable" if one.stable else f"{one['unstable_poles']:.0f} poles grow",
            "" if one.stable else spilled(one),
        ),
        "growth (1/s)": (number(one["growth"]), "" if np.isnan(exact) else f"all modes {number(exact)}"),
        "S peak": (number(one["sensitivity_peak"]), ""),
        "gain": (
            number(one["gain_up"]),
            "" if not one["gain_down"] > 0 else f"from {number(one['gain_down'])}",
        ),
        "phase (deg)": (
            number(one["phase_margin"]),
            f"{number(one['delay_margin'])} ms" if np.isfinite(one["delay_margin"]) else "",
        ),
        "wavefront (nm)": (
            number(one["wavefront"]),
            "" if not one.stable else f"promised {number(one['wavefront_promised'])}",
        ),
        "Strehl": (number(one["strehl"], 4), ""),
    }


def _percent(share: float) -> str:
    return _short(100 * share)


def _short(value: float) -> str:
    if np.isnan(value):
        return MISSING
    return f"{value:.0e}" if 0 < value < 1e-3 else number(value, 2)


def _figures(dataset: xr.Dataset, level: Level, place: int) -> Iterator[Picture]:
    criterion = json.loads(dataset.attrs["study"])["criterion"]
    yield picture(
        f"poles-{place}",
        "Poles of the loops with the full model",
        draw.poles(dataset, level),
        "Above the line a motion grows. Names stand at the pole that grows fastest; squares are the modes "
        "that the structure has by itself.",
    )
    yield picture(
        f"margins-{place}",
        "Margins over the order of the model",
        draw.margins_over_order(level, criterion["peak"]),
        "The dashed line is the peak that the study allows; 1 over the peak is the distance to -1.",
    )
    yield picture(
        f"shifts-{place}",
        "How far the frequencies of each mode are off",
        draw.shifts(dataset, level),
        "A frequency that is off by its damping ratio (dashed line) turns the phase at the resonance: what "
        "was damped may be driven. It matters for modes that forces move and sensors see.",
    )
    yield from _images(dataset, level, place)
    yield from _over_frequency(dataset, level, place)


def _images(dataset: xr.Dataset, level: Level, place: int) -> Iterator[Picture]:
    if "exposure" not in dataset:
        return
    images = {one.variant: dataset["exposure"].to_numpy()[one.row] for one in level.telling if one.stable}
    images = {"without a controller": dataset["open_exposure"].to_numpy(), **images}
    yield picture(
        f"exposure-{place}",
        "Long exposures of a star",
        exposure_panels(
            [Panel(name, image, np.zeros((0, 2))) for name, image in images.items()], dataset["x"].to_numpy()
        ),
        "By the mirror alone, in closed form, with the full model, four decades: what moves slower than the "
        "exposure blurs it. Unstable loops have none.",
    )


def _over_frequency(dataset: xr.Dataset, level: Level, place: int) -> Iterator[Picture]:
    yield from loops_over_frequency(
        f"effort-{place}-",
        curves_of(
            (one.variant if one.stable else f"{one.variant}, unstable", dataset.isel(case=one.row))
            for one in level.telling
        ),
        "A line for each eigenvalue of the loop gain with the full model. Shown are the model that is "
        "enough, the most accurate one that destabilizes and the least accurate one that does not.",
        "Largest singular values: of what is left of a disturbance at the sensors, and of what comes of "
        "their noise. An unstable loop has none.",
    )
    stable = [(one.variant, dataset.isel(case=one.row)) for one in level.telling if one.stable]
    if not stable or "left_psd" not in dataset:  # 0.3 kept no spectra
        return
    hertz = dataset["frequency"].to_numpy()
    calm = of_density("without a controller", hertz, dataset["open_psd"].to_numpy(), flat=True, calm=True)
    yield picture(
        f"effort-{place}-spectrum",
        "Spectrum of the wavefront, and how its rms adds up",
        spectra([calm, *spectra_of(stable, "left_psd")], "What is left of the forces", "nm"),
        "Exact, with the full model, for white forces; the thick line is the wavefront without a controller. "
        "Below is the rms of all that is faster than a frequency. The sensors' noise is not in it.",
    )
    yield noise_picture(
        f"effort-{place}-noise",
        "wavefront",
        "nm",
        spectra_of(stable, "noise_psd"),
        "Exact, with the full model: white noise of the sensors through controller and forces. Squared it "
        "adds to the square of what is left of the forces.",
    )
