"""Have Dask wait by a clock that nobody sets.

Dask hands in messages at most every 2 ms, and looks at its workers every few seconds, by the time of day. Put
back by an hour between two messages, that clock holds the second one, and a campaign, for that hour. Dask
calls this in each process before it joins the others (its settings ``distributed.*.preload``).
"""

import time
from typing import Any

import distributed.batched
from tornado.ioloop import IOLoop

_BEGUN = time.time() - time.monotonic()


def now() -> float:
    """Return the time of day, in seconds, as if nobody had set the clock since this process started."""
    return _BEGUN + time.monotonic()


def keep_time() -> None:
    """Have the event loops and streams of Dask in this process go by `now`."""
    IOLoop.time = lambda loop: now()  # type: ignore[method-assign, assignment]
    distributed.batched.time = now


def dask_setup(server: Any) -> None:
    """Have `server`, a scheduler or worker, and all in its process keep time."""
    keep_time()
