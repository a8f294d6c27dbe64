"""The report of a store, by the workflow that filled it: a table for the terminal and an HTML file."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType

from rich.table import Table

from wavequake.campaign.store.store import JOURNAL, REPORT, Manifest, open_store, read_manifest
from wavequake.campaign.store.verify import verify_store
from wavequake.errors import StoreDamageError, UserError
from wavequake.kernels.device.devices import choose_device
from wavequake.report.exports.store import export, target_of

# Modules with table_of(store, dataset) and write_report_of(store, dataset, target, device), imported when a
# store asks for them. Other kinds have the plain report, which is made of their measures.
_REPORTS = {
    "segment-disturbance": "segments.report",
    "mirror-mor": "mirrors.report",
    "segment-mor": "segments.variants",
    "mirror-trace": "mirrors.traces",
    "system-disturbance": "systems.report",
    "telescope-exposure": "exposures.report",
    "mirror-exposure": "mirrors.exposures",
    "lens-experiment": "lens.report",
    "lens-passive": "lens.passive",
    "sweep": "sweeps",
    "controller-mor": "loops.controllers",
    "tip-tilt-vibration": "loops.tip_tilt",
}


def _report_of(workflow: str) -> ModuleType:
    return import_module(f"wavequake.report.{_REPORTS.get(workflow, 'plain')}")


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
    dataset, workflow = open_store(store), read_manifest(store).workflow
    with _damage_named(store):
        table: Table = _report_of(workflow).table_of(store, dataset)
        return table


def report_store(store: Path) -> tuple[Table, Path]:
    """Write the HTML report of a store and return its table and the file.

    Raises
    ------
    UserError
        If there is no store at `store`.
    StoreDamageError
        If its numbers cannot be read; names the first array that is damaged.
    """
    dataset, manifest = open_store(store), read_manifest(store)
    report = _report_of(manifest.workflow)
    with _damage_named(store):
        path = report.write_report_of(store, dataset, report_path(store), device_at_hand(manifest))
        return report.table_of(store, dataset), path


def export_store(store: Path, path: Path, overwrite: bool = False) -> Path:
    """Export a store to a .nc or .csv file; raises as :func:`report_store` and :func:`export`."""
    dataset, target = open_store(store), target_of(path, overwrite)
    with _damage_named(store):
        return export(dataset, target, overwrite)


def device_at_hand(manifest: Manifest) -> str:
    """Return the store's own device, or where that is missing one of its kind, or NumPy."""
    for request in (manifest.device, manifest.device_kind):
        with suppress(UserError):
            return choose_device(request).name
    return "numpy"
