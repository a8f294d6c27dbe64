"""The journal of a store: one line per finished chunk, written after its data; it alone says what is done.

Every process appends to a file of its own, so that no two writers share one. A process may die in the middle
of a line: each record begins with a line feed, and lines that are no complete record are skipped and counted.
"""

import errno
import hashlib
import json
import os
import socket
import time
import uuid
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import StoreDamageError

# Text of exceptions may hold addresses, and a stopwatch reads otherwise in every run: neither is a number of
# the campaign. Names end so.
_NOT_COMPARED = ("message", "seconds")

Chunk = tuple[int, int]


@dataclass(frozen=True)
class Record:
    """What is known of a finished chunk, cases first <= id < last.

    ``digests`` identify the stored bytes of each array, ``counts[s]`` is the number of cases with status s,
    ``failures`` gives status and message of each quarantined case, ``timings`` are in s, and ``code`` says
    which versions computed it.
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

    @property
    def chunk(self) -> Chunk:
        """The chunk's first case and the case after its last."""
        return self.first, self.last

    @property
    def quarantined(self) -> int:
        """Number of cases that have no valid numbers."""
        return sum(self.counts[2:])


@dataclass(frozen=True)
class Journal:
    """The valid record of each chunk, and the number of torn lines that were skipped."""

    records: Mapping[Chunk, Record]
    torn: int


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
    path = _own_file(str(folder), os.getpid())
    fresh = not path.exists()
    line = b"\n" + json.dumps(asdict(record), separators=(",", ":")).encode() + b"\n"
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

    A chunk may have run twice (a lost connection, a repair): both must agree. Only a chunk whose cases fared
    differently (a crash that was tried again) may change; then the latest record holds.

    Raises
    ------
    StoreDamageError
        If two runs of a chunk gave different numbers.
    """
    records: dict[Chunk, Record] = {}
    torn = 0
    for path in sorted(folder.glob("*.jsonl")):
        for line in path.read_bytes().split(b"\n"):
            if not line.strip():
                continue
            record = _parse(line)
            if record is None:
                torn += 1
                continue
            known = records.get(record.chunk)
            if known is not None:
                _compare(known, record)
            if known is None or record.time >= known.time:
                records[record.chunk] = record
    return Journal(records, torn)


def _parse(line: bytes) -> Record | None:
    try:
        entry = json.loads(line)
        failures = {int(case): (int(code), str(text)) for case, (code, text) in entry.pop("failures").items()}
        counts = tuple(int(count) for count in entry.pop("counts"))
        return Record(failures=failures, counts=counts, **entry)
    except (ValueError, TypeError, KeyError, AttributeError):
        return None


def _compare(one: Record, other: Record) -> None:
    if one.digests.get("status") != other.digests.get("status"):
        return
    differing = sorted(
        name
        for name in {*one.digests, *other.digests}
        if not name.endswith(_NOT_COMPARED) and one.digests.get(name) != other.digests.get(name)
    )
    if differing:
        one_by, other_by = (f"process {record.pid} on {record.host}" for record in (one, other))
        raise StoreDamageError(
            f"cases {one.first} to {one.last - 1} were computed twice, by {one_by} and by {other_by}, and "
            f"{', '.join(differing)} differ: machines or versions disagree, so begin a new store."
        )
