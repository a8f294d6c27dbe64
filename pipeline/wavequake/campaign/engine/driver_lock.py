"""Who may work on a store: one run, or several that share its chunks (``--shard i/n``), and nobody twice.

Locks are the kernel's (flock), so that they end with the process that holds them, however it ends. Object
storage has leases instead (:mod:`wavequake.campaign.store.lease`), which end when their heartbeats do.
"""

import os
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from wavequake.campaign.store import lease, store
from wavequake.campaign.store.folder import withdraw as withdraw_store
from wavequake.campaign.store.journal import Chunk
from wavequake.campaign.store.objects import ObjectPath
from wavequake.errors import UserError
from wavequake.posix import fcntl

_SETUP = "setup.lock"


@dataclass(frozen=True)
class Shard:
    """Every `count`-th chunk of a campaign, beginning with that of index `index`, which counts from 0."""

    index: int
    count: int

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"

    def owns(self, piece: Chunk, chunk: int) -> bool:
        """Return whether a chunk is of this shard; `chunk` is the number of cases per chunk."""
        return piece[0] // chunk % self.count == self.index


def shard_of(text: str) -> Shard:
    """Read a shard such as ``0/4``, the first of four.

    Raises
    ------
    UserError
        If the text has another form, or there is no such shard.
    """
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if not match or int(match[1]) >= int(match[2]):
        raise UserError(f"{text!r} is no shard: write i/n, with i from 0 to n - 1, such as 0/4 to 3/4.")
    return Shard(int(match[1]), int(match[2]))


def this_process() -> str:
    """Return the process and its host in words."""
    return f"process {os.getpid()} on {socket.gethostname()}"


@contextmanager
def driver_lock(path: Path, shard: Shard | None) -> Iterator[tuple[str, ExitStack]]:
    """Hold a store, whose folder is made if need be, against other drivers.

    Runs of different shards hold it together. Until the yielded stack is closed, none of them is past this
    point: that is the time to create or extend the store. Beside it, the name of the lease is yielded.

    Raises
    ------
    UserError
        If another driver is at work, or one with the same shard.
    """
    store.refuse_foreign(path)
    words = f"a run of shard {shard}, {this_process()}" if shard else this_process()
    if isinstance(path, ObjectPath):
        with lease.held(path, str(shard or ""), words) as (own, ready), _leased(path, own):
            yield own, ready
        return
    with ExitStack() as held, ExitStack() as setup:
        was_there = os.path.exists(path)
        file = _held_file(path, shard, held)
        held.push(_withdrawal(path, file, was_there))
        if shard:
            folder = path / store.SHARDS
            with store.write_errors_explained(path):
                folder.mkdir(exist_ok=True)
                door = setup.enter_context((folder / _SETUP).open("a+", encoding="utf-8"))
                fcntl.flock(door, fcntl.LOCK_EX)
                mine = held.enter_context(_file_of(folder, shard).open("a+", encoding="utf-8"))
            _hold(mine, fcntl.LOCK_EX, f"Shard {shard} of {path}")
            _sign(mine, path, this_process())
        _sign(file, path, words)
        yield "", setup


@contextmanager
def _leased(path: ObjectPath, own: str) -> Iterator[None]:
    """Take a store back that is made in here, if this ends in an error and nothing was computed."""
    was_there = (path / store.MANIFEST).exists()
    try:
        yield
    except BaseException:
        if not was_there:
            with suppress(OSError, UserError):
                if not lease.others_of(path, own):
                    withdraw_store(path)
        raise


def _held_file(path: Path, shard: Shard | None, held: ExitStack) -> IO[str]:
    while True:
        with store.write_errors_explained(path):
            path.mkdir(parents=True, exist_ok=True)
            file = held.enter_context((path / store.LOCK).open("a+", encoding="utf-8"))
        _hold(file, fcntl.LOCK_SH if shard else fcntl.LOCK_EX, str(path))
        if _is_named(file, path / store.LOCK):  # else its store was withdrawn as we opened it
            return file


def _is_named(file: IO[str], path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False


def _withdrawal(path: Path, file: IO[str], folder_was_there: bool) -> Callable[..., None]:
    """Return what takes a store back that a run makes, if it ends in an error and nothing was computed."""
    was_there = (path / store.MANIFEST).exists()

    def withdraw(kind: type[BaseException] | None, *details: object) -> None:
        if kind is None or was_there:
            return
        with suppress(OSError):  # the error is told, and what stays is no harm
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # no other shard is at work
            withdraw_store(path)
            if not folder_was_there:
                path.rmdir()

    return withdraw


def _file_of(folder: Path, shard: Shard) -> Path:
    return folder / f"{shard.index}-of-{shard.count}.lock"


def _hold(file: IO[str], kind: int, what: str) -> None:
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        holder = file.read().strip() or "another process"
        raise UserError(f"{what} is in use by {holder}: wait for it, or choose another --store.") from None


def _sign(file: IO[str], path: Path, words: str) -> None:
    with store.write_errors_explained(path):
        file.truncate(0)
        os.write(file.fileno(), f"{words}\n".encode())  # nothing is left to write when the file is closed


def others_at_work(path: Path, shard: Shard | None, own: str = "") -> list[str]:
    """Return the other shards, as texts i/n, that are being computed; the set-up must not be over yet.

    Raises
    ------
    UserError
        If they divide the chunks otherwise, so that some would be computed twice.
    """
    if shard is None:
        return []
    if isinstance(path, ObjectPath):
        found = sorted(holder.shard for holder in lease.others_of(path, own).values())
    else:
        folder = path / store.SHARDS
        files = [name for name in sorted(folder.glob("*-of-*.lock")) if name != _file_of(folder, shard)]
        found = [name.stem.replace("-of-", "/") for name in files if _is_held(name)]
    for other in found:
        if not other.endswith(f"/{shard.count}"):
            raise UserError(
                f"{path} is being computed in other shards ({other}), and yours is {shard}: wait for them, "
                "or divide it into as many."
            )
    return found


def _is_held(name: Path) -> bool:
    with name.open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False
