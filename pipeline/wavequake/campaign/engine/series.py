"""Compute chunks one after the other in this process, and give up those that never end.

A case may take this process with it: a crash, or a loop that holds the interpreter's lock. So the chunk under
way has a mark in the store, and a run that finds one lets the chunk be tried in other processes.
"""

import faulthandler
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from logging import Logger
from pathlib import Path
from queue import Empty, SimpleQueue

from wavequake.campaign.contract import ChunkResult
from wavequake.campaign.engine.chunks import Job, Outcome, computed_chunk, store_chunk
from wavequake.campaign.store.journal import Chunk
from wavequake.campaign.store.objects import location
from wavequake.campaign.store.store import JOURNAL, write_errors_explained
from wavequake.prepared import one_thread

# No thread of this process runs if a case does not let go of the interpreter. The process is ended then, that
# much later than a chunk would be given up.
_GRACE_S = 60.0

Answer = tuple[ChunkResult, float] | BaseException


def in_series(
    job: Job,
    todo: Sequence[Chunk],
    done: Callable[[Outcome], None],
    limit: Callable[[], float],
    log: Logger,
) -> list[Chunk]:
    """Compute chunks and return those that ran beyond `limit`; whoever waits here can be interrupted.

    A thread computes and this one writes. The thread of a chunk that is given up cannot be ended: it goes on
    until the process ends, and nobody takes its result.
    """
    suspects: list[Chunk] = []
    tasks, answers = _helper(job)
    try:
        with one_thread():  # also if a thread that was given up restores what it found
            for piece in todo:
                with _marked(location(job.path), piece):
                    tasks.put(piece)
                    answer = _awaited(answers, limit())
                if answer is None:
                    log.warning("cases %d to %d ran for too long and are given up for now", *piece)
                    suspects.append(piece)
                    tasks.put(None)
                    tasks, answers = _helper(job)
                elif isinstance(answer, BaseException):
                    raise answer
                else:
                    done(store_chunk(job, piece, *answer))
    finally:
        tasks.put(None)
    return suspects


def _mark(path: Path, piece: Chunk) -> Path:
    return path / JOURNAL / "{}-{}.open".format(*piece)


@contextmanager
def _marked(path: Path, piece: Chunk) -> Iterator[None]:
    """Have a mark of a chunk beside the journal, which stays only if the process dies in here."""
    with write_errors_explained(path):
        _mark(path, piece).touch()
    try:
        yield
    finally:
        unmark(path, piece)


def unmark(path: Path, piece: Chunk) -> None:
    """Remove the mark of a chunk, if there is one."""
    with suppress(OSError):
        _mark(path, piece).unlink(missing_ok=True)


def left_open(path: Path, pieces: Sequence[Chunk]) -> list[Chunk]:
    """Return those chunks that a serial run was computing when its process died."""
    marks = set((path / JOURNAL).glob("*.open"))
    return [piece for piece in pieces if _mark(path, piece) in marks] if marks else []


def _awaited(answers: "SimpleQueue[Answer]", limit: float) -> Answer | None:
    patience = min(limit, threading.TIMEOUT_MAX / 2)
    try:
        with _ended_if_blocked(patience + _GRACE_S):
            return answers.get(timeout=patience)
    except Empty:
        return None


def _helper(job: Job) -> tuple["SimpleQueue[Chunk | None]", "SimpleQueue[Answer]"]:
    """Start a thread that computes the chunks of a queue until None comes."""
    tasks: SimpleQueue[Chunk | None] = SimpleQueue()
    answers: SimpleQueue[Answer] = SimpleQueue()

    def work() -> None:
        while (piece := tasks.get()) is not None:
            try:
                answers.put(computed_chunk(job, *piece))
            except BaseException as error:  # it is raised where it is waited for
                answers.put(error)

    threading.Thread(target=work, name="chunks", daemon=True).start()
    return tasks, answers


@contextmanager
def _ended_if_blocked(seconds: float) -> Iterator[None]:
    """End this process with a traceback if it is still in here after `seconds`; no Python code is needed."""
    if sys.__stderr__ is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    faulthandler.dump_traceback_later(seconds, exit=True, file=sys.__stderr__)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
