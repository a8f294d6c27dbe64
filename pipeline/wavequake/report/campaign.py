"""The report of a store: its table, and the HTML file with its most telling cases recomputed in full."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import xarray as xr
from rich.table import Table

from wavequake.errors import StoreDamageError, UserError
from wavequake.kernels.devices import choose_device
from wavequake.kernels.tiles import from_tiles
from wavequake.mechanics.disturbances import analytic_rms
from wavequake.optics.prepared import trace_states
from wavequake.report.detail import Detail
from wavequake.report.export import export, target_of
from wavequake.report.html import write_report
from wavequake.report.populations import Summary, populations, representatives, summarize
from wavequake.report.table import terminal_table
from wavequake.workflows.bench import MAS_PER_RAD, bench_of
from wavequake.workflows.segment_disturbance import draw, surface_states
from wavequake.workflows.store import JOURNAL, REPORT, Manifest, open_store, read_manifest
from wavequake.workflows.verify import verify_store


def report_path(store: Path) -> Path:
    """Return where the report of a store is."""
    return Path(store) / REPORT


def is_current(store: Path) -> bool:
    """Return whether the report was written after everything that the journal records."""
    journal = [file.stat().st_mtime_ns for file in (Path(store) / JOURNAL).glob("*.jsonl")]
    path = report_path(store)
    return path.exists() and path.stat().st_mtime_ns >= max(journal, default=0)


@contextmanager
def _damage_named(store: Path) -> Iterator[None]:
    """Where the numbers of a store cannot be read, check it and raise StoreDamageError with the damage."""
    try:
        yield
    except (ValueError, UserError):
        for damage in verify_store(store).damaged:
            raise StoreDamageError(f"{damage}; wavequake verify lists all that is damaged.") from None
        raise


def summary_table(store: Path) -> Table:
    """Return the table of a store for the terminal; raises as :func:`report_store`."""
    with _damage_named(store):
        return terminal_table(_summaries(open_store(store), _analytic(store)))


def report_store(store: Path) -> tuple[Table, Path]:
    """Write the HTML report of a store and return its table and the file.

    The worst case of every disturbance is recomputed in full for the maps; its numbers are those of the
    store, bit for bit, if the device that computed them is at hand.

    Raises
    ------
    UserError
        If there is no store at `store`.
    StoreDamageError
        If its numbers cannot be read; names the first array that is damaged.
    """
    dataset, manifest = open_store(store), read_manifest(store)
    device = _device_at_hand(manifest)
    with _damage_named(store):
        analytic = _analytic(store)
        worst = [case for _, case in representatives(dataset).values()]
        details = [detail(manifest.study, case, device, dataset) for case in worst]
        path = write_report(dataset, details, report_path(store), analytic)
        return terminal_table(_summaries(dataset, analytic)), path


def export_store(store: Path, path: Path, overwrite: bool = False) -> Path:
    """Export a store to a .nc or .csv file; raises as :func:`report_store` and :func:`export`."""
    dataset, target = open_store(store), target_of(path, overwrite)
    with _damage_named(store):
        return export(dataset, target, overwrite)


def _device_at_hand(manifest: Manifest) -> str:
    """Return the store's own device, or where that is missing one of its kind, or NumPy."""
    for request in (manifest.device, manifest.device_kind):
        with suppress(UserError):
            return choose_device(request).name
    return "numpy"


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
        image=dataset["exposure"].sel(case=case).to_numpy(),
        image_x=dataset["x"].to_numpy(),
        image_y=dataset["y"].to_numpy(),
    )


def _summaries(dataset: xr.Dataset, analytic: dict[str, tuple[float, str]]) -> list[Summary]:
    return [summarize(population, analytic.get(population.name)) for population in populations(dataset)]


def _analytic(store: Path) -> dict[str, tuple[float, str]]:
    """Return the rms, and its unit, of every disturbance that has one by its parameters alone."""
    bench = bench_of(read_manifest(store).study)
    values = {entry.name: analytic_rms(entry, bench.layout) for entry in bench.study.disturbance}
    return {name: value for name, value in values.items() if value is not None}
