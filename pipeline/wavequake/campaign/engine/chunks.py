"""The task of the engine: compute the cases of one chunk, write them, record them.

It runs in a Dask worker, and its two halves in a serial driver; chunks that kill their workers or hang are
computed in :mod:`wavequake.campaign.engine.isolation`. Only a few scalars travel back; the numbers go to the
store.
"""

import errno
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np

from wavequake.campaign import provenance
from wavequake.campaign.contract import (
    DIVERGED,
    DONE,
    RAISED,
    ChunkResult,
    StudyKind,
    Template,
    unknown_arrays,
)
from wavequake.campaign.engine.commit import commit
from wavequake.campaign.stopwatch import CPU
from wavequake.campaign.store import fence, journal
from wavequake.campaign.store.arrays import Array, array_of, chunk_file, open_group, write_chunk
from wavequake.campaign.store.journal import Chunk, Record
from wavequake.campaign.store.objects import ObjectPath, location, versions
from wavequake.campaign.store.retention import kept_result, kept_template, retention_of
from wavequake.campaign.store.store import DATA, JOURNAL, Manifest, read_manifest, write_errors_explained
from wavequake.errors import StoreDamageError, UserError
from wavequake.kernels.device.launches import kernel_launches, launches_since
from wavequake.memory import keep_freed_memory
from wavequake.prepared import one_thread, prepared
from wavequake.words import printable, shortened


class BrokenWorkflowError(Exception):
    """A workflow does not keep its contract."""


# What ends a run: everything else that a case raises is quarantined with it.
FATAL = (UserError, BrokenWorkflowError)


# What a network's file system says when it is busy: the same call succeeds a little later.
_TRANSIENT = {
    getattr(errno, name)
    for name in ("EIO", "ESTALE", "EAGAIN", "EINTR", "EBUSY", "ETIMEDOUT", "EREMOTEIO", "ENOLCK", "ENFILE")
    if hasattr(errno, name)
}
_PAUSES_S = (0.1, 1.0, 5.0)

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Job:
    """What the chunks of a run share; it travels with every task and is small: functions go by reference.

    ``run`` is the token by which the store's fence admits its writers, ``epoch`` is that run's. Where
    ``code`` is not empty, a worker that runs other code refuses to compute. A ``guarded`` job changes no case
    that is done; records of the chunks that begin at ``settled`` cases stand against earlier ones.
    """

    workflow: StudyKind
    path: str
    device: str
    run: str
    code: str = ""
    guarded: bool = False
    epoch: int = 0
    settled: frozenset[int] = frozenset()
    shard: str = ""


@dataclass(frozen=True)
class Outcome:
    """What the driver learns of a finished chunk."""

    chunk: Chunk
    quarantined: int
    compute_s: float
    write_s: float


@dataclass(frozen=True)
class Opened:
    """An open store, what is computed of its cases, and what of that its chunks keep."""

    manifest: Manifest
    computed: Template
    template: Template
    arrays: Mapping[str, Array]


@prepared(maxsize=2)
def opened_store(workflow: StudyKind, path: str, run: str) -> Opened:
    """Open the store once per process and run; a later run may have extended it."""
    keep_freed_memory()
    manifest = patiently(lambda: read_manifest(path))
    group = patiently(lambda: open_group(location(path) / DATA))
    arrays = {name: array_of(group, name) for name in manifest.variables}
    computed = workflow.template(manifest.study)
    return Opened(manifest, computed, kept_template(retention_of(manifest.study), computed), arrays)


def patiently(action: Callable[[], Answer]) -> Answer:
    """Return what `action` returns; it is tried again after errors that pass, and can be done twice."""
    for pause in _PAUSES_S:
        try:
            return action()
        except OSError as error:
            if error.errno not in _TRANSIENT:
                raise
        time.sleep(pause)
    return action()


def compute_chunk(job: Job, first: int, last: int) -> Outcome:
    """Compute cases first <= id < last, write them to the store and then to its journal.

    Raises
    ------
    UserError
        If the workflow says that the study is impossible, the disk is full or cannot be written, or this
        worker runs other code than the driver.
    StoreDamageError
        If a guarded job would change a case that is done.
    """
    refuse_other_code(job)
    patiently(lambda: fence.admit(location(job.path), job.run))
    return store_chunk(job, (first, last), *computed_chunk(job, first, last))


def refuse_other_code(job: Job) -> None:
    """Raise UserError if this process runs other code than the driver, and must not."""
    if job.code and job.code != provenance.code():
        raise UserError(
            f"A worker computes with {provenance.code()}, the driver with {job.code}: install the same "
            "versions everywhere, or give --allow-mixed."
        )


def computed_chunk(job: Job, first: int, last: int) -> tuple[ChunkResult, float]:
    """Return the result of cases first <= id < last, and the seconds that it took.

    Cases are independent: where computing them together raises, each is tried alone, so that only the guilty
    ones are quarantined, with their message. Numbers do not depend on the number of threads: there is one.
    """
    opened = opened_store(job.workflow, job.path, job.run)
    start, busy, launches = time.perf_counter(), time.process_time(), kernel_launches()
    with one_thread():
        try:
            result = _computed(job, opened, first, last)
        except FATAL:
            raise
        except Exception:
            result = joined([computed_alone(job, opened, case) for case in range(first, last)])
    cpu = {f"{CPU}chunks": time.process_time() - busy}
    timings = {**result.timings, **cpu, **launches_since(launches)}
    return replace(result, timings=timings), time.perf_counter() - start


def _computed(job: Job, opened: Opened, first: int, last: int) -> ChunkResult:
    cases, study = np.arange(first, last, dtype=np.int64), opened.manifest.study
    result = checked(job.workflow.compute(study, cases, job.device), opened.computed, len(cases))
    return kept_result(study, opened.computed, result)


def computed_alone(job: Job, opened: Opened, case: int) -> ChunkResult:
    """Return the result of one case, quarantined if computing it raises."""
    try:
        return _computed(job, opened, case, case + 1)
    except FATAL:
        raise
    except Exception as error:
        return failed(opened.template, RAISED, f"{type(error).__name__}: {error}")


def checked(result: ChunkResult, template: Template, count: int) -> ChunkResult:
    """Return the result in the types of the template, those cases diverged that are not finite.

    Raises
    ------
    BrokenWorkflowError
        If the workflow does not keep its contract, which is no failed case.
    """
    status = np.asarray(result.status)
    if set(result.arrays) != set(template.per_case):
        raise _broken(f"gave the arrays {sorted(result.arrays)} instead of {sorted(template.per_case)}")
    if (
        status.shape != (count,)
        or len(result.messages) != count
        or np.any((status < DONE) | (status > DIVERGED))
    ):
        raise _broken(f"must give a message and a status of 1 to 5 for each of {count} cases")
    arrays = {}
    for name, variable in template.per_case.items():
        arrays[name] = np.asarray(result.arrays[name], dtype=variable.dtype)
        if arrays[name].shape != (count, *variable.shape):
            raise _broken(f"gave {name!r} the shape {arrays[name].shape}, not {(count, *variable.shape)}")
    return _judged(
        ChunkResult(arrays, status.astype(np.int8), tuple(result.messages), result.timings), template
    )


def _broken(what: str) -> BrokenWorkflowError:
    return BrokenWorkflowError(f"the workflow {what}")


def _judged(result: ChunkResult, template: Template) -> ChunkResult:
    """Return the result with the cases whose time series are not finite marked as diverged.

    Instants that a case does not have are no numbers by intent, and so may be results that are no series
    (a radius within which there never is 80 % of the light).
    """
    status, messages = result.status.copy(), list(result.messages)
    exists = np.isfinite(result.arrays["time_s"]) if "time_s" in template.per_case else None
    for name, variable in template.per_case.items():
        if "time" not in variable.dims or variable.coordinate or np.dtype(variable.dtype).kind not in "fc":
            continue
        axis = 1 + variable.dims.index("time")
        wrong = ~np.isfinite(np.moveaxis(result.arrays[name][..., variable.unknown :], axis, 1))
        wrong = wrong.reshape(*wrong.shape[:2], -1).any(axis=2)
        if exists is not None:
            wrong &= exists
        for row in np.flatnonzero(wrong.any(axis=1) & (status == DONE)):
            status[row] = DIVERGED
            messages[row] = f"{name} is not finite from instant {int(np.argmax(wrong[row]))} on"
    return ChunkResult(result.arrays, status, tuple(messages), result.timings)


def failed(template: Template, code: int, message: str) -> ChunkResult:
    """Return the place of one case without numbers."""
    return ChunkResult(unknown_arrays(template.per_case, 1), np.array([code], dtype=np.int8), (message,))


def joined(parts: Sequence[ChunkResult]) -> ChunkResult:
    """Return the results of consecutive cases as one."""
    arrays = {name: np.concatenate([part.arrays[name] for part in parts]) for name in parts[0].arrays}
    messages = tuple(message for part in parts for message in part.messages)
    names = {name for part in parts for name in part.timings}
    timings = {name: sum(part.timings.get(name, 0.0) for part in parts) for name in sorted(names)}
    return ChunkResult(arrays, np.concatenate([part.status for part in parts]), messages, timings)


def store_chunk(job: Job, chunk: Chunk, result: ChunkResult, compute_s: float) -> Outcome:
    """Write the data of a chunk, and once it is on disk its record."""
    opened, path = opened_store(job.workflow, job.path, job.run), location(job.path)
    result = replace(result, messages=tuple(shortened(printable(text)) for text in result.messages))
    codes = result.status.tolist()
    record = Record(
        *chunk,
        {},
        tuple(codes.count(code) for code in range(DIVERGED + 1)),
        {chunk[0] + row: (code, result.messages[row]) for row, code in enumerate(codes) if code != DONE},
        {},
        code=provenance.code(),
        epoch=job.epoch,
        settles=chunk[0] in job.settled,
    )
    with write_errors_explained(path), fence.writing(path, chunk[0], job.run) as require:
        disk = _Disk(job, path, opened, result, record, compute_s, require)
        for _ in commit(disk):
            pass
    return Outcome(chunk, disk.record.quarantined, compute_s, disk.write_s)


@dataclass
class _Disk:
    """What :func:`commit` does to the disk for one chunk."""

    job: Job
    path: Path
    opened: Opened
    result: ChunkResult
    record: Record
    compute_s: float
    require: Callable[[], None]
    write_s: float = 0.0

    def admit(self) -> None:
        patiently(lambda: fence.admit(self.path, self.job.run))
        patiently(self.require)

    def reopen(self) -> None:
        if self.job.guarded:
            _refuse_changes(self.opened, self.record.chunk, self.result)
        first, last = self.record.chunk
        counts = (last - first, *[0] * DIVERGED)
        opened = replace(self.record, digests={}, counts=counts, failures={}, settles=False)
        patiently(lambda: journal.append(self.path / JOURNAL, opened))

    @cached_property
    def files(self) -> list[Path]:
        data, arrays = self.path / DATA, self.opened.arrays.values()
        return [chunk_file(data, array, self.record.first) for array in arrays]

    @cached_property
    def seen(self) -> dict[ObjectPath, str | None]:
        return versions(file for file in self.files if isinstance(file, ObjectPath))

    def is_begun(self) -> bool:
        if isinstance(self.path, ObjectPath):
            return any(self.seen.values())
        return any(file.exists() for file in self.files)

    def is_recorded(self) -> bool:
        if not self.is_begun():  # which spares a look at the whole journal
            return False
        found = journal.record_of(self.path / JOURNAL, self.record.chunk, self.job.epoch)
        self.record = found or self.record
        return found is not None

    def write(self) -> Iterator[None]:
        start = time.perf_counter()
        what = (self.opened.arrays, self.record.chunk, self.result, self.admit, self.seen)
        digests = patiently(lambda: write_chunk(*what))
        self.write_s = time.perf_counter() - start
        timings = {"compute_s": self.compute_s, "write_s": self.write_s, **self.result.timings}
        rounded = {name: round(seconds, 4) for name, seconds in timings.items()}
        self.record = replace(self.record, digests=digests, timings=rounded)
        yield

    def append(self) -> None:
        patiently(lambda: journal.append(self.path / JOURNAL, self.record))


def _refuse_changes(opened: Opened, chunk: Chunk, result: ChunkResult) -> None:
    """Raise StoreDamageError if a case of the chunk that is done in the store has other numbers now."""
    done = np.asarray(opened.arrays["status"][slice(*chunk)]) == DONE
    differing = [
        name
        for name, values in {**result.arrays, "status": result.status}.items()
        if not (name in opened.template.per_case and opened.template.per_case[name].measured)
        and journal.digest(np.asarray(opened.arrays[name][slice(*chunk)])[done])
        != journal.digest(values[done])
    ]
    if differing:
        raise StoreDamageError(
            f"cases {chunk[0]} to {chunk[1] - 1} were computed again, and {', '.join(sorted(differing))} of "
            "cases that were done differ: machines or versions disagree. Nothing was changed."
        )
