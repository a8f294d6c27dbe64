"""The report of a system-disturbance store: a row per disturbance and field point, and figures."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from wavequake.campaign.contract import DONE
from wavequake.campaign.store.store import read_manifest
from wavequake.drawing.periodogram import has_spectrum
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.folded import folded_lines
from wavequake.mechanics.disturbances.registry import Combine, instants_of
from wavequake.optics.systems.kinematics import at_instant
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.systems.system import wavelength_of
from wavequake.optics.wavefronts.wavefront import trace_system
from wavequake.report import uncertain
from wavequake.report.answers import budget
from wavequake.report.certificate import certificate
from wavequake.report.figures import distributions
from wavequake.report.histories import has_all_instants, what_is_kept
from wavequake.report.page import Page, Picture, Section, picture
from wavequake.report.populations import frame_of, left_out, nothing_known
from wavequake.report.reduced_models import model_results, verdict
from wavequake.report.reduced_models import pictures as model_pictures
from wavequake.report.statistics import Quantile, quantile
from wavequake.report.systems import figures as draw_figures
from wavequake.report.systems import images as system_images
from wavequake.report.systems.answer import answer, is_incomplete
from wavequake.report.systems.populations import (
    FieldResult,
    SystemPopulation,
    parted_variance,
    peaks_at_rest,
    populations,
)
from wavequake.report.table import empty_table, interval, number, radius, share
from wavequake.report.vibration import histories_and_spectra
from wavequake.words import counted
from wavequake.workflows.systems.bench import (
    NM_PER_MM,
    SystemBench,
    beyond_rounding,
    field_name,
    system_bench,
    system_states,
)
from wavequake.workflows.systems.draws import draw
from wavequake.workflows.systems.measure import worst_instant

Array = NDArray[np.float64]

_SMALL_PRINT = (
    "At the primary wavelength, but peak and EE80: exposures are of all wavelengths. WFE, its change from "
    "rest and spot: rms of a case over its instants; P50 and P95 over cases. LOS: rms of both axes "
    "about the mean of all cases and instants. Strehl: over all instants; over a million, "
    "evenly spaced, of more. Maréchal: share "
    "of instants with an rms of at most λ/14 about the best-fit plane. Vignetted: the largest number of rays "
    "at any instant that openings stop, of all that are traced."
)
_INTERVALS = (
    " Small print below a number: its 95 % confidence interval; ± is the standard error of the number above "
    "it."
)
_DEFINITIONS = (
    ("WFE", "Root of the sum of squares of the Noll Zernike coefficients j ≥ 4: piston and tilt removed."),
    ("WFE change", "The same of the coefficients less those at rest: what the disturbance adds."),
    ("LOS", "Image point of the best-fit plane (Störkle 2018, Eq. 3.39), relative to rest."),
    ("spot", "Rms distance of the rays' image points from their centroid."),
    ("Strehl", "Intensity in the direction of the best-fit plane, relative to a perfect wavefront."),
)


_DEFINITIONS_OF_IMAGES = (
    ("peak", "Of a case's exposure, the mean of the images of its instants, over that of a perfect image."),
    ("EE80", "Radius of the circle about the exposure's centroid that holds 80 % of its light."),
)


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    bench = system_bench(read_manifest(store).study)
    found = populations(dataset, bench)
    headers = _headers(found)
    words = certificate(bench.study.optics.modal_tolerance_nm, dataset)
    caption = "\n\n".join([_SMALL_PRINT + _partial(found, bench) + what_is_kept(dataset), *words])
    names = "disturbance\nfield", *(header.replace(" ", "\n") for header in headers[3:])
    table = empty_table(names, fixed=True, padding=0, pad_edge=False, caption=caption)
    table.add_row(Text("at rest", style="bold"))
    for resting in _at_rest(dataset, bench):
        table.add_row(f"  {resting['field'][0]}", *(resting[header][0] for header in headers[3:]))
    for population in found:
        table.add_row(Text(f"{population.name}, {counted(len(population.cases), 'case')}", style="bold"))
        for one in population.fields:
            row = _row(population, one, bench, frame_of(dataset))
            table.add_row(f"  {one.field}", *(row[header][0] for header in headers[3:]))
    return table


def _failed(found: Sequence[SystemPopulation], dataset: xr.Dataset) -> dict[str, int]:
    """Return of disturbances without any finished case how many failed."""
    names, failed = dataset["disturbance"].to_numpy(), dataset["status"].to_numpy() > DONE
    return {one.name: int((failed & (names == one.name)).sum()) for one in found if not len(one.cases)}


def page_of(store: Path, dataset: xr.Dataset, device: str) -> Page:
    """Return the HTML report; the worst case of every disturbance is traced again for its spot diagrams."""
    bench = system_bench(read_manifest(store).study)
    found = populations(dataset, bench)
    headers = _headers(found)
    rows = [*_at_rest(dataset, bench)]
    frame = frame_of(dataset)
    rows += [_row(population, one, bench, frame) for population in found for one in population.fields]
    compared, uncertain_parts = bench.study.reduction, bench.study.structure.uncertain is not None
    parts = parted_variance(found) if uncertain_parts else []
    light = dataset.isel(wavelength=bench.system.primary_wavelength)
    models = model_results(light, compared.variants) if compared is not None else []
    largest = compared.largest if compared is not None else 0.0
    return Page(
        answer=nothing_known(_failed(found, dataset))
        + answer(found, _sums(bench))
        + verdict(models, largest)
        + uncertain.sentence(parts)
        + "".join(f" {one}" for one in certificate(bench.study.optics.modal_tolerance_nm, dataset)),
        table=[{header: row[header] for header in headers} for row in rows],
        small_print=_SMALL_PRINT + _INTERVALS + _partial(found, bench) + what_is_kept(dataset),
        overview=[
            *_overview(found),
            *model_pictures(models, largest),
            *uncertain.pictures(parts),
            *budget.pictures(store),
        ],
        sections=[
            Section(one.name, [*_figures(bench, one, _error(found), dataset, device)]) for one in found
        ],
        definitions=[*_DEFINITIONS, *(_DEFINITIONS_OF_IMAGES if _imaged(found) else ())],
        kind="disturbance",
        left_out=left_out(dataset),
    )


def _overview(found: Sequence[SystemPopulation]) -> Iterator[Picture]:
    if any(len(one.cases) for one in found):
        sets = {one.name: one.fields[0].sets for one in found if one.fields}
        what = _error(found)[1]
        figure = distributions(_worst_fields(found), f"{what} of a case (nm), worst field", sets)
        yield picture(
            "distributions",
            f"Distribution of the {what} under all disturbances",
            figure,
            "The curve gives the share of cases at or below a value: further left is better. What the design "
            "has at rest is not in a change.",
        )


_HEADERS = (
    "disturbance",
    "cases",
    "field",
    "WFE P50 (nm)",
    "WFE P95 (nm)",
    "change P95 (nm)",
    "LOS (µm)",
    "spot P50 (µm)",
    "Strehl P50",
    "Maréchal",
    "arrived WFE P50 (nm)",
    "vignetted",
    "lost",
    "peak P50",
    "EE80 P50 (λ/D)",
)
_OF_PARTS = ("arrived WFE P50 (nm)", "lost")
_OF_IMAGES = ("peak P50", "EE80 P50 (λ/D)")


def _row(
    population: SystemPopulation, one: FieldResult, bench: SystemBench, frame: float
) -> dict[str, tuple[str, str]]:
    """Return header -> (value, small print) of one population at one field point."""
    error = one.los.standard_error
    rays = bench.study.optics.rays
    values = (
        (population.name, ""),
        (str(len(population.cases)), ""),
        (one.field, ""),
        _quantile(quantile(one.wfe, 0.5, sets=one.sets)),
        _quantile(quantile(one.wfe, 0.95, sets=one.sets)),
        _quantile(quantile(one.change, 0.95, sets=one.sets)),
        (number(one.los.radial), f"± {number(error, 2)}" if np.isfinite(error) else ""),
        _quantile(quantile(one.spot, 0.5, sets=one.sets)),
        (number(one.strehl_p50), ""),
        (share(one.marechal), ""),
        _quantile(quantile(one.raw, 0.5, sets=one.sets)),
        (f"{one.vignetted} of {rays}" if one.vignetted else "0", ""),
        (f"{one.lost - one.vignetted} of {rays}" if one.lost > one.vignetted else "0", ""),
        *(
            ("", "") if values is None else _quantile(quantile(values, 0.5, sets=one.sets), frame)
            for values in (one.peak, one.ee80)
        ),
    )
    return dict(zip(_HEADERS, values, strict=True))


def _at_rest(dataset: xr.Dataset, bench: SystemBench) -> Iterator[dict[str, tuple[str, str]]]:
    """Yield the rows of the design itself, field by field: what no disturbance adds."""
    light = dataset.isel(wavelength=bench.system.primary_wavelength)
    peaks, wavelength = peaks_at_rest(dataset), wavelength_of(bench.system)
    for place, field in enumerate(map(str, dataset["field"].to_numpy())):
        wfe, spot, strehl = (
            float(light[f"{key}_static"][place]) for key in ("wfe_rms", "spot_rms", "strehl")
        )
        known = {
            "disturbance": "at rest",
            "field": field,
            "WFE P50 (nm)": number(beyond_rounding(wfe, NM_PER_MM * wavelength)),
            "spot P50 (µm)": number(beyond_rounding(spot, 1e3 * wavelength)),
            "Strehl P50": number(strehl),
            "peak P50": number(float(peaks[place])),
        }
        yield {header: (known.get(header, ""), "") for header in _HEADERS}


def _headers(found: Sequence[SystemPopulation]) -> tuple[str, ...]:
    """Return the columns of the table: some more where rays do not arrive, and where there are images."""
    absent = set(() if is_incomplete(found) else _OF_PARTS) | set(() if _imaged(found) else _OF_IMAGES)
    absent |= set() if _strehl_known(found) else {"Strehl P50"}
    return tuple(name for name in _HEADERS if name not in absent)


def _strehl_known(found: Sequence[SystemPopulation]) -> bool:
    """Return whether Strehl ratios are stored: the modal model does not know them."""
    return any(np.isfinite(one.strehl_p50) for population in found for one in population.fields) or not found


def _imaged(found: Sequence[SystemPopulation]) -> bool:
    return any(one.peak is not None for population in found for one in population.fields)


def _error(found: Sequence[SystemPopulation]) -> tuple[str, str]:
    """Return which error of a `FieldResult` figures show, and its words."""
    return ("raw", "arrived WFE rms") if is_incomplete(found) else ("change", "WFE change rms")


def _partial(found: Sequence[SystemPopulation], bench: SystemBench) -> str:
    """Say what the numbers of a fit mean where rays do not arrive."""
    most = max((one.lost for population in found for one in population.fields), default=0)
    if not most:
        return ""
    least = 1.0 - most / bench.study.optics.rays
    return (
        f" At some instant no more than {share(least)} of the rays arrive at some field: WFE, change and LOS "
        "are those of a fit that goes on over the full pupil, also where no light arrives. Arrived WFE: rms "
        "over the rays that arrive, piston removed, tilt about the reference image point not. Lost: rays "
        "that no opening stops but that miss a surface or are totally reflected."
    )


def _quantile(found: Quantile, frame: float = np.nan) -> tuple[str, str]:
    """Return a quantile and its interval; infinite radii are those of circles beyond the `frame`."""
    if np.isposinf(found.value):
        return (f"> {frame:g}", "the frame") if np.isfinite(frame) else (radius(found.value, frame), "")
    return number(found.value), interval(found)


def _sums(bench: SystemBench) -> frozenset[str]:
    """Return the names of disturbances that are sums of others, which rank nothing."""
    return frozenset(one.name for one in bench.study.disturbance if isinstance(one, Combine))


def _worst_fields(found: Sequence[SystemPopulation]) -> dict[str, Array]:
    """Return the rms of each case at the field point whose median is largest, by disturbance."""
    which, _ = _error(found)
    return {
        one.name: max((getattr(field, which) for field in one.fields), key=lambda wfe: float(np.median(wfe)))
        for one in found
        if one.fields
    }


def _over_time(name: str, case: int, bench: SystemBench, dataset: xr.Dataset) -> Iterator[Picture]:
    """Yield history and spectrum of the worst case, where the store keeps enough instants of it."""
    if not has_all_instants(dataset):
        return
    light = dataset.sel(case=case).isel(wavelength=bench.system.primary_wavelength)
    time = light["time_s"].to_numpy()
    there = np.isfinite(time)
    if not has_spectrum(time[there]):
        return
    change, los = (light[key].to_numpy()[there] for key in ("wfe_change", "los_mm"))
    field = int(change.max(axis=0).argmax())
    where = field_name(bench.system, field)
    moved = 1e3 * los[:, field]
    if not np.ptp(moved, axis=0).any() and not np.ptp(change[:, field]):
        return
    series = {
        "WFE change": ("nm", {where: change[:, field]}),
        "line of sight": ("µm", {"x": moved[:, 0], "y": moved[:, 1]}),
    }
    yield picture(
        f"{name}-time",
        f"Worst case of {name} over time and over frequency, case {case}, field {where}",
        histories_and_spectra(time[there], series),
        f"Left what happens, right at which frequencies: peaks are resonances or the machine that shakes. "
        f"{folded_lines(bench.study.disturbance, name)}".strip(),
    )


def _figures(
    bench: SystemBench, population: SystemPopulation, error: tuple[str, str], dataset: xr.Dataset, device: str
) -> Iterator[Picture]:
    if population.worst is None:
        return
    name, (which, label) = population.name, error
    errors = [getattr(one, which) for one in population.fields]
    fields = [one.field for one in population.fields]
    sets = {one.field: one.sets for one in population.fields}
    figure = distributions(dict(zip(fields, errors, strict=True)), f"{label} (nm)", sets)
    yield picture(
        f"{name}-wfe",
        f"Distribution of the {label} by field, {name}",
        figure,
        "Curves that lie apart: the disturbance does more to some fields than to others.",
    )
    points = np.stack([dataset["field_x"].to_numpy(), dataset["field_y"].to_numpy()], axis=1)
    medians = np.median(errors, axis=1)
    unit = str(dataset["field_x"].attrs["units"])
    yield picture(
        f"{name}-field",
        f"{label} over the field, {name}",
        draw_figures.field_map(points, medians, unit, f"{label}, median of the cases (nm)"),
        "Each dot is a field point; its color is the error there.",
    )
    yield picture(
        f"{name}-spots",
        f"Spot diagrams, {name}",
        _spots(bench, population.worst, device),
        "The worst case at its worst instant, about the chief ray of the design at rest: a shift is the line "
        "of sight, a wider spot an aberration.",
    )
    yield from _over_time(name, population.worst, bench, dataset)
    yield from system_images.pictures(name, population.cases, bench, dataset)


def _spots(bench: SystemBench, case: int, device: str) -> Figure:
    """Trace a case again and draw the spots of its worst instant about where chief rays arrive at rest."""
    population, drawn = draw(bench, case)
    time = instants_of(bench.study.disturbance, population)
    instant = worst_instant(bench, time, drawn, choose_device(device))
    states = at_instant(system_states(bench, drawn), instant)
    panels = []
    for row, rest in zip(bench.prepared, bench.static, strict=True):
        center = rest[bench.system.primary_wavelength].chief[0]
        spots = []
        for prepared in row:
            _, traced, _ = trace_system(prepared, states, choose_device(device))
            spots.append(1e3 * (np.stack([traced.x[0], traced.y[0]], axis=1) - center))
        panels.append(spots)
    first_order = paraxial(bench.system)
    airy = 0.61e3 * float(bench.system.wavelengths[bench.system.primary_wavelength]) / first_order.image_na
    return draw_figures.spot_diagrams(
        panels,
        [str(name) for name in _field_labels(bench)],
        [f"{1e6 * wave:.5g} nm" for wave in bench.system.wavelengths],
        airy,
        f"case {case}, t = {time[instant]:.4g} s",
    )


def _field_labels(bench: SystemBench) -> list[str]:
    return [field_name(bench.system, index) for index in range(len(bench.prepared))]
