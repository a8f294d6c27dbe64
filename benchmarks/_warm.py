"""Run a job until its processors run at their full rate."""

import time
from collections.abc import Callable

SECONDS = 0.1


def warm(job: Callable[[], object]) -> None:
    """Run a job for 0.1 s, untimed, whoever's it is.

    Kernels run in a thread of their own. A processor that slept while others computed, a virtual one above
    all, takes so long to run as fast as before: for that time a transform took twice as long.
    """
    end = time.perf_counter() + SECONDS
    while time.perf_counter() < end:
        job()
