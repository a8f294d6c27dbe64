"""Run a campaign: compute the chunks of a store that its journal does not list, on one process or many.

Dask's scheduler does all scheduling, and its state is disposable: tasks carry a path and two numbers, results
are a few scalars, and after any crash the next run computes the plan minus the journal.
"""

import time
from collections.abc import Callable
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import Path

from wavequake import __version__
from wavequake.campaign import provenance
from wavequake.campaign.contract import StudyKind
from wavequake.campaign.engine.driver_lock import Shard, driver_lock, others_at_work, this_process
from wavequake.campaign.engine.plan import pieces_of, todo_of
from wavequake.campaign.engine.runlog import run_log
from wavequake.campaign.engine.tally import Progress, Tally
from wavequake.campaign.store import fence, layout, store
from wavequake.campaign.store import manifest as manifests
from wavequake.campaign.store.journal import Chunk, read_journal, scan_journal
from wavequake.campaign.store.objects import ObjectPath, guarded, location
from wavequake.campaign.store.store import Manifest
from wavequake.cluster.local import leave_if_imported_by_a_worker, prepare_workers
from wavequake.cluster.places import elsewhere, place_of
from wavequake.errors import StoreDamageError, UserError
from wavequake.kernels.device.devices import choose_device

# What workers run: a store that is complete needs none of it, nor what it loads.
_TASKS = "wavequake.campaign.engine.chunks"


@dataclass(frozen=True)
class CampaignSummary:
    """What a run did: cases done before, computed now, quarantined in all, chunks computed, times in s.

    ``goal`` says in words how well what `campaign.until` asks for is known, ``rechecked``
    what came of computing chunks again, and ``again`` how many cases were computed that an earlier run had
    done: those of a chunk that was not full.
    """

    done_before: int
    computed: int
    quarantined: int
    chunks: int
    seconds: float
    compute_seconds: float
    write_seconds: float
    goal: tuple[str, ...] = ()
    rechecked: tuple[str, ...] = ()
    again: int = 0

    def followed_by(self, later: "CampaignSummary") -> "CampaignSummary":
        """Return what both runs did together."""
        return CampaignSummary(
            self.done_before,
            self.computed + later.computed,
            later.quarantined,
            self.chunks + later.chunks,
            self.seconds + later.seconds,
            self.compute_seconds + later.compute_seconds,
            self.write_seconds + later.write_seconds,
            rechecked=later.rechecked,
            again=self.again + later.again,
        )


def begin_workers(workflow: StudyKind, path: Path, on: str) -> None:
    """Have workers of this machine load, if there is no store at `path` yet; do not wait for that."""
    if on == "local" and not (path / store.MANIFEST).exists():
        _have_workers_load(workflow, path)


def _have_workers_load(workflow: StudyKind, path: Path) -> None:
    """Load what workers run once, in the process that they are forked from."""
    prepare_workers(_TASKS, workflow.compute.__module__, *(["s3fs"] * isinstance(path, ObjectPath)))


def finished(workflow: StudyKind, study: str, path: Path, cases: int, device: str) -> CampaignSummary | None:
    """Return the summary of a run that finds nothing to do; None where a run shall look more closely.

    That is where this version made a store of the study, with the device that is asked for if it is asked for
    by name, every chunk is recorded, and no file of it is missing. Then nothing is written, no device used,
    and the study not checked again: it has succeeded.
    """
    start = time.perf_counter()
    if not (path / store.MANIFEST).exists():
        return None
    manifest = store.read_manifest(path)
    ours = (manifest.workflow, manifest.study) == (workflow.name, study) and cases <= manifest.cases
    made_here = manifest.provenance.get("wavequake") == __version__ and device in ("auto", manifest.device)
    if not (ours and made_here) or layout.lost_layout(path, manifest):
        return None
    records = store.done_records(manifest, read_journal(path / store.JOURNAL))
    wanted = pieces_of(manifest.plan(), cases, manifest.chunk, None)
    if todo_of(wanted, records, layout.lost_chunks(path, manifest, records)):
        return None
    done, lost = sum(last - first for first, last in wanted), sum(records[one].quarantined for one in wanted)
    return CampaignSummary(done, 0, lost, 0, time.perf_counter() - start, 0.0, 0.0)


def run_campaign(
    workflow: StudyKind,
    study: str,
    path: Path | str,
    *,
    cases: int,
    chunk: int,
    device: str,
    on: str = "local",
    workers: int | None = None,
    progress: Progress | None = None,
    recompute: AbstractSet[Chunk] = frozenset(),
    retry: bool = False,
    title: str = "",
    timeout_s: float | None = None,
    allow_mixed: bool = False,
    repair: bool = False,
    dashboard: Callable[[str], None] | None = None,
    shard: Shard | None = None,
    cluster: Path | None = None,
    recheck: float = 0.0,
) -> CampaignSummary:
    """Compute what the store at `path` lacks of `cases` cases; the store is made or extended if need be.

    Parameters
    ----------
    workflow, study
        What to compute; `study` is the canonical JSON text that identifies the study.
    path : Path or str
        Folder of the store.
    cases, chunk : int
        Number of cases wanted, and of cases per chunk if the store is new.
    device : str
        The device that runs the kernels.
    on : str
        "serial" (in this process), "local" (worker processes), "slurm", "ssh", "kubernetes", or
        "tcp://HOST:PORT" or "tls://HOST:PORT" (a Dask scheduler).
    workers : int, optional
        Number of worker processes of "local" and "slurm"; by default one per CPU, and one on a GPU.
    progress : callable, optional
        Called with the numbers of cases done, wanted and quarantined, at first and after every chunk.
    recompute : set of (int, int)
        Chunks to compute again although they are done.
    retry : bool
        Compute the chunks of `recompute` only, and change no case of them that is done.
    title : str
        Of the study, which is no part of its identity; a new store keeps it.
    timeout_s : float, optional
        Longest time that a chunk, or a case tried alone, may take; by default 20 times the median chunk's, at
        least half an hour. A case that exceeds it is quarantined.
    allow_mixed : bool
        Go on with a store that other versions of the code began; the journal keeps what computed each chunk.
    repair : bool
        Read the whole store first; put back metadata and labels, and compute chunks again, that are damaged.
    dashboard : callable, optional
        Start Dask's dashboard and call this with its link.
    shard : Shard, optional
        Compute the chunks of this shard only, while other processes, perhaps on other machines, compute the
        others. All give the same number of cases.
    cluster : Path, optional
        A cluster file, which says what to ask Slurm for, the hosts of ssh, or the certificates of TLS.
    recheck : float
        Share of the chunks that is computed again by other workers and compared bit by bit; a process that
        computes wrong is named, and its chunks are computed again by the others.

    Raises
    ------
    UserError
        If the store belongs to another study, kind of device or version, is in use or cannot be written, or
        `on` is unknown.
    StoreDamageError
        If two runs of a chunk gave different numbers, or `retry` would change a case that is done.
    KeyboardInterrupt
        On Ctrl-C, with all workers gone; finished chunks stay, and the next run continues.
    """
    leave_if_imported_by_a_worker()
    start, path = time.perf_counter(), location(path).absolute()
    place = place_of(on, cluster)
    kind = choose_device(device).kind
    with driver_lock(path, shard) as (own, setup):
        others = others_at_work(path, shard, own)
        _refuse_growth(path, cases, others)
        with store.write_errors_explained(path):
            run = fence.begin(path, str(shard or ""), others, _latest_epoch(path))
        token = run.runs[str(shard or "")]
        with guarded(path, lambda: fence.admit(path, token)):
            manifest = _prepared(workflow, study, path, cases, chunk, device, kind, title, repair, not others)
        if not others:
            _sweep(path)
        setup.close()
        ours = pieces_of(manifest.plan(), cases, manifest.chunk, shard)
        wanted = [p for p in ours if p in recompute or not retry]
        journal = (scan_journal if repair else read_journal)(path / store.JOURNAL)
        if repair:
            from wavequake.campaign.store import verify

            recompute = recompute | verify.examined(path, manifest, journal).chunks
        records = store.done_records(manifest, journal)
        todo = todo_of(wanted, records, recompute | layout.lost_chunks(path, manifest, records))
        tally = Tally(wanted, {p: records[p] for p in wanted if p not in todo}, progress)
        done_before, chunks = tally.done, len(todo)
        full = dict(todo)
        again = sum(last - first for first, last in journal.records if last < full.get(first, last))
        told: tuple[str, ...] = ()
        if todo or recheck:
            if on == "local":
                _have_workers_load(workflow, path)
            from wavequake.campaign.engine.chunks import Job
            from wavequake.campaign.engine.compute import compute
            from wavequake.campaign.engine.recheck import Check

            if not allow_mixed:
                manifests.refuse_mixed(path, manifest, provenance.code())
            code = provenance.code() if elsewhere(on) and not allow_mixed else ""
            settled = frozenset(first for first, _ in journal.contested)
            job = Job(workflow, str(path), device, token, code, retry, run.epoch, settled, str(shard or ""))
            with run_log(path / store.LOG) as tally.log:
                tally.log.info("%s on %s; on=%s, device %s", provenance.code(), this_process(), on, device)
                tally.log.info("%d cases wanted, %d done before", tally.total, tally.done)
                processes = workers or (1 if (on, kind) == ("local", "gpu") else None)
                check = Check(path, manifest, wanted, recheck)
                told = compute(job, todo, place, processes, tally, timeout_s, dashboard, check)
        records = store.done_records(manifest, read_journal(path / store.JOURNAL))
        lacking = todo_of(wanted, records, frozenset())
    if lacking:
        raise StoreDamageError(
            f"the journal of {path} lacks {len(lacking)} chunks that were computed, first {lacking[0]}: run "
            "the same command again"
        )
    return CampaignSummary(
        done_before,
        tally.done - done_before,
        sum(records[piece].quarantined for piece in ours if piece in records),
        chunks,
        time.perf_counter() - start,
        tally.compute_s,
        tally.write_s,
        rechecked=told,
        again=again,
    )


def _latest_epoch(path: Path) -> int:
    """Return the latest epoch of any record, if the fence does not say it."""
    if fence.read_fence(path) is not None:
        return 0
    return max((record.epoch for record in scan_journal(path / store.JOURNAL).records.values()), default=0)


def _prepared(
    workflow: StudyKind,
    study: str,
    path: Path,
    cases: int,
    chunk: int,
    device: str,
    kind: str,
    title: str,
    repair: bool,
    alone: bool,
) -> Manifest:
    """Create the store, or check that it is ours and extend it.

    One that another version made, and in which nobody has computed anything, is made anew.
    """
    manifest = store.read_manifest(path) if (path / store.MANIFEST).exists() else None
    if manifest is None or (alone and _is_blank(path, manifest)):
        sources = {"study_title": title, **provenance.collect(choose_device(device))}
        return store.create_store(path, workflow, study, cases, chunk, device, sources)
    manifests.refuse_other(path, manifest, workflow.name, study, kind)
    layout.refuse_older(path, manifest, lambda _: workflow)
    if repair or layout.lost_layout(path, manifest):
        layout.mend_layout(path, manifest, workflow)
    return store.extend_store(path, workflow, cases)


def _is_blank(path: Path, manifest: Manifest) -> bool:
    """Return whether another version made a store, and no chunk of it was computed."""
    by_another = manifest.provenance.get("code", "") not in ("", provenance.code())
    return by_another and not any((path / store.JOURNAL).glob("*.jsonl"))


def _refuse_growth(path: Path, cases: int, others: list[str]) -> None:
    """Raise UserError if a store would be extended under the hands of those who compute other shards."""
    if others and (path / store.MANIFEST).exists() and (there := store.read_manifest(path).cases) < cases:
        raise UserError(
            f"{path} is being computed to {there} cases (shard {others[0]}): give all shards the same "
            "campaign.cases, or wait."
        )


def _sweep(path: Path) -> None:
    """Remove the unfinished files of writers that were killed; nobody else may be writing."""
    if isinstance(path, ObjectPath):
        return  # which has none
    for name in (path / store.DATA).rglob("*.partial"):
        name.unlink(missing_ok=True)
