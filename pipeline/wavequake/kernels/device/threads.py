"""Give the threads of an OpenCL processor CPUs of their own."""

import os
import threading
from pathlib import Path

_TASKS = Path("/proc/self/task")


def available_cpus() -> int:
    """Return how many CPUs this process may use; where the system does not tell, how many there are."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def running_threads() -> set[int]:
    """Return the threads of this process that are not Python's, as Linux numbers them; elsewhere none."""
    own = {thread.native_id for thread in threading.enumerate()}
    try:
        return {int(task.name) for task in _TASKS.iterdir()} - own
    except OSError:
        return set()


def pin_each(threads: set[int]) -> None:
    """Keep each thread on a CPU of its own, if there are as many as this process may use.

    All wake at once when work comes, while the thread that sends it still runs: Linux then puts two of them
    on one CPU and parts them some milliseconds later, when most launches are over. Fewer threads than CPUs
    are left alone, since other processes have theirs.
    """
    if not hasattr(os, "sched_setaffinity"):
        return
    cpus = os.sched_getaffinity(0)
    if len(threads) != len(cpus):
        return
    for thread, cpu in zip(sorted(threads), sorted(cpus), strict=True):
        try:
            os.sched_setaffinity(thread, {cpu})
        except OSError:  # it has ended, or a container forbids it: then the system places it
            return
