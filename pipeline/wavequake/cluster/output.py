"""What worker processes print goes to files that the run reads, never among the words of its command.

Each process has a file of its own, so that lines that are written in pieces do not mix. Libraries warn,
threads die with tracebacks, and the C library has last words. Dask calls this in each worker of this
machine, also in those that are started again (its setting ``distributed.worker.preload``).
"""

import faulthandler
import io
import os
import sys
from typing import Any

OUTPUT = "WAVEQUAKE_WORKER_OUTPUT"
"""Environment variable: a folder that is there, for a file per process; without one, their words are lost."""


def redirect() -> None:
    """Have this process, C libraries included, print to its file; and where it is if it crashes."""
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
    try:
        handle = os.open(os.path.join(os.environ.get(OUTPUT, os.devnull), str(os.getpid())), flags, 0o666)
    except OSError:  # there is no folder, or the store has moved
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
