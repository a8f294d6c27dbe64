"""The task of the engine: compute the cases of one chunk, write them, record them.

The same function runs in the driver (serial), in a Dask worker, and, where a chunk kills its workers, case by
case in processes of its own. Only a few scalars travel back; the numbers go to the store.
"""

import multiprocessing
import signal
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from wavequake.cluster.local import interrupts_blocked, worker_environment
from wavequake.errors import UserError
from wavequake.workflows import journal
from wavequake.workflows.arrays import Array, array_of, open_group, write_chunk
from wavequake.workflows.contract import CRASHED, DIVERGED, DONE, RAISED, ChunkResult, Template, Workflow
from wavequake.workflows.journal import Chunk, Record
from wavequake.workflows.store import DATA, JOURNAL, Manifest, read_manifest, write_errors_explained


class BrokenWorkflowError(Exception):
    """A workflow does not keep its contract."""


# What ends a run: everything else that a case raises is quarantined with it.
_FATAL = (UserError, BrokenWorkflowError)


@dataclass(frozen=True)
class Job:
    """What the chunks of a run share; it travels with every task and is small: functions go by reference."""

    workflow: Workflow
    path: str
    device: str
    run: str


@dataclass(frozen=True)
class Outcome:
    """What the driver learns of a finished chunk."""

    chunk: Chunk
    quarantined: int
    compute_s: float
    write_s: float


@dataclass(frozen=True)
class _Opened:
    manifest: Manifest
    template: Template
    arrays: Mapping[str, Array]


@lru_cache(maxsize=2)
def _opened(workflow: Workflow, path: str, run: str) -> _Opened:
    """Open the store once per process and run; a later run may have extended it."""
    manifest = read_manifest(path)
    group = open_group(Path(path) / DATA)
    arrays = {name: array_of(group, name) for name in manifest.variables}
    return _Opened(manifest, workflow.template(manifest.study), arrays)


def compute_chunk(job: Job, first: int, last: int) -> Outcome:
    """Compute cases first <= id < last, write them to the store and then to its journal.

    Cases are independent: where computing them together raises, each is tried alone, so that only the guilty
    ones are quarantined, with their message. Numbers do not depend on the number of threads: there is one.

    Raises
    ------
    UserError
        If the workflow says that the study is impossible, or the disk is full or cannot be written.
    """
    opened = _opened(job.workflow, job.path, job.run)
    start = time.perf_counter()
    with threadpool_limits(1):
        try:
            result = _computed(job, opened, first, last)
        except _FATAL:
            raise
        except Exception:
            parts = [_computed_alone(job, opened, case) for case in range(first, last)]
            result = _joined(parts)
    return _store(job, opened, (first, last), result, time.perf_counter() - start)


def _computed(job: Job, opened: _Opened, first: int, last: int) -> ChunkResult:
    cases = np.arange(first, last, dtype=np.int64)
    return _checked(
        job.workflow.compute(opened.manifest.study, cases, job.device), opened.template, len(cases)
    )


def _computed_alone(job: Job, opened: _Opened, case: int) -> ChunkResult:
    try:
        return _computed(job, opened, case, case + 1)
    except _FATAL:
        raise
    except Exception as error:
        return _failed(opened.template, RAISED, f"{type(error).__name__}: {error}")


def _checked(result: ChunkResult, template: Template, count: int) -> ChunkResult:
    """Return the result in the types of the store; a workflow that breaks its contract is no failed case."""
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
    return ChunkResult(arrays, status.astype(np.int8), tuple(result.messages), result.timings)


def _broken(what: str) -> BrokenWorkflowError:
    return BrokenWorkflowError(f"the workflow {what}")


def _failed(template: Template, code: int, message: str) -> ChunkResult:
    """Return the place of one case without numbers."""
    blank = {}
    for name, variable in template.per_case.items():
        dtype = np.dtype(variable.dtype)
        blank[name] = np.full((1, *variable.shape), np.nan if dtype.kind in "fc" else 0, dtype=dtype)
    return ChunkResult(blank, np.array([code], dtype=np.int8), (message,))


def _joined(parts: Sequence[ChunkResult]) -> ChunkResult:
    arrays = {name: np.concatenate([part.arrays[name] for part in parts]) for name in parts[0].arrays}
    messages = tuple(message for part in parts for message in part.messages)
    names = {name for part in parts for name in part.timings}
    timings = {name: sum(part.timings.get(name, 0.0) for part in parts) for name in sorted(names)}
    return ChunkResult(arrays, np.concatenate([part.status for part in parts]), messages, timings)


def _store(job: Job, opened: _Opened, chunk: Chunk, result: ChunkResult, compute_s: float) -> Outcome:
    """Write the data of a chunk, and once it is on disk its record."""
    start = time.perf_counter()
    path = Path(job.path)
    with write_errors_explained(path):
        digests = write_chunk(opened.arrays, chunk, result)
        write_s = time.perf_counter() - start
        timings = {"compute_s": compute_s, "write_s": write_s, **result.timings}
        codes = result.status.tolist()
        counts = tuple(codes.count(code) for code in range(DIVERGED + 1))
        failures = {
            chunk[0] + row: (code, result.messages[row]) for row, code in enumerate(codes) if code != DONE
        }
        record = Record(*chunk, digests, counts, failures, {k: round(v, 4) for k, v in timings.items()})
        journal.append(path / JOURNAL, record)
    return Outcome(chunk, record.quarantined, compute_s, write_s)


def compute_isolated(job: Job, first: int, last: int) -> Outcome:
    """Compute a chunk that killed its workers, case by case in processes of its own, and write and record it.

    A case whose process dies is tried once more, alone in a fresh process: if that dies too, the case is
    CRASHED.
    """
    opened = _opened(job.workflow, job.path, job.run)
    start = time.perf_counter()
    parts: list[ChunkResult] = []
    while first + len(parts) < last:
        done, _ = _in_process(job, range(first + len(parts), last))
        parts += done
        if first + len(parts) < last:
            suspect = first + len(parts)
            alone, death = _in_process(job, range(suspect, suspect + 1))
            parts += alone or [_failed(opened.template, CRASHED, f"the process that computed it {death}")]
    return _store(job, opened, (first, last), _joined(parts), time.perf_counter() - start)


def _in_process(job: Job, cases: range) -> tuple[list[ChunkResult], str]:
    """Compute cases one by one in a new process; return the results up to its death, and how it died."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(theirs, job, cases), daemon=True)
    with worker_environment(), interrupts_blocked():
        process.start()
    theirs.close()
    results: list[ChunkResult] = []
    try:
        while len(results) < len(cases):
            answer = ours.recv()
            if isinstance(answer, _FATAL):
                raise answer
            results.append(answer)
    except EOFError:
        pass
        process.join()
    finally:
        process.kill()  # only if we were interrupted it is still alive
        process.join()
        ours.close()
    return results, _death(process.exitcode or 0)


def _serve(connection: Connection, job: Job, cases: range) -> None:
    """Be the process of :func:`_in_process`."""
    opened = _opened(job.workflow, job.path, job.run)
    with threadpool_limits(1):
        for case in cases:
            try:
                connection.send(_computed_alone(job, opened, case))
            except _FATAL as error:
                connection.send(error)
                return


def _death(code: int) -> str:
    if code >= 0:
        return f"ended with exit status {code}"
    try:
        return f"was killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"was killed by signal {-code}"
