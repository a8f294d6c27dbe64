"""PoCL's threads have CPUs of their own where they are as many, and are left alone where they are fewer."""

import json
import os
import subprocess
import sys

import pytest

from wavequake.kernels.device import threads
from wavequake.kernels.device.devices import POCL, list_devices

CPUS = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
SCRIPT = """
import json, os
from wavequake.kernels.device.threads import running_threads
before = running_threads()
from wavequake.kernels.device.devices import list_devices
list_devices()
new = running_threads() - before
print(json.dumps([[sorted(os.sched_getaffinity(t)) for t in some] for some in ([0, *before], new)]))
"""


def affinities(count):
    """The CPUs of a process' threads before it looks for devices, and of those that PoCL starts."""
    limits = {"POCL_MAX_PTHREAD_COUNT": str(count), "POCL_CPU_MAX_CU_COUNT": str(count)}
    limits |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    environment = {key: value for key, value in os.environ.items() if key != "POCL_AFFINITY"} | limits
    ran = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, check=True)
    return json.loads(ran.stdout)


@pytest.mark.skipif(
    len(CPUS) < 2 or POCL not in {device.platform for device in list_devices()},
    reason="needs PoCL and two CPUs whose threads can be placed",
)
def test_as_many_threads_as_cpus_have_one_each_and_fewer_are_free():
    callers, workers = affinities(len(CPUS))
    assert all(places == CPUS for places in callers)
    assert sorted(workers) == [[cpu] for cpu in CPUS]
    callers, workers = affinities(1)
    assert all(places == CPUS for places in callers + workers)


def test_threads_are_placed_only_if_each_has_a_cpu(monkeypatch):
    placed = {}
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {4, 6}, raising=False)
    monkeypatch.setattr(os, "sched_setaffinity", placed.__setitem__, raising=False)
    for some in (set(), {11}, {11, 12, 13}):
        threads.pin_each(some)
    assert placed == {}
    threads.pin_each({12, 11})
    assert placed == {11: {4}, 12: {6}}


def test_threads_that_cannot_be_placed_are_left_to_the_system(monkeypatch, tmp_path):
    def refuse(thread, cpus):
        raise PermissionError("not here")

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0}, raising=False)
    monkeypatch.setattr(os, "sched_setaffinity", refuse, raising=False)
    threads.pin_each({11})
    monkeypatch.delattr(os, "sched_setaffinity")
    threads.pin_each({11})
    monkeypatch.setattr(threads, "_TASKS", tmp_path / "none")
    assert threads.running_threads() == set()
