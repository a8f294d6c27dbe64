"""Whether the cases of a store and telemetry agree, band by band: in the terminal and as a table."""

import csv
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from wavequake.campaign.contract import DONE
from wavequake.campaign.store.store import open_store
from wavequake.drawing.style import COLORS, HEIGHT, STYLE, WIDTH
from wavequake.errors import UserError
from wavequake.mechanics.telemetry.agreement import (
    FEWEST,
    Band,
    Pieces,
    agreement,
    independent_pieces,
    overlapping_pieces,
)
from wavequake.mechanics.telemetry.columns import ANGLES, LENGTHS, SIGHT, WAVEFRONT, Channel
from wavequake.mechanics.telemetry.record import Record, read_record
from wavequake.optics.systems.file import SystemSection, build
from wavequake.optics.systems.paraxial import paraxial
from wavequake.report.figures import stacked
from wavequake.report.table import empty_table, number
from wavequake.words import counted

Array = NDArray[np.float64]

RECORDS = (".csv", ".npz", ".fits")
_FEWEST_CASES = 4
_SHOWN = 6
_OFF = 1e-3  # of a step, by which ratios of steps may differ from whole numbers


@dataclass(frozen=True)
class Agreement:
    """Bands of model and data, and what they are of.

    Attributes
    ----------
    channels : tuple of Channel
    bands : list of Band
    model, data : Pieces
    name : str
        The disturbance.
    cases : int
    """

    channels: tuple[Channel, ...]
    bands: list[Band]
    model: Pieces
    data: Pieces
    name: str
    cases: int

    @property
    def agrees(self) -> bool:
        """Whether all bands do."""
        return all(band.agrees for band in self.bands)


def agreement_of(store: Path, data: Path, of: str | None = None) -> Agreement:
    """Compare the cases of a store with telemetry.

    Parameters
    ----------
    store, data : Path
    of : str, optional
        The disturbance; by default the only one, or the last combination.

    Raises
    ------
    UserError
        If the store has no series of what was measured, or cases near a limit, there are several disturbances
        to choose from, or the sampling of both has no common step; or as `read_record`.
    """
    record = read_record(data)
    dataset = open_store(store)
    if "log_weight" in dataset.variables:
        raise UserError(
            f"The cases of {store} are drawn near a limit, where all shakes more; compare telemetry with "
            "those of wavequake run, of the study without [rare]."
        )
    if "time_s" not in dataset or "disturbance" not in dataset:
        raise UserError(
            f"{store} holds no series over time of a disturbance; compare telemetry with stores of "
            "system-disturbance and segment-disturbance."
        )
    name = _chosen(dataset, of, store)
    mine = (dataset["disturbance"] == name) & (dataset["status"] == DONE)
    if "reduction" in dataset:
        mine &= dataset["reduction"] == "full"
    rows = np.flatnonzero(mine.to_numpy())
    if len(rows) < _FEWEST_CASES:
        raise UserError(f"{store} has {len(rows)} cases of {name}; spectra need at least {_FEWEST_CASES}.")
    chosen = dataset.isel(case=rows)
    time = np.asarray(chosen["time_s"].isel(case=0).to_numpy(), dtype=np.float64)
    time = time[np.isfinite(time)]
    step = _even_step(time, store)
    series = np.stack([_series(chosen, one, store)[:, : len(time)] for one in record.channels], axis=2)
    if not np.isfinite(series).all():
        raise UserError(f"{store} has cases of {name} without series; its light is lost at some instants.")
    return Agreement(record.channels, *_compared(series, step, record, store), name, len(rows))


def _chosen(dataset: xr.Dataset, of: str | None, store: Path) -> str:
    names = list(dict.fromkeys(dataset["disturbance"].to_numpy().tolist()))
    if of is not None and of not in names:
        raise UserError(f"{store} has no cases of {of!r}; it has {', '.join(names)}.")
    if of is None and len(names) > 1:
        raise UserError(f"{store} has cases of {', '.join(names)}; say which was measured: --of NAME.")
    return of or str(names[0])


def _even_step(time: Array, store: Path) -> float:
    steps = np.diff(time)
    if len(time) < FEWEST:
        raise UserError(
            f"The cases of {store} have {len(time)} instants; spectra need at least {FEWEST}: run with more "
            "(instants of the disturbance)."
        )
    if not np.allclose(steps, steps[0], rtol=1e-6):
        raise UserError(f"The instants of {store} are not evenly spaced; spectra need even ones.")
    return float(steps[0])


def _series(dataset: xr.Dataset, one: Channel, store: Path) -> Array:
    """Return the series (cases, n) of a channel, in its unit."""
    if one.element == WAVEFRONT:
        values, unit = _at_field(dataset, "zernike", one, store), LENGTHS["nm"]
        term = int(one.axis[1:])
        if term > values.sizes["noll"]:
            raise UserError(f"{one.name!r} is of Noll term {term}; {store} has {values.sizes['noll']}.")
        values = values.isel(noll=term - 1)
    elif one.element == SIGHT and "los" in dataset:
        if one.unit not in ANGLES:
            raise UserError(f"{one.name!r} is a length; {store} has angles on the sky, such as x_mas.")
        values, unit = dataset["los"].isel(axis="xy".index(one.axis)), ANGLES["mas"]
    elif one.element == SIGHT:
        values, unit = _at_field(dataset, "los_mm", one, store), LENGTHS["mm"]
        values = values.isel(axis="xy".index(one.axis))
        if one.unit in ANGLES:
            unit /= _focal_length(dataset, store)
    else:
        raise UserError(
            f"{one.name!r} is not what {store} holds: the wavefront (wavefront.z4_nm) and the line of sight "
            f"({SIGHT}.x_mas). Leave the column out."
        )
    if "time" not in values.dims:
        raise UserError(f"{store} holds no series over time (store.reduce); run with store.reduce = 'none'.")
    return np.asarray(values.transpose("case", "time").to_numpy(), dtype=np.float64) * (unit / one.si)


def _at_field(dataset: xr.Dataset, name: str, one: Channel, store: Path) -> xr.DataArray:
    if name not in dataset:
        raise UserError(f"{store} holds no {name}, which {one.name!r} would be compared with.")
    values = dataset[name]
    for dim in ("field", "wavelength"):
        if dim in values.dims:
            place = one.field if dim == "field" else _primary(dataset)
            if place >= values.sizes[dim]:
                raise UserError(
                    f"{one.name!r} is of field point {place + 1}; {store} has {values.sizes[dim]}."
                )
            values = values.isel({dim: place})
    return values


def _study(dataset: xr.Dataset) -> dict[str, object]:
    record = json.loads(dataset.attrs.get("study", "{}"))
    return record if isinstance(record, dict) else {}


def _primary(dataset: xr.Dataset) -> int:
    return build(SystemSection.model_validate(_study(dataset)["system"], strict=False)).primary_wavelength


def _focal_length(dataset: xr.Dataset, store: Path) -> float:
    """Return the focal length, m."""
    system = build(SystemSection.model_validate(_study(dataset)["system"], strict=False))
    if np.isfinite(system.object_distance):
        raise UserError(f"The object of {store} is near; give the motion of the image, such as x_um.")
    return paraxial(system).focal_length * LENGTHS["mm"]


def _compared(series: Array, step: float, record: Record, store: Path) -> tuple[list[Band], Pieces, Pieces]:
    """Bring both to one step and compare them."""
    every, skip = step / record.step, 1
    if every < 1.0 - _OFF:
        skip, every = round(1.0 / every), 1.0
        step = step * skip
    if abs(every - round(every)) > _OFF or abs(step / record.step - round(every)) > _OFF * round(every):
        raise UserError(
            f"{store} has an instant every {step:.6g} s, the record a sample every {record.step:.6g} s; one "
            "must be a multiple of the other: choose duration_s and instants of the disturbance so."
        )
    series = series[:, skip - 1 :: skip]
    length = series.shape[1]
    if length < FEWEST or length * round(every) * 4 > len(record.values):
        raise UserError(
            f"A case of {store} covers {length * step:.4g} s in {length} common instants, the record "
            f"{record.duration:.4g} s; spectra need {FEWEST} instants and a record of four cases."
        )
    model = independent_pieces(series, step)
    data = overlapping_pieces(record.values, record.step, length, round(every))
    return agreement(model, data), model, data


def agreement_table(found: Agreement) -> Table:
    """Return octaves and the whole, signal by signal."""
    table = empty_table(
        ("signal", "Hz", "model rms", "data rms", "data / model", "verdict"),
        ("signal", "verdict"),
        caption="data / model: ratio of powers with its 95 % interval. Where both have the same spectra, any "
        "band is said to differ in one of twenty comparisons.",
    )
    for band in (band for band in found.bands if band.scale != "line"):
        one = found.channels[band.signal]
        table.add_row(
            f"{one.element}.{one.axis} ({one.unit})" if band.scale == "whole" or _first(found, band) else "",
            f"{band.low_hz:.4g} to {band.high_hz:.4g}",
            number(band.model_rms),
            number(band.data_rms),
            f"{band.ratio:.3g} [{band.low:.3g}, {band.high:.3g}]",
            "agree" if band.agrees else "differ",
        )
    return table


def _first(found: Agreement, band: Band) -> bool:
    return next(one for one in found.bands if one.scale == band.scale and one.signal == band.signal) is band


def agreement_notes(found: Agreement) -> Iterator[str]:
    """Yield the verdict, and the narrow bands that differ most."""
    wrong = [band for band in found.bands if not band.agrees]
    cases = counted(found.cases, "case")
    worth = f"{cases} of {found.name} and a record worth {found.data.averages:.0f} such cases"
    if not wrong:
        yield f"Model and data agree in all {len(found.bands)} bands: {worth}."
        return
    yield f"Model and data differ in {len(wrong)} of {len(found.bands)} bands: {worth}."
    narrow = sorted((band for band in wrong if band.scale == "line"), key=lambda band: band.margin)
    for band in narrow[:_SHOWN]:
        yield (
            f"{found.channels[band.signal].name} at {band.low_hz:.5g} to {band.high_hz:.5g} Hz: the data "
            f"have {band.ratio:.3g} times the model's power [{band.low:.3g}, {band.high:.3g}]."
        )
    if len(narrow) > _SHOWN:
        yield f"{len(narrow) - _SHOWN} more narrow bands differ; -o FILE.csv lists all."


def write_agreement(found: Agreement, file: Path) -> None:
    """Write a row per band, or draw the spectra.

    Raises
    ------
    UserError
        If the file cannot be written, or its name does not say what it holds.
    """
    if file.suffix.lower() not in (".csv", ".png", ".svg", ".pdf"):
        raise UserError(f"{file} must end in .csv (a table) or .png, .svg or .pdf (a figure).")
    try:
        if file.suffix.lower() != ".csv":
            agreement_figure(found).savefig(file, dpi=150)
            return
        with file.open("w", encoding="utf-8", newline="") as out:
            csv.writer(out, lineterminator="\n").writerows(rows(found))
    except OSError as error:
        raise UserError(f"{file} cannot be written: {error.strerror}.") from None


def rows(found: Agreement) -> Iterator[Sequence[object]]:
    """Yield the names of columns, then a row per band."""
    yield "signal", "scale", "low_hz", "high_hz", "model_rms", "data_rms", "ratio", "low", "high", "agrees"
    for band in found.bands:
        yield (
            found.channels[band.signal].name, band.scale, band.low_hz, band.high_hz, band.model_rms,
            band.data_rms, band.ratio, band.low, band.high, band.agrees,
        )  # fmt: skip


@rc_context(STYLE)
def agreement_figure(found: Agreement) -> Figure:
    """Draw both spectra of each signal, and mark the narrow bands that differ."""
    channels = found.channels[:8]
    figure, panels = stacked(len(channels), 1.4 * WIDTH, 0.6 * HEIGHT * len(channels) + 0.6)
    for signal, (one, axes) in enumerate(zip(channels, panels, strict=True)):
        wrong = [b for b in found.bands if b.signal == signal and b.scale == "line" and not b.agrees]
        for band in wrong:
            axes.axvspan(band.low_hz, band.high_hz, color="#f3d9c9", linewidth=0.0)
        for side, name, color, dash in (
            (found.data, "data", COLORS[1], "-"),
            (found.model, "model", COLORS[0], "--"),
        ):
            axes.plot(side.frequency, side.density[:, signal], dash, color=color, linewidth=1.0, label=name)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylabel(f"{one.element}.{one.axis}\n({one.unit}²/Hz)")
    panels[0].set_title(f"Model ({found.name}) and data; narrow bands that differ are shaded")
    panels[0].legend(loc="best")
    panels[-1].set_xlabel("frequency (Hz)")
    return figure
