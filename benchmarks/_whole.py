"""Whole commands: processor time of all their processes, those of workers included, and wall time."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

# Workers are forked from a process that nobody waits for: as a "subreaper" this one inherits them all.
_COUNT = """
import ctypes, json, os, resource, subprocess, sys, time
ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)
begun = time.perf_counter()
code = subprocess.run(sys.argv[1:], stdout=sys.stderr).returncode
wall = time.perf_counter() - begun
while True:
    try:
        os.wait()
    except ChildProcessError:
        break
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps([used.ru_utime + used.ru_stime, wall, code]))
"""


class Spent(NamedTuple):
    """Seconds of processor time of all processes, and by the clock."""

    cpu: float
    wall: float


def _as_users_have_it(environment: Mapping[str, str] | None) -> dict[str, str]:
    """Return an environment in which Python keeps what it compiles: half a second less per process."""
    given = os.environ if environment is None else environment
    return {key: value for key, value in given.items() if key != "PYTHONDONTWRITEBYTECODE"}


def spent(command: Sequence[str], environment: Mapping[str, str] | None = None) -> Spent:
    """Run a command to its end and return what it took.

    Raises
    ------
    RuntimeError
        If it fails.
    """
    counting = [sys.executable, "-c", _COUNT, *command]
    ran = subprocess.run(
        counting, env=_as_users_have_it(environment), capture_output=True, text=True, check=True
    )
    cpu, wall, code = json.loads(ran.stdout)
    if code:
        raise RuntimeError(f"{' '.join(command)} ended with exit code {code}: {ran.stderr[-500:]}")
    return Spent(cpu, wall)


def until(command: Sequence[str], there: Callable[[], bool], folder: Path) -> float:
    """Start a command, return the seconds until something is there, and let it end."""
    begun = time.perf_counter()
    clean = _as_users_have_it(None)
    with (
        (folder / "output").open("w") as output,
        subprocess.Popen(command, env=clean, stdout=output) as process,
    ):
        while not there() and process.poll() is None:
            time.sleep(0.01)
        found = time.perf_counter() - begun
        if process.wait():
            raise RuntimeError(f"{' '.join(command)} ended with exit code {process.returncode}")
    return found
