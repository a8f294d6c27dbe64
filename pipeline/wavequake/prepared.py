"""What all cases share is prepared once per process, and on one thread of BLAS.

How many threads BLAS has decides the last bits of its results (eigenvectors of a pair of equal modes turn
by any angle), so that a campaign would depend on where it runs. A preparation may be asked for first by the
plan, a report or a user's script, with all threads: it is guarded here, not where cases are computed.
"""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, wraps
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

Function = TypeVar("Function", bound=Callable[..., Any])

_this = threading.local()


@contextmanager
def one_thread() -> Iterator[None]:
    """Give BLAS one thread, and in the end as many as it had; where a thread enters again, do nothing.

    A thread that is given up may never leave: each restores what it found, and waits for no other.
    """
    if getattr(_this, "entered", False):
        yield
        return
    import scipy.linalg  # noqa: F401 - its BLAS can be limited only once it is loaded

    _this.entered = True
    try:
        with _libraries(len(sys.modules)).limit(limits=1):
            yield
    finally:
        _this.entered = False


@lru_cache(maxsize=1)
def _libraries(modules: int) -> ThreadpoolController:
    """Return the libraries whose threads can be limited, when so many modules are loaded.

    Looking for them takes 3 ms and more; new ones come with modules.
    """
    return ThreadpoolController()


@contextmanager
def preparing() -> Iterator[None]:
    """Count the time of what is done within as preparation; where it is entered again, once."""
    if getattr(_this, "preparing", False):
        yield
        return
    _this.preparing, start = True, time.perf_counter()
    try:
        yield
    finally:
        _this.preparing = False
        count_preparation(time.perf_counter() - start)


def count_preparation(seconds: float) -> None:
    """Count seconds as preparation, unless they are part of what is counted anyhow."""
    if not getattr(_this, "preparing", False):
        _this.spent = preparation_seconds() + seconds


def preparation_seconds() -> float:
    """Return how long this thread has prepared so far what all cases share: models, tables, kernels.

    Of its time by the clock that is a part, never more: what other threads prepare meanwhile is theirs.
    """
    return float(getattr(_this, "spent", 0.0))


def prepared(maxsize: int | None) -> Callable[[Function], Function]:
    """Keep the last `maxsize` results of a function, as `lru_cache` does; it computes with `one_thread`."""

    def kept(function: Function) -> Function:
        @wraps(function)
        def alone(*arguments: Any, **keys: Any) -> Any:
            with one_thread(), preparing():
                return function(*arguments, **keys)

        return lru_cache(maxsize)(alone)  # type: ignore[return-value]

    return kept
