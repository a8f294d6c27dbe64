"""The report of a store, by the workflow that filled it: a table for the terminal and an HTML file."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from rich.table import Table

from wavequake.campaign.statistics.blocks import few_at_once
from wavequake.campaign.store.layout import refuse_older
from wavequake.campaign.store.objects import ObjectPath, location
from wavequake.campaign.store.store import (
    ERRORS,
    open_for_report,
    open_store,
    read_manifest,
)
from wavequake.errors import StoreDamageError, UserError
from wavequake.report.at_hand import device_at_hand
from wavequake.report.exports.store import export, target_of
from wavequake.report.written import as_comment, report_path, seal
from wavequake.workflows.kinds import find_kind

if TYPE_CHECKING:
    import xarray as xr

# Modules with table_of(store, dataset) and page_of(store, dataset, device), imported when a
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
    "telescope-loop": "loops.telescope",
    "system-loop": "loops.telescope",
    "segment-control": "loops.segment_control",
}


def _report_of(workflow: str) -> ModuleType:
    return import_module(f"wavequake.report.{_REPORTS.get(workflow, 'plain')}")


def _opened(store: Path) -> "xr.Dataset":
    from wavequake.report.mirrors.names import name_models  # slow to load

    return name_models(open_for_report(store))


def load(workflow: str) -> None:
    """Import what the reports of a kind of study need, most of which is what draws."""
    from wavequake.drawing.unexplained import leave_help_out

    with suppress(ImportError):  # said where the report is written
        leave_help_out()
        _report_of(workflow)
        import_module("matplotlib.backends.backend_svg")
        import_module("wavequake.report.page")


@contextmanager
def _damage_named(store: Path) -> Iterator[None]:
    """Where the numbers of a store cannot be read, check it and raise StoreDamageError with the damage."""
    try:
        yield
    except (ValueError, UserError):
        from wavequake.campaign.store.verify import verify_store

        for damage in verify_store(store).damaged:
            raise StoreDamageError(f"{damage}; wavequake verify lists all that is damaged.") from None
        raise


@few_at_once()
def summary_table(store: Path) -> Table:
    """Return the table of a store for the terminal; raises as :func:`report_store`."""
    dataset, manifest = _opened(store), read_manifest(store)
    refuse_older(store, manifest, find_kind)
    with _damage_named(store):
        table: Table = _report_of(manifest.workflow).table_of(store, dataset)
        return table


@few_at_once()
def report_store(store: Path, target: Path | None = None) -> tuple[Table, Path]:
    """Write the HTML report of a store, by default into its folder, and return its table and the file.

    Raises
    ------
    UserError
        If there is no store at `store`, or one of another version that lacks numbers of this one; if the file
        is no .html or cannot be written.
    StoreDamageError
        If its numbers cannot be read; names the first array that is damaged.
    """
    if target is not None and target.suffix.lower() not in (".html", ".htm"):
        raise UserError(f"The report {target} must end in .html.")
    shows = seal(store)
    dataset, manifest = _opened(store), read_manifest(store)
    refuse_older(store, manifest, find_kind)
    report = _report_of(manifest.workflow)
    from wavequake.report.page import KNOWN_ERRORS, render_page, write_page  # what draws is slow to load

    if (location(store) / ERRORS).exists():
        from wavequake.report.answers.errors_shown import page_with_errors

        dataset.encoding[KNOWN_ERRORS] = lambda page: page_with_errors(store, page)
    with _damage_named(store):
        page = report.page_of(store, dataset, device_at_hand(manifest))
        path = write_page(render_page(dataset, page), target or report_path(store))
        table = report.table_of(store, dataset)
    with suppress(OSError):  # without it, the report is written again
        if isinstance(path, ObjectPath):
            path.write_bytes(path.read_bytes() + as_comment(table) + shows)
        else:
            with path.open("ab") as file:
                file.write(as_comment(table) + shows)
    return table, path


def export_store(
    store: Path,
    path: Path,
    overwrite: bool = False,
    case: int | None = None,
    instant: int = 0,
    under: str = "",
) -> tuple[Path, ...]:
    """Export a store to one file, or one case to lens files (.zmx) or displacements (.txt, several files).

    Raises as :func:`report_store` and what writes such a file; UserError, too, if no case is said of which a
    lens file or displacements are made, or one where all are written.
    """
    if path.suffix.lower() in (".zmx", ".txt"):
        from wavequake.report.exports.displacements import export_displacements
        from wavequake.report.exports.lens_file import export_case

        if case is None:
            raise UserError(f"A {path.suffix} file holds one case of the store; say --case ID, too.")
        if path.suffix.lower() == ".zmx":
            return export_case(store, path, case, instant, overwrite, under)
        return export_displacements(store, path, case, instant, overwrite, under)
    if case is not None:
        raise UserError(f"A {path.suffix} file holds all cases; --case belongs to .zmx and .txt.")
    dataset, target = open_store(store), target_of(path, overwrite)
    with _damage_named(store):
        return (export(dataset, target, overwrite),)
