"""The report of a system-disturbance store: a row per disturbance and field point, and figures."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from wavequake.campaign.contract import DONE
from wavequake.campaign.store.retention import STATISTICS
from wavequake.campaign.store.store import read_manifest
from wavequake.kernels.device.devices import choose_device
from wavequake.mechanics.disturbances.registry import instants_of
from wavequake.optics.systems.paraxial import paraxial
from wavequake.optics.wavefronts.wavefront import trace_system
from wavequake.report import budget
from wavequake.report import system_figures as draw_figures
from wavequake.report.histories import has_histories, what_is_kept
from wavequake.report.page import Page, Picture, Section, picture, render_page, write_page
from wavequake.report.populations import left_out
from wavequake.report.statistics import Jitter, Quantile, case_rms, jitter_of_cases, quantile
from wavequake.report.table import interval, number, share
from wavequake.workflows.systems.system_bench import (
    SystemBench,
    at_instant,
    field_name,
    system_bench,
    system_states,
)
from wavequake.workflows.systems.system_disturbance import draw
from wavequake.workflows.systems.system_measure import worst_instant

Array = NDArray[np.float64]

_SERIES = ("wfe_rms", "wfe_change", "spot_rms", "wfe_rms_raw", "strehl", "los_mm")
_BLOCK_BYTES = 2**26  # of time series in memory at a time
_INSTANTS = 2**20  # about the most whose Strehl ratios a median is taken of

_SMALL_PRINT = (
    "At the primary wavelength. WFE, its change from rest and spot: rms of a case over its instants; P50 "
    "and P95 over cases, in small print its 95 % interval. LOS: rms of both axes "
    "about the mean of all cases and instants, ± standard error. Strehl: over all instants; over a million, "
    "evenly spaced, of more. Maréchal: share "
    "of instants with an rms of at most λ/14 about the best-fit plane. Vignetted: the largest number of rays "
    "at any instant that openings stop, of all that are traced."
)
_DEFINITIONS = (
    ("WFE", "Root of the sum of squares of the Noll Zernike coefficients j ≥ 4: piston and tilt removed."),
    ("WFE change", "The same of the coefficients less those at rest: what the disturbance adds."),
    ("LOS", "Image point of the best-fit plane (Störkle 2018, Eq. 3.39), relative to rest."),
    ("spot", "Rms distance of the rays' image points from their centroid."),
    ("Strehl", "Intensity in the direction of the best-fit plane, relative to a perfect wavefront."),
)


@dataclass(frozen=True)
class FieldResult:
    """What one population does at one field point, at the primary wavelength.

    ``wfe``, ``raw`` (of the rays that arrive), ``change`` (nm) and ``spot`` (um) hold the rms over its
    instants of each case, (C,); ``sets`` the stratified set of each, if cases are not independent.
    """

    field: str
    wfe: Array
    change: Array
    spot: Array
    strehl_p50: float
    marechal: float
    los: Jitter
    vignetted: int
    raw: Array
    lost: int
    sets: NDArray[np.int64] | None = None


@dataclass(frozen=True)
class SystemPopulation:
    """The finished cases of one disturbance.

    Attributes
    ----------
    name : str
    cases : ndarray of int, shape (C,)
        Ids.
    fields : tuple of FieldResult
    worst : int or None
        Case of the largest change of the wavefront at any instant and field point.
    """

    name: str
    cases: NDArray[np.int64]
    fields: tuple[FieldResult, ...]
    worst: int | None


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    bench = system_bench(read_manifest(store).study)
    found = populations(dataset, bench)
    headers = _headers(found)
    caption = _SMALL_PRINT + _partial(found, bench) + what_is_kept(dataset)
    table = Table(box=SIMPLE_HEAD, padding=0, pad_edge=False, caption=caption)
    table.caption_justify = "left"
    table.add_column("disturbance\nfield")
    for header in headers[3:]:
        table.add_column(header.replace(" ", "\n"), justify="right", no_wrap=True)
    for population in found:
        table.add_row(Text(f"{population.name}, {len(population.cases)} cases", style="bold"))
        for one in population.fields:
            row = _row(population, one, bench)
            table.add_row(f"  {one.field}", *(row[header][0] for header in headers[3:]))
    return table


def write_report_of(store: Path, dataset: xr.Dataset, target: Path, device: str) -> Path:
    """Write the HTML report; the worst case of every disturbance is traced again for its spot diagrams."""
    bench = system_bench(read_manifest(store).study)
    found = populations(dataset, bench)
    headers = _headers(found)
    rows = [_row(population, one, bench) for population in found for one in population.fields]
    page = Page(
        answer=answer(found),
        table=[{header: row[header] for header in headers} for row in rows],
        small_print=_SMALL_PRINT + _partial(found, bench) + what_is_kept(dataset),
        overview=[*_overview(found), *budget.pictures(store)],
        sections=[
            Section(one.name, [*_figures(bench, one, _error(found), dataset, device)]) for one in found
        ],
        definitions=list(_DEFINITIONS),
        kind="disturbance",
        left_out=left_out(dataset),
    )
    return write_page(render_page(dataset, page), target)


def _overview(found: Sequence[SystemPopulation]) -> Iterator[Picture]:
    if any(len(one.cases) for one in found):
        sets = {one.name: one.fields[0].sets for one in found if one.fields}
        words = f"{_error(found)[1]} of a case (nm), worst field"
        figure = draw_figures.distributions(_worst_fields(found), words, sets)
        yield picture("distributions", "Distribution of the wavefront error of all disturbances", figure)


def populations(dataset: xr.Dataset, bench: SystemBench) -> list[SystemPopulation]:
    """Split a store by disturbance, in the order in which the disturbances first appear.

    A few chunks are read at a time; numbers per case stay, and so many instants of the Strehl ratio that a
    median needs.
    """
    light = dataset.isel(wavelength=bench.system.primary_wavelength)
    names = np.array([str(name) for name in dataset["disturbance"].to_numpy()])
    done = dataset["status"].to_numpy() == DONE
    places = {name: np.flatnonzero(done & (names == name)) for name in dict.fromkeys(names.tolist())}
    present = {
        name: np.isfinite(light["time_s"].isel(case=rows[0]).to_numpy())  # as many instants in each case
        for name, rows in places.items()
        if len(rows) and has_histories(light)
    }
    parts: dict[str, list[dict[str, Array]]] = {name: [] for name in places}
    for first, last in _blocks(light):
        rows = {name: mine[(first <= mine) & (mine < last)] - first for name, mine in places.items()}
        if not any(map(len, rows.values())):
            continue
        block = {key: light[key].isel(case=slice(first, last)).to_numpy() for key in _SERIES}
        for name, mine in rows.items():
            if len(mine) and not present:
                parts[name].append(_of_summary(block, mine))
            elif len(mine):
                every = -(-present[name].sum() * len(places[name]) // _INSTANTS)
                parts[name].append(_per_case(block, mine, present[name], every))
    return [_population(light.isel(case=places[name]), name, parts[name]) for name in places]


def _blocks(light: xr.Dataset) -> Iterator[tuple[int, int]]:
    """Yield the first case and the case after the last of blocks of whole chunks."""
    cases = light.sizes["case"]
    chunk = max(1, *light.chunks.get("case", (cases,)))
    each = sum(light[key].nbytes for key in _SERIES) / max(1, cases)
    rows = chunk * max(1, int(_BLOCK_BYTES / max(1.0, each * chunk)))
    for first in range(0, cases, rows):
        yield first, min(first + rows, cases)


def _per_case(
    block: dict[str, Array], rows: NDArray[np.int64], present: NDArray[np.bool_], every: int
) -> dict[str, Array]:
    """Return what is kept of some cases: numbers per case and field, and every n-th Strehl ratio."""
    values = {key: series[rows][:, present] for key, series in block.items()}
    return {
        **{key: case_rms(values[key]) for key in ("wfe_rms", "wfe_change", "spot_rms", "wfe_rms_raw")},
        "los_mean": values["los_mm"].mean(axis=1),
        "los_variance": values["los_mm"].var(axis=1),
        "strehl": values["strehl"][:, ::every].reshape(-1, values["strehl"].shape[2]),
        "worst": values["wfe_change"].max(axis=(1, 2)),
    }


def _of_summary(block: dict[str, Array], rows: NDArray[np.int64]) -> dict[str, Array]:
    """Return the same of statistics (case, statistic, field); of the line of sight about rest."""
    mean, rms, largest = (
        {key: series[rows, STATISTICS.index(name)] for key, series in block.items()}
        for name in ("mean", "rms", "max")
    )
    squares = np.repeat(rms["los_mm"][..., None] ** 2 / 2.0, 2, axis=-1)  # of both axes together
    return {
        **{key: rms[key] for key in ("wfe_rms", "wfe_change", "spot_rms", "wfe_rms_raw")},
        "los_mean": np.zeros_like(squares),
        "los_variance": squares,
        "strehl": mean["strehl"],
        "worst": largest["wfe_change"].max(axis=1),
    }


def _population(light: xr.Dataset, name: str, parts: Sequence[dict[str, Array]]) -> SystemPopulation:
    cases = light["case"].to_numpy()
    if not len(cases):
        return SystemPopulation(name, cases, (), None)
    values = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    sets = light["replicate"].to_numpy() if "replicate" in light.coords else None
    vignetted, lost, marechal = (light[name].to_numpy() for name in ("vignetted", "lost", "marechal"))
    fields = tuple(
        FieldResult(
            field=str(label),
            wfe=values["wfe_rms"][:, index],
            change=values["wfe_change"][:, index],
            spot=values["spot_rms"][:, index],
            strehl_p50=float(np.median(values["strehl"][:, index])),
            marechal=float(marechal[:, index].mean()),
            los=jitter_of_cases(
                values["los_mean"][:, index] * 1e3, values["los_variance"][:, index] * 1e6, sets
            ),
            vignetted=int(vignetted[:, index].max()),
            raw=values["wfe_rms_raw"][:, index],
            lost=int(lost[:, index].max()),
            sets=sets,
        )
        for index, label in enumerate(light["field"].to_numpy())
    )
    return SystemPopulation(name, cases, fields, int(cases[np.argmax(values["worst"])]))


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
)
_WHOLE = tuple(name for name in _HEADERS if name not in ("arrived WFE P50 (nm)", "lost"))


def _row(population: SystemPopulation, one: FieldResult, bench: SystemBench) -> dict[str, tuple[str, str]]:
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
    )
    return dict(zip(_HEADERS, values, strict=True))


def _headers(found: Sequence[SystemPopulation]) -> tuple[str, ...]:
    """Return the columns of the table: two more where rays do not arrive."""
    return _HEADERS if _incomplete(found) else _WHOLE


def _incomplete(found: Sequence[SystemPopulation]) -> bool:
    """Return whether rays are missing anywhere, so that fits over the full pupil are none of the light."""
    return any(one.lost for population in found for one in population.fields)


def _error(found: Sequence[SystemPopulation]) -> tuple[str, str]:
    """Return which error of a `FieldResult` figures show, and its words."""
    return ("raw", "arrived WFE rms") if _incomplete(found) else ("wfe", "WFE rms")


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


def _quantile(found: Quantile) -> tuple[str, str]:
    return number(found.value), interval(found)


def answer(found: Sequence[SystemPopulation]) -> str:
    """Say which disturbance changes the wavefront most, and where; where light is missing, what it leaves."""
    results = [(population.name, one) for population in found for one in population.fields]
    if not results:
        return "No case is done yet."
    if _incomplete(found):
        name, one = max(results, key=lambda result: quantile(result[1].raw, 0.95).value)
        return (
            f"Rays are missing at some instants. Of the light that arrives, {name} has the largest wavefront "
            f"error: in 95 % of its cases at most {number(quantile(one.raw, 0.95).value)} nm rms at field "
            f"{one.field}, where the median Strehl ratio is {number(one.strehl_p50)}."
        )
    name, one = max(results, key=lambda result: quantile(result[1].change, 0.95).value)
    value = number(quantile(one.change, 0.95).value)
    return (
        f"{name} changes the wavefront most: in 95 % of its cases by at most {value} nm rms at field "
        f"{one.field}, where the line of sight moves by {number(one.los.radial)} µm rms."
    )


def _worst_fields(found: Sequence[SystemPopulation]) -> dict[str, Array]:
    """Return the rms of each case at the field point whose median is largest, by disturbance."""
    which, _ = _error(found)
    return {
        one.name: max((getattr(field, which) for field in one.fields), key=lambda wfe: float(np.median(wfe)))
        for one in found
        if one.fields
    }


def _figures(
    bench: SystemBench, population: SystemPopulation, error: tuple[str, str], dataset: xr.Dataset, device: str
) -> Iterator[Picture]:
    if population.worst is None:
        return
    name, (which, label) = population.name, error
    errors = [getattr(one, which) for one in population.fields]
    fields = [one.field for one in population.fields]
    sets = {one.field: one.sets for one in population.fields}
    figure = draw_figures.distributions(dict(zip(fields, errors, strict=True)), f"{label} (nm)", sets)
    yield picture(f"{name}-wfe", f"Distribution of the wavefront error by field, {name}", figure)
    points = np.stack([dataset["field_x"].to_numpy(), dataset["field_y"].to_numpy()], axis=1)
    medians = np.median(errors, axis=1)
    unit = str(dataset["field_x"].attrs["units"])
    yield picture(
        f"{name}-field",
        f"Wavefront error over the field, {name}",
        draw_figures.field_map(points, medians, unit, f"{label}, median of the cases (nm)"),
    )
    yield picture(f"{name}-spots", f"Spot diagrams, {name}", _spots(bench, population.worst, device))


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
