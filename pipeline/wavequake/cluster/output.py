"""What worker processes print goes to a file that the run reads, never among the words of its command.

Libraries warn, threads die with tracebacks, and the C library has last words. Dask calls this in each worker
of this machine, also in those that are started again (its setting ``distributed.worker.preload``).
"""

import faulthandler
import io
import os
import sys
from typing import Any

OUTPUT = "WAVEQUAKE_WORKER_OUTPUT"
"""Environment variable: the file, which is there; without one, words of workers are lost."""


def redirect() -> None:
    """Have this process, C libraries included, print to the file; and where it is if it crashes."""
    try:
        handle = os.open(os.environ.get(OUTPUT, os.devnull), os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)
    except OSError:  # the store has moved
        handle = os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC)
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    os.close(handle)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)  # what is in a buffer dies with its process
    faulthandler.enable(all_threads=False)


def dask_setup(worker: Any) -> None:
    """Do so in a worker of Dask."""
    redirect()
