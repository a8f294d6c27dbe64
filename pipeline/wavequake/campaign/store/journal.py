"""The journal of a store: one line per finished chunk, written after its data; it alone says what is done.

Every process appends to a file of its own, so that no two writers share one. A process may die in the middle
of a line: each record begins with a line feed and ends with a checksum, and lines that are no complete record
are skipped and counted. In object storage, where nothing can be appended to, each record is an object.
"""

import errno
import hashlib
import json
import os
import socket
import time
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from itertools import combinations
from math import isfinite
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from numpy.typing import NDArray

from wavequake.campaign.contract import DONE, STATUS_MEANINGS, TODO
from wavequake.campaign.store.objects import ObjectPath, create, get_each
from wavequake.errors import StoreDamageError

# Text of exceptions may hold addresses, and a stopwatch reads otherwise in every run: neither is a number of
# the campaign. Names end so.
_NOT_COMPARED = ("message", "seconds")

_LONGEST = 2**26  # bytes of a line

Chunk = tuple[int, int]


@dataclass(frozen=True)
class Record:
    """What is known of a finished chunk, cases first <= id < last.

    ``digests`` identify the stored bytes of each array, ``counts[s]`` is the number of cases with status s,
    ``failures`` gives status and message of each quarantined case, ``timings`` are in s, and ``code`` says
    which versions computed it. ``epoch`` counts the runs of the store, 0 where that is not known. A record
    that ``settles`` stands against all earlier ones.
    """

    first: int
    last: int
    digests: Mapping[str, str]
    counts: tuple[int, ...]
    failures: Mapping[int, tuple[int, str]]
    timings: Mapping[str, float] = field(default_factory=dict)
    time: float = field(default_factory=time.time)
    host: str = field(default_factory=socket.gethostname)
    pid: int = field(default_factory=os.getpid)
    code: str = ""
    epoch: int = 0
    settles: bool = False

    @property
    def chunk(self) -> Chunk:
        """The chunk's first case and the case after its last."""
        return self.first, self.last

    @property
    def reopens(self) -> bool:
        """Whether this says that the chunk is about to be written anew, so that earlier records are void."""
        return self.counts[TODO] > 0

    @property
    def has_messages(self) -> bool:
        """Whether a case says why it has no valid numbers."""
        return any(text for _, text in self.failures.values())

    @property
    def quarantined(self) -> int:
        """Number of cases that have no valid numbers."""
        return sum(self.counts[2:])


@dataclass(frozen=True)
class Journal:
    """The record of each chunk that holds, and the number of torn lines that were skipped.

    ``contested`` says of chunks in what their records contradict each other.
    """

    records: Mapping[Chunk, Record]
    torn: int
    contested: Mapping[Chunk, str] = field(default_factory=dict)


def digest(array: NDArray[Any]) -> str:
    """Return the BLAKE2b-128 of an array's bytes in C order, or of its texts."""
    content = (
        json.dumps(array.tolist()).encode()
        if array.dtype.kind in "OUT"
        else np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
    )
    return hashlib.blake2b(content, digest_size=16).hexdigest()


@lru_cache(maxsize=8)
def _own_file(folder: str, pid: int) -> Path:
    return Path(folder) / f"{socket.gethostname()}-{pid}-{uuid.uuid4().hex[:12]}.jsonl"


def append(folder: Path, record: Record) -> None:
    """Append a record durably to this process's file; the data must be on disk already.

    Raises
    ------
    OSError
        If the disk is full or cannot be written.
    """
    text = json.dumps(asdict(record), separators=(",", ":")).encode()
    line = b"\n%s %s\n" % (text, _checksum(text))
    if isinstance(folder, ObjectPath):
        create(folder / f"{record.first}-{record.last}-{uuid.uuid4().hex}.jsonl", line)
        return
    path = _own_file(str(folder), os.getpid())
    fresh = not path.exists()
    handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        if os.write(handle, line) != len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        os.fsync(handle)
    finally:
        os.close(handle)
    if fresh:
        flush(folder)


def flush(path: Path) -> None:
    """Make the content of a file, or the names of a folder's files, durable."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def read_journal(folder: Path) -> Journal:
    """Read every record of a store.

    Raises
    ------
    StoreDamageError
        If two runs of a chunk gave different numbers.
    """
    journal = scan_journal(folder)
    for sentence in journal.contested.values():
        raise StoreDamageError(sentence)
    return journal


def _files(folder: Path) -> list[Path]:
    """Return the regular files of a journal: of a pipe a reader waits for ever."""
    return sorted(path for path in folder.glob("*.jsonl") if path.is_file())


def scan_journal(folder: Path) -> Journal:
    """Read every record of a store, also where some contradict each other; of those chunks none holds."""
    records: list[Record] = []
    torn = 0
    for line in _lines(folder):
        if line.strip():
            record = _parse(line.strip())
            records += [record] if record else []
            torn += record is None
    return judged(records, torn)


def _lines(folder: Path) -> Iterator[bytes]:
    if isinstance(folder, ObjectPath):
        for found in get_each([*folder.glob("*.jsonl")]):
            yield from found[0].split(b"\n") if found else ()
        return
    for path in _files(folder):
        with path.open("rb") as file:
            while line := file.readline(_LONGEST):
                yield line


def record_of(folder: Path, chunk: Chunk, epoch: int) -> Record | None:
    """Return the record that a run has made of a chunk, if there is one; parses no other lines."""
    sign = b'{"first":%d,"last":%d,' % chunk
    of_chunk = "{}-{}-*.jsonl".format(*chunk)
    for path in folder.glob(of_chunk) if isinstance(folder, ObjectPath) else _files(folder):
        content = path.read_bytes()
        place = content.find(sign)
        while place >= 0:
            record = _parse(content[place:].split(b"\n", 1)[0])
            if record and record.epoch == epoch and not record.reopens:
                return record
            place = content.find(sign, place + 1)
    return None


def judged(records: Iterable[Record], torn: int = 0) -> Journal:
    """Return which records hold.

    A chunk may have run twice (a lost connection, a repair): both must agree. Only a chunk whose cases fared
    differently (a crash that was tried again) may change; then the record of the latest epoch holds, and
    where one epoch has both, none does, as nobody knows which data were written last. Nor does a record hold
    if, later, fewer cases of the same file were recorded, or the chunk was opened to be written anew. A
    record that settles an argument ends it.
    """
    files: dict[int, list[Record]] = {}
    for record in records:
        files.setdefault(record.first, []).append(record)
    holding: dict[Chunk, Record] = {}
    contested: dict[Chunk, str] = {}
    for of_file in files.values():
        of_file.sort(key=_order)
        for last in {record.last for record in of_file if not record.reopens}:
            same = [record for record in of_file if record.last == last and not record.reopens]
            newest = same[-1]
            same = same[max((i for i, record in enumerate(same) if record.settles), default=0) :]
            if sentence := _contradiction(same):
                contested[newest.chunk] = sentence
            elif not any(_overwrites(other, newest) for other in of_file):
                holding[newest.chunk] = newest
    return Journal(dict(sorted(holding.items())), torn, contested)


def _order(record: Record) -> tuple[int, float]:
    return record.epoch, record.time


def _overwrites(other: Record, record: Record) -> bool:
    """Return whether the data of a record may be those of another one that is not earlier."""
    if other.reopens:
        return other.epoch > record.epoch
    if other.epoch == record.epoch == 0:  # of a version that knew clocks only
        return other.time > record.time and other.last < record.last
    shorter, differs = (
        other.last < record.last,
        other.chunk == record.chunk and _fared(other) != _fared(record),
    )
    return other.epoch >= record.epoch and (shorter or differs)


def _fared(record: Record) -> str | None:
    return record.digests.get("status")


def _parse(line: bytes) -> Record | None:
    """Return the record of a line; None if it was cut off or changed."""
    text, _, checksum = line.rpartition(b" ")
    if not line.endswith(b"}"):  # as lines of earlier versions do, which have no checksum
        line = text if checksum == _checksum(text) else b""
    try:
        entry = json.loads(line)
        record = Record(
            **{
                **entry,
                "failures": {
                    int(case): (int(code), str(text)) for case, (code, text) in entry["failures"].items()
                },
                "counts": tuple(entry["counts"]),
            }
        )
        return record if _is_sound(record) else None
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None


def _checksum(text: bytes) -> bytes:
    return b"%08x" % google_crc32c.value(text)


def _is_sound(record: Record) -> bool:
    """Return whether the entries of a record have their types, and its counts are of its cases."""
    whole = (record.first, record.last, record.epoch, record.pid, *record.counts)
    return (
        all(type(number) is int and 0 <= number < 2**53 for number in whole)
        and record.first < record.last
        and len(record.counts) == len(STATUS_MEANINGS.split())
        and sum(record.counts) == record.last - record.first
        and all(DONE < code < len(record.counts) for code, _ in record.failures.values())
        and all(isinstance(text, str) for text in (record.host, record.code, *record.digests.values()))
        and all(type(number) in (int, float) for number in (record.time, *record.timings.values()))
        and isfinite(record.time)
    )


def _contradiction(records: Sequence[Record]) -> str:
    """Return in what records of one chunk differ that should not, in words; "" if they agree."""
    for one, other in combinations(unlike(records), 2):
        if _fared(one) != _fared(other):
            continue
        differing = differences(one.digests, other.digests)
        if differing:
            one_by, other_by = (f"process {record.pid} on {record.host}" for record in (one, other))
            return (
                f"cases {one.first} to {one.last - 1} were computed twice, by {one_by} and by {other_by}, "
                f"and {', '.join(differing)} differ: machines or versions disagree; run the study again with "
                "--repair, which computes them anew."
            )
    return ""


def unlike(records: Sequence[Record]) -> list[Record]:
    """Return one record of each kind of numbers."""
    return list({tuple(sorted(record.digests.items())): record for record in records}.values())


def differences(one: Mapping[str, str], other: Mapping[str, str]) -> list[str]:
    """Return the names of arrays whose digests differ, of those that are numbers of the campaign."""
    return sorted(
        name
        for name in {*one, *other}
        if not name.endswith(_NOT_COMPARED) and one.get(name) != other.get(name)
    )
