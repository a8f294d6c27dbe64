"""Who may write into a store: a run that begins shuts out the writers of those before it.

A worker may outlive its run: it was stopped, or cut off by the network, and goes on when another run has
extended the store or computed its chunk. So every run has a token, which its writers look up before and after
they write; they do so under a lock of their chunk, and a run begins under the locks of all. Where a file
system has no locks, looking up still leaves but the moment of the write itself. Object storage has none
either, but conditional writes: a writer claims its chunk, and writes over what was there before it was last
told that the claim and its run hold.

Each run also has an epoch, one more than that of the run before. Records carry it, and the later one holds:
clocks of machines differ, and jump.
"""

import errno
import json
import os
import struct
import time
import uuid
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

from wavequake.campaign.store.objects import ObjectPath, change, get, put
from wavequake.errors import UserError
from wavequake.posix import fcntl

FENCE, WRITERS, CLAIMS = "fence.json", "writers.lock", "claims"
_WAIT_S, _LOOK_S = 60.0, 0.01
_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL}
_ALL = (0, 0)


class ShutOutError(UserError):
    """Another run has begun since this writer's run did."""


@dataclass(frozen=True)
class Fence:
    """The epoch of the latest run, and the tokens of those that may write, by shard ("": the whole store)."""

    epoch: int = 0
    runs: Mapping[str, str] = field(default_factory=dict)


def shut(fence: Fence, shard: str, others: Collection[str] | None, token: str) -> Fence:
    """Return the fence when a run begins beside `others`, the shards at work (None: all there are)."""
    runs = {other: run for other, run in fence.runs.items() if others is None or other in others}
    return Fence(fence.epoch + 1, {**runs, shard: token})


def admits(fence: Fence, token: str) -> bool:
    """Return whether the writers of a run may write."""
    return token in fence.runs.values()


def read_fence(path: Path) -> Fence | None:
    """Return the fence of a store; None if there is none, or it is damaged."""
    try:
        return _parsed((path / FENCE).read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None


def _parsed(text: str | bytes) -> Fence | None:
    try:
        entry = json.loads(text)
        epoch, runs = entry["epoch"], entry["runs"]
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    sound = type(epoch) is int and 0 < epoch < 2**53 and isinstance(runs, dict)
    return Fence(epoch, {str(k): str(v) for k, v in runs.items()}) if sound else None


def begin(
    path: Path, shard: str, others: Collection[str] | None, least: int, wait_s: float = _WAIT_S
) -> Fence:
    """Shut all writers of earlier runs out, and return the fence; ``runs[shard]`` is the new token.

    Parameters
    ----------
    path : Path
        The store.
    shard : str
        What the run computes, as i/n, or "" for all.
    others : collection of str, optional
        The other shards that are being computed; by default those that may write now.
    least : int
        The epoch is at least one more than this: the latest one that a record has.
    wait_s : float
        How long to wait for writers that are writing.

    Raises
    ------
    UserError
        If a writer does not come to its end.
    """
    token = uuid.uuid4().hex

    def shut_now(before: Fence) -> Fence:
        return shut(Fence(max(before.epoch, least), before.runs), shard, others, token)

    if isinstance(path, ObjectPath):  # writers under way find that what they write over has changed
        text = change(path / FENCE, lambda old: _text(shut_now(_parsed(old or b"") or Fence())))
        return _parsed(text) or Fence()
    with _locked(path, _ALL, wait_s):
        fence = shut_now(read_fence(path) or Fence())
        partial = path / f"{FENCE}.partial-{uuid.uuid4().hex}"
        try:
            with partial.open("wb") as file:
                file.write(_text(fence))
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path / FENCE)
        finally:
            partial.unlink(missing_ok=True)
    return fence


def _text(fence: Fence) -> bytes:
    return json.dumps(asdict(fence)).encode()


def admit(path: Path, token: str) -> None:
    """Raise ShutOutError if another run has begun since the run of `token` did, or the store has gone."""
    fence = read_fence(path)
    if fence is None or not admits(fence, token):
        reason = "another run has begun to compute it" if path.exists() else "it was moved or deleted"
        raise ShutOutError(f"{path} is no longer written by this run: {reason}. What is done is kept.")


@contextmanager
def writing(path: Path, first: int, token: str = "") -> Iterator[Callable[[], None]]:
    """Keep runs from beginning, and others from this chunk, while this process writes and records it.

    What is yielded raises ShutOutError if this process may no longer write the chunk. In object storage
    nobody is kept from anything, and another writer of the chunk takes it over.
    """
    if isinstance(path, ObjectPath):
        yield _claimed(path / CLAIMS / str(first), lambda: admit(path, token))
        return
    with _locked(path, (first, 1), _WAIT_S):
        yield lambda: None


def _claimed(claim: ObjectPath, admitted: Callable[[], None]) -> Callable[[], None]:
    """Claim a chunk for this writer, from whoever has it; return what raises when another one has."""
    owner = uuid.uuid4().hex.encode()
    found = get(claim)
    admitted()
    while not put(claim, owner, found and found[1]):
        found = get(claim)
        if found and found[0] == owner:
            break
        admitted()  # asked after the look: a later run's claim is another version

    def require() -> None:
        found = get(claim)
        if found is None or found[0] != owner:
            raise ShutOutError(f"{claim}: another worker of this run, or a later run, writes these cases.")

    return require


@contextmanager
def _locked(path: Path, part: tuple[int, int], wait_s: float) -> Iterator[None]:
    # A folder that has gone does not come back by this: the file is made in one that is there.
    handle = os.open(path / WRITERS, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        _lock(handle, part, time.monotonic() + wait_s, path)
        yield
    finally:
        os.close(handle)


def _lock(handle: int, part: tuple[int, int], end: float, path: Path) -> None:
    """Lock a part (first byte and number) of an open file, byte by byte as chunks are; 0 bytes are all."""
    first, count = part
    request = struct.pack("hhqqi", fcntl.F_WRLCK, os.SEEK_SET, first, count, 0)
    while True:
        try:
            if hasattr(
                fcntl, "F_OFD_SETLK"
            ):  # of the open file, not of the process, in which threads may write
                fcntl.fcntl(handle, fcntl.F_OFD_SETLK, request)
            else:  # outside of Linux
                fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB, count, first)
            return
        except BlockingIOError:
            if time.monotonic() > end:
                raise UserError(
                    f"{path} is being written by a process of an earlier run that does not go on, perhaps "
                    "because it is stopped: end it, and repeat the command."
                ) from None
        except OSError as error:
            if error.errno in _NO_LOCKS:
                return
            raise
        time.sleep(_LOOK_S)
