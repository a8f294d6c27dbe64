"""Run a campaign: compute the chunks of a store that its journal does not list, on one process or many.

Dask's scheduler does all scheduling, and its state is disposable: tasks carry a path and two numbers, results
are a few scalars, and after any crash the next run computes the plan minus the journal.
"""

import fcntl
import os
import socket
import time
import uuid
from collections.abc import Callable, Iterator
from collections.abc import Set as AbstractSet
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from wavequake.cluster.address import connected
from wavequake.cluster.local import leave_if_imported_by_a_worker, local_cluster
from wavequake.errors import StoreDamageError, UserError
from wavequake.kernels.devices import choose_device
from wavequake.workflows import provenance, store, verify
from wavequake.workflows.chunks import Job, Outcome, compute_chunk
from wavequake.workflows.contract import Workflow
from wavequake.workflows.isolation import compute_isolated
from wavequake.workflows.journal import Chunk, read_journal
from wavequake.workflows.store import Manifest

if TYPE_CHECKING:
    from distributed import Client, Future

Progress = Callable[[int, int, int], None]


@dataclass(frozen=True)
class CampaignSummary:
    """What a run did: cases done before, computed now, quarantined in all, chunks computed, times in s."""

    done_before: int
    computed: int
    quarantined: int
    chunks: int
    seconds: float
    compute_seconds: float
    write_seconds: float


def run_campaign(
    workflow: Workflow,
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
    title: str = "",
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
        "serial" (in this process), "local" (worker processes) or "tcp://HOST:PORT" (a Dask scheduler).
    workers : int, optional
        Number of local worker processes; by default one per CPU, and one on a GPU.
    progress : callable, optional
        Called with the numbers of cases done, wanted and quarantined, at first and after every chunk.
    recompute : set of (int, int)
        Chunks to compute again although they are done (:attr:`VerifyReport.chunks`).
    title : str
        Of the study, which is no part of its identity; a new store keeps it.

    Raises
    ------
    UserError
        If the store belongs to another study or kind of device, is in use or cannot be written, or `on` is
        unknown.
    StoreDamageError
        If two runs of a chunk gave different numbers.
    KeyboardInterrupt
        On Ctrl-C, with all workers gone; finished chunks stay, and the next run continues.
    """
    if on != "serial":
        leave_if_imported_by_a_worker()
    start, path = time.perf_counter(), Path(path).absolute()
    if on not in ("serial", "local") and not on.startswith("tcp://"):
        raise UserError(
            f"on={on!r} is unknown; use serial, local or the tcp://HOST:PORT of a Dask scheduler."
        )
    kind = choose_device(device).kind
    with _locked(path):
        manifest = _prepared(workflow, study, path, cases, chunk, device, kind, title)
        wanted = [piece for piece in manifest.plan() if piece[0] < cases]
        records = store.done_records(manifest, read_journal(path / store.JOURNAL))
        again = recompute | verify.lost_chunks(path, manifest, records)
        todo = [piece for piece in wanted if piece not in records or piece in again]
        tally = _Tally(
            wanted, {p: records[p].quarantined for p in wanted if p in records and p not in again}, progress
        )
        done_before = tally.done
        if todo:
            _sweep(path)
            job = Job(workflow, str(path), device, uuid.uuid4().hex)
            if on == "serial":
                for piece in todo:
                    tally.add(compute_chunk(job, *piece))
            else:
                _run_on_dask(job, todo, on, workers or (1 if kind == "gpu" else None), tally)
        records = store.done_records(manifest, read_journal(path / store.JOURNAL))
        lacking = [piece for piece in wanted if piece not in records]
    if lacking:
        raise StoreDamageError(
            f"the journal of {path} lacks {len(lacking)} chunks that were computed, first {lacking[0]}"
        )
    return CampaignSummary(
        done_before,
        tally.done - done_before,
        sum(records[piece].quarantined for piece in wanted),
        len(todo),
        time.perf_counter() - start,
        tally.compute_s,
        tally.write_s,
    )


class _Tally:
    """Counts of a run, told to the caller's progress after each chunk."""

    def __init__(self, wanted: list[Chunk], before: dict[Chunk, int], progress: Progress | None) -> None:
        self.total = sum(last - first for first, last in wanted)
        self.done = sum(last - first for first, last in before)
        self.quarantined = sum(before.values())
        self.compute_s = self.write_s = 0.0
        self._progress = progress or (lambda done, total, quarantined: None)
        self._progress(self.done, self.total, self.quarantined)

    def add(self, outcome: Outcome) -> None:
        first, last = outcome.chunk
        self.done += last - first
        self.quarantined += outcome.quarantined
        self.compute_s += outcome.compute_s
        self.write_s += outcome.write_s
        self._progress(self.done, self.total, self.quarantined)


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a store, whose folder is made if need be, against other drivers; UserError if one is at work."""
    store.refuse_foreign(path)
    with store.write_errors_explained(path):
        path.mkdir(parents=True, exist_ok=True)
        file = (path / store.LOCK).open("a+", encoding="utf-8")
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read().strip() or "another process"
            raise UserError(
                f"{path} is in use by {holder}: wait for it, or choose another --store."
            ) from None
        with store.write_errors_explained(path):
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
            file.flush()
        yield


def _prepared(
    workflow: Workflow, study: str, path: Path, cases: int, chunk: int, device: str, kind: str, title: str
) -> Manifest:
    """Create the store, or check that it is ours and extend it."""
    if not (path / store.MANIFEST).exists():
        sources = {"study_title": title, **provenance.collect(choose_device(device))}
        return store.create_store(path, workflow, study, cases, chunk, device, sources)
    store.refuse_other(path, store.read_manifest(path), workflow.name, study, kind)
    return store.extend_store(path, workflow, cases)


def _sweep(path: Path) -> None:
    """Remove the unfinished files of writers that were killed; nobody writes while we hold the lock."""
    for name in (path / store.DATA).rglob("*.partial"):
        name.unlink(missing_ok=True)


def _run_on_dask(job: Job, todo: list[Chunk], on: str, workers: int | None, tally: _Tally) -> None:
    cluster = local_cluster(workers and min(workers, len(todo))) if on == "local" else connected(on)
    with cluster as client:
        suspects = _stream(client, job, todo, tally)
    for piece in suspects:
        tally.add(compute_isolated(job, *piece, 1800.0))


def _stream(client: "Client", job: Job, todo: list[Chunk], tally: _Tally) -> list[Chunk]:
    """Feed chunks to the workers, a window at a time, and return those that killed them."""
    from distributed import CancelledError, as_completed
    from distributed.scheduler import KilledWorker

    def submit(piece: Chunk) -> "Future":
        # Tuple keys with a common first part: the scheduler keeps the tasks in its queue, and does not assign
        # them to workers that may die with them.
        return client.submit(compute_chunk, job, *piece, key=(f"chunk-{job.run}", piece[0]), pure=False)

    waiting = iter(todo)
    window = max(32, 4 * sum(client.nthreads().values()))
    pieces = {future: piece for piece in islice(waiting, window) for future in [submit(piece)]}
    finished = as_completed(list(pieces), loop=client.loop)
    suspects: list[Chunk] = []
    for future in finished:
        piece = pieces.pop(future)
        try:
            tally.add(future.result())
        except KilledWorker:
            suspects.append(piece)
        except CancelledError:
            raise UserError(
                "The Dask scheduler went away; what is done is kept, so run the same command again."
            ) from None
        future.release()
        for more in islice(waiting, 1):
            new = submit(more)
            pieces[new] = more
            finished.add(new)
    return suspects
