"""Compute cases of a store again: those that failed, once the cause is gone."""

from collections.abc import Callable
from collections.abc import Set as AbstractSet
from pathlib import Path

from wavequake.campaign.contract import RAISED, STATUS_MEANINGS, StudyKind
from wavequake.campaign.engine.driver import CampaignSummary, run_campaign
from wavequake.campaign.store.journal import read_journal
from wavequake.campaign.store.objects import location
from wavequake.campaign.store.store import JOURNAL, done_records, read_manifest
from wavequake.errors import UserError


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
    workflow: StudyKind,
    path: Path | str,
    wanted: AbstractSet[int],
    *,
    on: str = "local",
    workers: int | None = None,
    progress: Callable[[int, int, int], None] | None = None,
    timeout_s: float | None = None,
    cluster: Path | None = None,
    dashboard: Callable[[str], None] | None = None,
) -> CampaignSummary:
    """Compute the chunks of a store that hold cases of the statuses `wanted` again, and nothing else.

    Other versions of the code may do so: cases that were done must come out with the same bits. Further
    arguments are those of :func:`wavequake.campaign.engine.driver.run_campaign`.

    Raises
    ------
    UserError
        If there is no store at `path`, or it is in use or cannot be written.
    StoreDamageError
        If a case of these chunks that was done comes out with other numbers; then it keeps the old ones.
    """
    path = location(path)
    manifest = read_manifest(path)
    records = done_records(manifest, read_journal(path / JOURNAL))
    chunks = {
        chunk
        for chunk, record in records.items()
        if any(code in wanted for code, _ in record.failures.values())
    }
    return run_campaign(
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
        retry=True,
        timeout_s=timeout_s,
        cluster=cluster,
        dashboard=dashboard,
        allow_mixed=True,  # the cause may have been in the code, and what is done keeps its bits
    )
