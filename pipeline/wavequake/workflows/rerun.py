"""Compute cases of a store again: those that failed, once the cause is gone."""

from collections.abc import Callable
from collections.abc import Set as AbstractSet
from pathlib import Path

import numpy as np

from wavequake.errors import StoreDamageError, UserError
from wavequake.workflows.arrays import array_of, open_group
from wavequake.workflows.contract import DONE, RAISED, STATUS_MEANINGS, Workflow
from wavequake.workflows.engine import CampaignSummary, run_campaign
from wavequake.workflows.journal import Chunk, digest, read_journal
from wavequake.workflows.store import DATA, JOURNAL, Manifest, done_records, read_manifest


def statuses(text: str) -> frozenset[int]:
    """Return the status codes of a list such as "raised,crashed" or "2,3".

    Raises
    ------
    UserError
        If an entry is no status of a quarantined case.
    """
    codes = {name: code for code, name in enumerate(STATUS_MEANINGS.split()) if code >= RAISED}
    codes |= {str(code): code for code in codes.values()}
    entries = [entry.strip() for entry in text.split(",")]
    for entry in entries:
        if entry not in codes:
            raise UserError(f"{entry!r} is no status of a failed case; use some of {', '.join(codes)}.")
    return frozenset(codes[entry] for entry in entries)


def retry_store(
    workflow: Workflow,
    path: Path | str,
    wanted: AbstractSet[int],
    *,
    on: str = "local",
    workers: int | None = None,
    progress: Callable[[int, int, int], None] | None = None,
) -> CampaignSummary:
    """Compute the chunks of a store that hold cases of the statuses `wanted` again.

    Raises
    ------
    UserError
        If there is no store at `path`, or it is in use or cannot be written.
    StoreDamageError
        If a case of these chunks that was done comes out with other numbers.
    """
    path = Path(path)
    manifest = read_manifest(path)
    records = done_records(manifest, read_journal(path / JOURNAL))
    chunks = {
        chunk
        for chunk, record in records.items()
        if any(code in wanted for code, _ in record.failures.values())
    }
    rows = {chunk: _done_rows(path, chunk, set(records[chunk].failures)) for chunk in chunks}
    measured = {name for name, one in workflow.template(manifest.study).per_case.items() if one.measured}
    before = {chunk: _digests(path, manifest, rows[chunk]) for chunk in chunks}
    summary = run_campaign(
        workflow,
        manifest.study,
        path,
        cases=manifest.cases,
        chunk=manifest.chunk,
        device=manifest.device,
        on=on,
        workers=workers,
        progress=progress,
        recompute=chunks,
    )
    for chunk in sorted(chunks):
        after = _digests(path, manifest, rows[chunk])
        differing = sorted(
            name for name in after if name not in measured and after[name] != before[chunk][name]
        )
        if differing:
            raise StoreDamageError(
                f"cases {chunk[0]} to {chunk[1] - 1} were computed again, and {', '.join(differing)} of "
                "cases that were done differ: machines or versions disagree, so begin a new store."
            )
    return summary


def _done_rows(path: Path, chunk: Chunk, failed: set[int]) -> list[int]:
    status = np.asarray(array_of(open_group(path / DATA, read_only=True), "status")[slice(*chunk)])
    return [case for case in range(*chunk) if case not in failed and status[case - chunk[0]] == DONE]


def _digests(path: Path, manifest: Manifest, cases: list[int]) -> dict[str, str]:
    """Return the digest of every array over some cases, all of one chunk."""
    if not cases:
        return {}
    group, first = open_group(path / DATA, read_only=True), cases[0]
    rows = [case - first for case in cases]
    return {
        name: digest(np.asarray(array_of(group, name)[first : cases[-1] + 1])[rows])
        for name in manifest.variables
    }
