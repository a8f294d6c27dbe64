"""Tables that take long to make are kept on disk, by a digest of all that determines them.

Workers of a campaign, and later runs, load what the first has made. The files lie in the user's cache folder
and may be removed at any time; the oldest go when there are more than a gigabyte. A damaged one is made anew.
"""

import hashlib
import os
import tempfile
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import scipy
from platformdirs import user_cache_path
from threadpoolctl import threadpool_info

Table = TypeVar("Table")

_MOST_BYTES = 1_000_000_000


def table_folder() -> Path:
    """Return the folder of kept tables."""
    return user_cache_path("wavequake") / "tables"


def kept(kind: type[Table], make: Callable[..., Table], *arguments: Any, **keys: Any) -> Table:
    """Return ``make(*arguments, **keys)``, from disk if this code has made it before on such a processor.

    Parameters
    ----------
    kind : type
        A frozen dataclass of arrays, numbers and texts, which `make` returns.
    make : callable
        A function of a module, which depends on its arguments alone.
    arguments, keys
        Arrays, or what has a `repr` that says all of it.
    """
    named = [part for item in sorted(keys.items()) for part in item]
    known_by = _makers(), make.__module__, make.__qualname__, *arguments, *named
    return kept_by(kind, make.__name__, known_by, lambda: make(*arguments, **keys))


def kept_by(kind: type[Table], name: str, known_by: Iterable[Any], make: Callable[[], Table]) -> Table:
    """Return ``make()``, from disk where its `name` and all that it is `known_by` have been kept together.

    `known_by` says all that decides the result, also the version of the code where that does.
    """
    file = table_folder() / f"{name}-{_digest(known_by)}.npz"
    try:
        with np.load(file, allow_pickle=False) as found:  # zip files check what they hold
            values = {one.name: found[one.name] for one in fields(kind)}  # type: ignore[arg-type]
        os.utime(file)
    except (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile):
        made = make()
        _write(file, {one.name: np.asarray(getattr(made, one.name)) for one in fields(kind)})  # type: ignore[arg-type]
        return made
    return kind(**{name: value if value.ndim else value.item() for name, value in values.items()})


def _digest(known_by: Iterable[Any]) -> str:
    total = hashlib.sha256()
    for number, one in enumerate(known_by):
        total.update(repr(number).encode())
        if isinstance(one, np.ndarray):
            total.update(repr((one.dtype.str, one.shape)).encode() + np.ascontiguousarray(one).tobytes())
        else:
            total.update(repr(one).encode())
    return total.hexdigest()


@cache
def _makers() -> tuple[Any, ...]:
    """Return what decides the last bits of a table: this package, its libraries, and the kernels of BLAS."""
    package = Path(__file__).parent
    sources = sorted(
        (one.relative_to(package).as_posix(), (found := one.stat()).st_size, found.st_mtime_ns)
        for one in package.rglob("*.py")
    )
    kernels = sorted({str(one.get("architecture")) for one in threadpool_info()})
    return np.__version__, scipy.__version__, kernels, sources


def _write(file: Path, arrays: dict[str, Any]) -> None:
    """Keep a table, all or nothing; a full or read-only disk costs only the time of making it again."""
    partial = None
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=file.parent, suffix=".partial", delete=False) as opened:
            partial = Path(opened.name)
            np.savez(opened, **arrays)
        partial.replace(file)
        _forget_the_oldest(file.parent)
    except OSError:
        if partial is not None:
            partial.unlink(missing_ok=True)


def _forget_the_oldest(folder: Path) -> None:
    """Keep a folder below its bound; what another process removes meanwhile is no error."""
    found = sorted(((one, one.stat()) for one in folder.iterdir()), key=lambda one: -one[1].st_mtime_ns)
    total = 0
    for path, facts in found:
        total += facts.st_size
        if total > _MOST_BYTES:
            path.unlink(missing_ok=True)
