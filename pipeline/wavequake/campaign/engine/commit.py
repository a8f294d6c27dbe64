"""The order in which a chunk enters a store, apart from the disk, which a simulation replaces."""

from collections.abc import Iterator
from typing import Protocol


class Disk(Protocol):
    """What a writer asks of a store for one chunk; the fence's lock is held while it does."""

    def admit(self) -> None:
        """Raise ShutOutError if a later run has begun."""
        ...

    def is_recorded(self) -> bool:
        """Whether this very run has a record of the chunk: by a worker that was believed to be lost."""
        ...

    def is_begun(self) -> bool:
        """Whether data of the chunk are there, of whatever run."""
        ...

    def reopen(self) -> None:
        """Append to the journal that the data are about to change, which no earlier record knows."""
        ...

    def write(self) -> Iterator[None]:
        """Write the files of every array, the status last; each step may be the last one before a death."""
        ...

    def append(self) -> None:
        """Append the record of what was written."""
        ...


def commit(disk: Disk) -> Iterator[None]:
    """Write a chunk and then its record, in steps between which a process may die or be stopped.

    Whether the run may still write is asked before each: a file system may have no locks. The first record of
    a chunk in a run stands. Data that change are opened in the journal before, or after a death in the middle
    an earlier record would speak of them.
    """
    disk.admit()
    yield
    if disk.is_recorded():
        return
    if disk.is_begun():
        disk.reopen()
        yield
    yield from disk.write()
    disk.admit()
    yield
    disk.append()
