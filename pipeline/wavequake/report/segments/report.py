"""The report of a segment-disturbance store: its table, and its most telling cases recomputed in full."""

from pathlib import Path

import numpy as np
import xarray as xr
from rich.table import Table

from wavequake.campaign.store.store import read_manifest
from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.tiles import from_tiles
from wavequake.mechanics.disturbances.registry import analytic_rms
from wavequake.optics.segments.prepared import trace_states
from wavequake.report.histories import what_is_kept
from wavequake.report.populations import Summary, populations, representatives, summarize
from wavequake.report.segments.detail import Detail
from wavequake.report.segments.vignetting import stopped_light
from wavequake.report.table import terminal_table
from wavequake.workflows.segments.bench import MAS_PER_RAD, bench_of
from wavequake.workflows.segments.segment_disturbance import draw, surface_states

_MOST_INSTANTS = 2_000_000  # of all cases: the report of every instant takes some 0.3 GB then


def is_reduced(dataset: xr.Dataset) -> bool:
    """Return whether a store has no images or no instants, or too many instants to be in memory together."""
    series = dataset["wfe_rms"]
    return "exposure" not in dataset or "time" not in series.dims or series.size > _MOST_INSTANTS


def table_of(store: Path, dataset: xr.Dataset) -> Table:
    """Return the table of a store for the terminal."""
    if is_reduced(dataset):
        from wavequake.report.segments import reduced  # what draws is slow to load

        return reduced.table_of(store, dataset)
    table = terminal_table(_summaries(dataset, _analytic(store)))
    light = stopped_light(store, dataset)
    table.caption = f"{light} {table.caption}{what_is_kept(dataset)}".lstrip()
    return table


def write_report_of(store: Path, dataset: xr.Dataset, target: Path, device: str) -> Path:
    """Write the HTML report.

    The worst case of every disturbance is recomputed in full for the maps; its numbers are those of the
    store, bit for bit, if the device that computed them is at hand.
    """
    from wavequake.report.answers import budget
    from wavequake.report.segments import reduced
    from wavequake.report.segments.page import write_report

    if is_reduced(dataset):
        return reduced.write_report_of(store, dataset, target, device)
    study = read_manifest(store).study
    worst = [case for _, case in representatives(dataset).values()]
    details = [detail(study, case, device, dataset) for case in worst]
    light = stopped_light(store, dataset)
    return write_report(dataset, details, target, _analytic(store), budget.pictures(store), light)


def detail(study_text: str, case: int, device_name: str, dataset: xr.Dataset) -> Detail:
    """Recompute one case of a store with the OPD of every ray, for its maps."""
    bench = bench_of(study_text)
    drawn = draw(bench, case)
    instants = len(drawn.time)
    states = surface_states(bench, drawn, 0, instants)
    traced = trace_states(bench.prepared, states, choose_device(device_name))
    opd, x, y = (from_tiles(values)[:instants] for values in (traced.opd, traced.x, traced.y))
    to_mas = MAS_PER_RAD / bench.first_order.focal_length
    segments, rays = bench.system.segments, bench.prepared.rays
    images = "exposure" in dataset
    return Detail(
        case=case,
        disturbance=drawn.population.name,
        segment_names=segments.names,
        corners=segments.corners,
        centers=segments.centers[:, :2],
        time_s=drawn.time,
        segment_motion=drawn.motion.segment_motion,
        ray_x=rays.x,
        ray_y=rays.y,
        ray_segment=rays.segment,
        opd=opd * 1e6,
        spot=(np.stack([x, y], axis=-1) - bench.static.chief[0]) * to_mas,
        airy_mas=1.22 * bench.prepared.wavelength / (2.0 * bench.system.pupil_outer) * MAS_PER_RAD,
        image=dataset["exposure"].sel(case=case).to_numpy() if images else np.zeros((0, 0)),
        image_x=dataset["x"].to_numpy() if images else np.zeros(0),
        image_y=dataset["y"].to_numpy() if images else np.zeros(0),
    )


def _summaries(dataset: xr.Dataset, analytic: dict[str, tuple[float, str]]) -> list[Summary]:
    return [summarize(population, analytic.get(population.name)) for population in populations(dataset)]


def _analytic(store: Path) -> dict[str, tuple[float, str]]:
    """Return the rms, and its unit, of every disturbance that has one by its parameters alone."""
    bench = bench_of(read_manifest(store).study)
    values = {entry.name: analytic_rms(entry, bench.layout) for entry in bench.study.disturbance}
    return {name: value for name, value in values.items() if value is not None}
