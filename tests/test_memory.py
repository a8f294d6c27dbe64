"""Whether the memory of freed arrays is used again, by the page faults that the system counts."""

import os
import platform
import subprocess
import sys

import pytest

from wavequake.memory import keep_freed_memory

ARRAYS, PAGES = 200, 244  # 10^6 bytes each

COUNTED = f"""
import resource, sys
import numpy as np
from wavequake.memory import keep_freed_memory
if len(sys.argv) > 1:
    keep_freed_memory()
np.ones(125_000)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range({ARRAYS}):
    np.ones(125_000)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(*arguments):
    environment = os.environ | {"MALLOC_TRIM_THRESHOLD_": "65536"}  # as Dask sets it in its workers
    command = [sys.executable, "-c", COUNTED, *arguments]
    return int(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="this system's C library is not glibc")
def test_freed_arrays_are_used_again():
    assert faults() > 0.9 * ARRAYS * PAGES
    assert faults("keep") < 2 * PAGES


@pytest.mark.parametrize("error", [AttributeError, OSError, TypeError])
def test_systems_without_glibc_are_left_as_they_are(monkeypatch, error):
    def missing(name):
        raise error

    monkeypatch.setattr("ctypes.CDLL", missing)
    keep_freed_memory.__wrapped__()
