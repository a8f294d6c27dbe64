"""Compute a suspect chunk case by case in processes of its own, so that only guilty cases are quarantined.

Suspects are chunks that killed the worker which computed them, or ran for too long. What such a case can do
to its process (crash, hang, take all memory) it does to one that does nothing else.
"""

import multiprocessing
import os
import signal
import time
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from typing import Any

from wavequake.campaign.contract import CRASHED, TIMED_OUT, ChunkResult
from wavequake.campaign.engine.chunks import (
    FATAL,
    Job,
    Outcome,
    computed_alone,
    failed,
    joined,
    opened_store,
    store_chunk,
)
from wavequake.campaign.store import fence
from wavequake.campaign.store.objects import location
from wavequake.cluster.local import (
    GUARDED,
    interrupts_blocked,
    memory_limit,
    start_of_processes,
    worker_environment,
)
from wavequake.cluster.output import redirect
from wavequake.errors import UserError
from wavequake.posix import resource
from wavequake.prepared import one_thread

_START_S = 120.0  # for a process to start and to open the store
_STARTS = 3  # of a process that somebody kills before it begins


class NoProcessError(UserError):
    """A script cannot start processes, as it would run again in each."""


@dataclass(frozen=True)
class _End:
    """How a process ended that did not compute all of its cases, as a status and in words."""

    status: int
    message: str


def renewed(job: Job) -> Job:
    """Begin anew, so that the workers of the job until now are shut out."""
    run = fence.begin(location(job.path), job.shard, None, 0)
    return replace(job, run=run.runs[job.shard], epoch=run.epoch)


def compute_isolated(job: Job, first: int, last: int, limit_s: float) -> Outcome:
    """Compute a chunk case by case in processes of its own, and write and record it.

    A case whose process dies is tried once more, alone in a fresh process: if that dies too, the case is
    CRASHED. A case that takes longer than `limit_s` is TIMED_OUT. One that asks for more memory than there is
    raises MemoryError.
    """
    start = time.perf_counter()
    result = result_of_its_own(job, first, last, limit_s)
    return store_chunk(job, (first, last), result, time.perf_counter() - start)


def result_of_its_own(job: Job, first: int, last: int, limit_s: float) -> ChunkResult:
    """Return the result of :func:`compute_isolated` without storing it."""
    template = opened_store(job.workflow, job.path, job.run).template
    parts: list[ChunkResult] = []
    while first + len(parts) < last:
        done, end = _in_process(job, range(first + len(parts), last), limit_s)
        parts += done
        if first + len(parts) == last:
            break
        if end.status == CRASHED:
            suspect = first + len(parts)
            done, end = _in_process(job, range(suspect, suspect + 1), limit_s)
            parts += done or [failed(template, end.status, end.message)]
        else:
            parts.append(failed(template, end.status, end.message))
    return joined(parts)


def _in_process(
    job: Job, cases: range, limit_s: float, starts: int = _STARTS
) -> tuple[list[ChunkResult], _End]:
    """Compute cases one by one in a new process; return the results up to its end, and how that came.

    One that is killed before it begins says nothing of the cases: another is started.
    """
    context: Any = multiprocessing.get_context(start_of_processes())
    ours, theirs = context.Pipe(duplex=False)
    with worker_environment(), interrupts_blocked():
        arguments = (theirs, job, cases, memory_limit(), dict(os.environ))
        process = context.Process(target=_serve, args=arguments, daemon=True)
        process.start()
    theirs.close()
    results: list[ChunkResult] = []
    started = False
    try:
        patience = _START_S
        while len(results) < len(cases):
            if not ours.poll(patience):
                return results, _End(TIMED_OUT, f"it took longer than {patience:g} s (campaign.timeout_s)")
            answer = ours.recv()
            if isinstance(answer, Exception):
                raise answer
            started = True
            if answer is not None:
                results.append(answer)
            patience = limit_s
    except EOFError:
        process.join()
        if not started and (process.exitcode or 0) < 0 and starts > 1:
            return _in_process(job, cases, limit_s, starts - 1)
        if not started:
            raise NoProcessError(
                f"The process that tries cases {cases[0]} to {cases[-1]} alone does not start: {GUARDED}"
            ) from None
    finally:
        process.kill()  # it is alive only if it hangs or we were interrupted
        process.join()
        ours.close()
    return results, _End(CRASHED, f"the process that computed it {_death(process.exitcode or 0)}")


def _serve(connection: Connection, job: Job, cases: range, memory: int, environment: dict[str, str]) -> None:
    """Be the process of :func:`_in_process`: say None when ready, and then the result of each case."""
    os.environ.update(environment)  # which may have changed since what this one was forked from began
    redirect()
    try:
        opened = opened_store(job.workflow, job.path, job.run)
    except Exception as error:
        connection.send(error)
        return
    resource.setrlimit(resource.RLIMIT_DATA, (memory, resource.getrlimit(resource.RLIMIT_DATA)[1]))
    connection.send(None)
    with one_thread():
        for case in cases:
            try:
                connection.send(computed_alone(job, opened, case))
            except FATAL as error:
                connection.send(error)
                return
            except BaseException:  # out of memory as it sends: nobody wants a traceback on the terminal
                os._exit(1)


def _death(code: int) -> str:
    if code >= 0:
        return f"ended with exit status {code}"
    try:
        return f"was killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"was killed by signal {-code}"
