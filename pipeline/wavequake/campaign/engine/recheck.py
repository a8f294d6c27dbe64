"""Compute a share of the stored chunks again on other workers: who computes wrong is found, and redone.

Bits do not depend on where a case is computed. Where two workers give other bits, a process of its own on the
driver's machine says which of them is wrong; all chunks of that one are computed again by the others.
"""

import os
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b
from logging import Logger
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wavequake.campaign.contract import CRASHED, TIMED_OUT
from wavequake.campaign.engine.chunks import Job, computed_chunk, refuse_other_code
from wavequake.campaign.engine.isolation import compute_isolated, renewed, result_of_its_own
from wavequake.campaign.store.arrays import digests_of
from wavequake.campaign.store.journal import Chunk, Record, differences, read_journal
from wavequake.campaign.store.manifest import Manifest
from wavequake.campaign.store.store import JOURNAL, done_records
from wavequake.errors import StoreDamageError
from wavequake.words import counted

if TYPE_CHECKING:
    from distributed import Client

Process = tuple[str, int]

_DEADLY = (CRASHED, TIMED_OUT)  # what such cases did to one worker they would do to the next


@dataclass(frozen=True)
class Answer:
    """The digests of a chunk, and the process (host, id) that computed it."""

    chunk: Chunk
    digests: Mapping[str, str]
    process: Process


def drawn(pieces: Sequence[Chunk], share: float, seed: str) -> list[Chunk]:
    """Return that share of the chunks, drawn by lot, and at least one; the same ones for the same seed."""
    count = min(len(pieces), max(1, round(share * len(pieces)))) if share else 0
    lots = sorted(pieces, key=lambda piece: blake2b(f"{seed} {piece[0]}".encode()).digest())
    return sorted(lots[:count])


def this_worker() -> Process:
    """Return host and id of this process, as records have them."""
    return socket.gethostname(), os.getpid()


def answer(job: Job, first: int, last: int) -> Answer:
    """Compute a chunk and store nothing; this runs in a worker."""
    refuse_other_code(job)
    result, _ = computed_chunk(job, first, last)
    return Answer((first, last), digests_of(result), this_worker())


def answer_of_its_own(job: Job, first: int, last: int, limit_s: float) -> Answer:
    """Compute a chunk in a new process of this machine."""
    result = result_of_its_own(job, first, last, limit_s)
    return Answer((first, last), digests_of(result), (socket.gethostname(), 0))


def answers_of(client: "Client", job: Job, records: Sequence[Record]) -> list[Answer]:
    """Have chunks computed by other workers than those that recorded them, as far as there are any."""
    processes = client.run(this_worker)
    futures = []
    for record in records:
        others = [worker for worker, process in processes.items() if process != (record.host, record.pid)]
        where: dict[str, Any] = {"workers": others} if others else {}
        futures.append(client.submit(answer, job, *record.chunk, pure=False, **where))
    found: list[Answer] = client.gather(futures)
    return found


def wrong_process(record: Record, second: Answer, third: Answer) -> Process | None:
    """Return which process computed a chunk wrong, by the majority of three; None if nothing differs.

    Raises
    ------
    StoreDamageError
        If all three differ.
    """
    if not differences(record.digests, second.digests):
        return None
    if not differences(record.digests, third.digests):
        return second.process
    if not differences(second.digests, third.digests):
        return record.host, record.pid
    names = ", ".join(differences(record.digests, second.digests))
    raise StoreDamageError(
        f"cases {record.first} to {record.last - 1} came out in three ways, by process {record.pid} on "
        f"{record.host}, by process {second.process[1]} on {second.process[0]} and by one of this machine: "
        f"{names} differ, so that no machine can be believed."
    )


@dataclass(frozen=True)
class Check:
    """A share of the chunks `wanted` is computed again."""

    path: Path
    manifest: Manifest
    wanted: list[Chunk]
    share: float

    def __call__(
        self, job: Job, client: "Client | None", limit: Callable[[], float], log: Logger
    ) -> tuple[tuple[str, ...], Job]:
        """Compare, and redo what a process has computed wrong; return that in words, and the job that may."""
        if not self.share:
            return (), job
        done = done_records(self.manifest, read_journal(self.path / JOURNAL))
        records = {piece: done[piece] for piece in self.wanted if piece in done}
        tame = [
            piece for piece, record in records.items() if not any(map(record.counts.__getitem__, _DEADLY))
        ]
        sample = [records[piece] for piece in drawn(tame, self.share, self.manifest.identity)]
        if client is None:
            answers = [answer_of_its_own(job, *record.chunk, limit()) for record in sample]
        else:
            answers = answers_of(client, job, sample)
        wrong: set[Process] = set()
        for record, second in zip(sample, answers, strict=True):
            if differences(record.digests, second.digests):
                third = answer_of_its_own(job, *record.chunk, limit())
                wrong |= {process} if (process := wrong_process(record, second, third)) else set()
        words = [f"{counted(len(sample), 'chunk')} of {len(records)} computed again by other processes"]
        if not wrong:
            return (f"{words[0]}: not a bit differs",), job
        redo = to_redo(records, wrong)
        job = replace(renewed(job), settled=frozenset(first for first, _ in redo))
        for piece in redo:
            compute_isolated(job, *piece, limit())
        for host, pid in sorted(wrong):
            words.append(f"process {pid} on {host} computes wrong: do not use it, or find out why")
        words.append(f"{counted(len(redo), 'chunk')} of it computed again on this machine")
        for line in words:
            log.warning(line)
        return tuple(words), job


def to_redo(records: Mapping[Chunk, Record], wrong: set[Process]) -> list[Chunk]:
    """Return the chunks that processes which compute wrong have recorded."""
    return [piece for piece, record in records.items() if (record.host, record.pid) in wrong]
