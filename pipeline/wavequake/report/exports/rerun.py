"""One case of a store computed again in full detail: the same bits, and what the store does not keep."""

import faulthandler
import sys
from collections.abc import Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from traceback import format_exception

import numpy as np
import xarray as xr
from rich.table import Table
from threadpoolctl import threadpool_limits

from wavequake.campaign.contract import DONE, RAISED, STATUS_MEANINGS, TODO, ChunkResult, Template
from wavequake.campaign.engine.chunks import checked
from wavequake.campaign.store.journal import digest
from wavequake.campaign.store.layout import refuse_older
from wavequake.campaign.store.retention import kept_result, stored_template
from wavequake.campaign.store.store import open_store, read_manifest
from wavequake.errors import UserError
from wavequake.report.at_hand import device_at_hand
from wavequake.report.exports.store import export, target_of
from wavequake.report.segments.case_detail import detail_of
from wavequake.workflows.kinds import find_kind


@dataclass(frozen=True, repr=False)
class CaseRerun:
    """A case computed again.

    ``labels`` say what it is; ``numbers`` gives each variable's range, in words; ``differing`` names those
    whose bits are not those of the store; ``trouble`` is the traceback or the reason if it failed again;
    ``file`` has all numbers.
    """

    case: int
    labels: Mapping[str, str]
    stored_status: int
    status: int
    numbers: Mapping[str, str]
    differing: tuple[str, ...]
    trouble: str
    file: Path | None

    def __repr__(self) -> str:
        return "\n".join(self.lines())

    def table(self) -> Table:
        """Return labels and numbers for the terminal."""
        table = Table(box=None, show_header=False)
        for name, text in {**self.labels, **self.numbers}.items():
            table.add_row(name, text, "differs from the store" if name in self.differing else "")
        return table

    def lines(self) -> list[str]:
        """Return the verdict, and where the numbers are."""
        words = STATUS_MEANINGS.split()
        lines = [f"case {self.case}: {words[self.stored_status]} in the store, {words[self.status]} now"]
        if self.trouble:
            lines.append(self.trouble)
        if self.differing:
            lines.append(f"Not the bits of the store: {', '.join(self.differing)}.")
        elif self.status == self.stored_status == DONE:
            lines.append("Every number has the bits of the store.")
        return [*lines, *([f"Written: {self.file}"] if self.file else [])]


def rerun_stored(store: Path, case: int, file: Path | None = None) -> CaseRerun:
    """Compute a case of a store again from its study and id, and compare every number with the stored one.

    The numbers go to `file`, by default ``STORE/case-ID.nc``, over all instants also where the store keeps
    less, and with what no store keeps (`segments.case_detail.detail_of`). The store is not
    changed.

    Raises
    ------
    UserError
        If there is no store or no such case, or `file` cannot be written.
    """
    manifest = read_manifest(store)
    if case not in range(manifest.cases):
        raise UserError(f"{store} has cases 0 to {manifest.cases - 1}; there is no case {case}.")
    target = target_of(file or Path(store) / f"case-{case}.nc", overwrite=True)
    if target.suffix != ".nc":
        raise UserError(f"{target} must end in .nc.")
    stored = open_store(store).sel(case=[case]).load()
    device, workflow = device_at_hand(manifest), find_kind(manifest.workflow)
    refuse_older(store, manifest, lambda _: workflow)
    computed, template = workflow.template(manifest.study), stored_template(workflow, manifest.study)
    if sys.__stderr__:  # a case that crashed in the campaign will do so here, and say where
        faulthandler.enable(sys.__stderr__)
    status, trouble, result, detail = RAISED, "", None, xr.Dataset()
    try:
        with threadpool_limits(1):
            result = checked(workflow.compute(manifest.study, np.array([case]), device), computed, 1)
            status, trouble = int(result.status[0]), result.messages[0]
            with suppress(UserError) if status == RAISED else nullcontext():  # as far as it comes
                detail = detail_of(manifest, case, device)
    except Exception as error:
        trouble = "".join(format_exception(error)).rstrip()
    before = int(stored["status"].item())
    return CaseRerun(
        case,
        {str(name): str(values.item()) for name, values in stored.coords.items() if values.dims == ("case",)},
        before,
        status,
        _ranges(result, computed) if result else {},
        _differing(stored, kept_result(manifest.study, computed, result), template)
        if result and before != TODO
        else (),
        trouble,
        export(_merged(_dataset(stored, result, computed), detail), target, overwrite=True)
        if result
        else None,
    )


def _ranges(result: ChunkResult, template: Template) -> dict[str, str]:
    texts = {}
    for name, variable in template.per_case.items():
        values = np.asarray(result.arrays[name][0])
        unit = variable.attrs.get("units", "").replace("1", "")
        if values.dtype.kind not in "fiub" or not np.isfinite(values).any():
            continue
        least, most = np.nanmin(values), np.nanmax(values)
        texts[name] = f"{most:.6g} {unit}" if least == most else f"{least:.6g} to {most:.6g} {unit}"
    return texts


def _differing(stored: xr.Dataset, result: ChunkResult, template: Template) -> tuple[str, ...]:
    return tuple(
        name
        for name, variable in template.per_case.items()
        if not variable.measured and digest(stored[name].to_numpy()) != digest(result.arrays[name])
    )


def _dataset(stored: xr.Dataset, result: ChunkResult, computed: Template) -> xr.Dataset:
    """Return labels, numbers over all instants, and what does not depend on the case."""
    arrays = {
        name: xr.Variable(variable.dims, result.arrays[name][0], variable.attrs)
        for name, variable in computed.per_case.items()
    }
    fixed = {name: xr.Variable(dims, values, attrs) for name, (dims, values, attrs) in computed.fixed.items()}
    labels = {name: values.isel(case=0) for name, values in stored.coords.items() if values.dims == ("case",)}
    ends = {"status": result.status[0], "message": result.messages[0]}
    coordinates = [name for name, variable in computed.per_case.items() if variable.coordinate]
    return xr.Dataset({**fixed, **arrays, **ends}, labels, stored.attrs).set_coords(coordinates)


def _merged(numbers: xr.Dataset, detail: xr.Dataset) -> xr.Dataset:
    """Return both; of what the store keeps, too (motions of segments), the detail."""
    return numbers.drop_vars([name for name in detail.data_vars if name in numbers]).merge(detail)
