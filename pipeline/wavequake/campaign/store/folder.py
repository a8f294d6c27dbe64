"""The folder of a store: the names in it, and what is said when it cannot be written."""

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from wavequake.campaign.store.fence import CLAIMS, FENCE, WRITERS
from wavequake.campaign.store.lease import BEATS
from wavequake.campaign.store.objects import ObjectPath, remove
from wavequake.errors import UserError

MANIFEST, DATA, JOURNAL, LOCK, REPORT = "manifest.json", "data.zarr", "done", "lock", "report.html"
SENSITIVITY, BUDGET, LOG, SHARDS = "sensitivity.zarr", "budget.zarr", "log", "shards"
ERRORS = "errors.zarr"


@contextmanager
def write_errors_explained(path: Path) -> Iterator[None]:
    """Turn the errors of a disk that is full or cannot be written into one sentence for the user."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise UserError(
                f"The disk of {path} is full: what is done is kept; free some space (or some of its files) "
                "and repeat the command."
            ) from None
        if error.errno == errno.ENOENT and not os.path.exists(path):
            raise UserError(
                f"{path} is no longer there: if it was moved, what is done is kept; repeat the command with "
                "--store and its new place."
            ) from None
        if error.errno in (
            errno.EROFS,
            errno.EACCES,
            errno.EPERM,
            errno.ENOTDIR,
            errno.EEXIST,
            errno.ENOENT,
            errno.ENAMETOOLONG,
        ):
            reason = os.strerror(error.errno).lower()
            raise UserError(
                f"{path} cannot be written ({reason}): choose another folder with --store."
            ) from None
        raise


def refuse_foreign(path: Path) -> None:
    """Raise UserError if `path` is a file, or a folder of something else than a store."""
    with write_errors_explained(path):
        names = sorted(file.name for file in path.iterdir()) if path.exists() else []
    if not names or MANIFEST in names:
        return
    # Where we wrote data, we had made the journal's folder before, and of objects the fence: other data are
    # somebody else's.
    marked = JOURNAL in names or (isinstance(path, ObjectPath) and FENCE in names)
    ours = [
        MANIFEST,
        JOURNAL,
        LOCK,
        REPORT,
        SENSITIVITY,
        BUDGET,
        ERRORS,
        LOG,
        SHARDS,
        FENCE,
        WRITERS,
        CLAIMS,
        BEATS,
    ]
    ours += [DATA] if marked else []
    foreign = [name for name in names if name.split(".partial")[0] not in ours]
    if DATA in names and any((path / JOURNAL).glob("*.jsonl")):
        raise UserError(
            f"{path} has results but no {MANIFEST}: put that file back, or choose another --store."
        )
    if foreign:
        raise UserError(
            f"{path} is not a store: it holds {foreign[0]!r}, no {MANIFEST}; choose another --store."
        )


def withdraw(path: Path) -> None:
    """Remove a store in which nothing was computed; its folder stays."""
    if any((path / JOURNAL).glob("*.jsonl")):
        return
    (path / MANIFEST).unlink(missing_ok=True)
    if isinstance(path, ObjectPath):
        remove(path)
        return
    for name in (DATA, JOURNAL, LOG, SHARDS):  # the journal's folder says that the data were ours
        shutil.rmtree(path / name, ignore_errors=True)
    for name in (FENCE, WRITERS, LOCK):
        (path / name).unlink(missing_ok=True)
