"""The report of a lens-passive store: the best springs and inertias that were found."""

from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.figure import Figure
from rich.table import Table

from wavequake.campaign.contract import DONE
from wavequake.control.bench import LENSES, Bench, bench_modes, fitted_bench
from wavequake.control.passive import modal_amplitudes
from wavequake.report.figures import COLORS, HEIGHT, STYLE, WIDTH
from wavequake.report.page import Page, Section, picture
from wavequake.report.populations import left_out
from wavequake.report.table import empty_table, number
from wavequake.workflows.lens.passive import PARAMETERS

_NAMES = {
    "lens_springs": "lens spring (N/m)",
    "ring_springs": "ring spring (N/m)",
    "couplings": "coupling to the next ring (N/m)",
    "lens_kg": "lens (kg)",
    "ring_kg": "ring (kg)",
}
_SMALL_PRINT = "Best of all starts of the search; present values in small print. The bench is synthetic."


def best_of(dataset: xr.Dataset) -> int | None:
    """Return the row of the start that ended lowest, or None where none is done."""
    done = np.flatnonzero(dataset["status"].to_numpy() == DONE)
    if not len(done):
        return None
    return int(done[np.argmin(dataset["amplitude_sum"].to_numpy()[done])])


def answer(dataset: xr.Dataset) -> str:
    """Say what the best springs and inertias gain."""
    best = best_of(dataset)
    if best is None:
        return "No start of the search is done."
    done = int((dataset["status"].to_numpy() == DONE).sum())
    left = number(float(dataset["peak_to_peak"][best]), 2)
    return (
        f"With other springs and inertias, a blow moves the image over {left} % of the present range "
        f"(best of {done} starts)."
    )


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    table = empty_table(("lens", *_NAMES.values()), (), caption=answer(dataset))
    for row in _rows(dataset):
        table.add_row(*(f"{value} ({small})" if small else value for value, small in row.values()))
    return table


def _rows(dataset: xr.Dataset) -> list[dict[str, tuple[str, str]]]:
    best, present = best_of(dataset), fitted_bench(active=False)
    if best is None:
        return []
    found = {name: dataset[name].isel(case=best).to_numpy() for name in PARAMETERS}
    return [
        {"lens": (str(lens + 1), "")}
        | {
            title: (number(float(found[name][lens])), number(float(getattr(present, name)[lens])))
            if lens < len(found[name])
            else ("", "")
            for name, title in _NAMES.items()
        }
        for lens in range(LENSES)
    ]


def page_of(store: Path, dataset: xr.Dataset, device: str) -> Page:
    """Return the HTML report."""
    best = best_of(dataset)
    pictures = []
    if best is not None:
        text = "Amplitudes of the modes in the image, present and optimized"
        pictures = [
            picture(
                "amplitudes",
                text,
                _amplitudes(dataset, best, fitted_bench(active=False)),
                "Each bar is what one mode does to the image: the optimum lowers the sum, not each of them.",
            )
        ]
    return Page(
        answer=answer(dataset),
        table=_rows(dataset),
        small_print=_SMALL_PRINT,
        overview=pictures,
        sections=list[Section](),
        definitions=[("amplitude", "|C_j B_j u(ω_j)|/ω_j of mode j: the terms of Störkle 2018, Eq. 5.4.")],
        kind="start",
        left_out=left_out(dataset, "realization", most=1000),
    )


@rc_context(STYLE)
def _amplitudes(dataset: xr.Dataset, best: int, present: Bench) -> Figure:
    figure = Figure(figsize=(WIDTH, HEIGHT))
    axes = figure.add_axes((0.12, 0.15, 0.86, 0.78))
    omega, amplitude = (dataset[name].isel(case=best).to_numpy() for name in ("frequency", "mode_amplitude"))
    pairs = (
        (bench_modes(present).omega, 1e3 * modal_amplitudes(present), "present"),
        (omega, amplitude, "optimized"),
    )
    for place, (omega, amplitude, label) in enumerate(pairs):
        axes.stem(omega, amplitude, linefmt=COLORS[place], markerfmt="os"[place], basefmt=" ", label=label)
    axes.set_xlabel("frequency of the mode (rad/s)")
    axes.set_ylabel("amplitude in the image (mm)")
    axes.legend()
    return figure
