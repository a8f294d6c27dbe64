"""What the device's clock says of kernels."""

import time

import pytest

from wavequake.kernels.device import program
from wavequake.kernels.device.devices import list_devices
from wavequake.kernels.device.example import two_mirrors
from wavequake.kernels.device.launches import count_launch, device_seconds, kernel_launches, launches_since
from wavequake.kernels.trace.segmented import trace_segmented
from wavequake.prepared import preparation_seconds

OPENCL = [device for device in list_devices() if device.kind != "numpy"]


@pytest.mark.parametrize("device", OPENCL, ids=lambda device: device.kind)
def test_every_launch_is_counted_with_its_time(device):
    arguments = two_mirrors(tiles=40)
    trace_segmented(**arguments, device=device)
    before, start = kernel_launches(), time.perf_counter()
    for _ in range(3):
        trace_segmented(**arguments, device=device)
    clock = time.perf_counter() - start
    timings = launches_since(before)
    copied = {"bytes to device", "bytes from device"} if device.kind == "gpu" else set()
    assert timings.keys() - copied == {"kernel segmented", "launches segmented"}
    assert timings["launches segmented"] == 3
    assert 0.0 < timings["kernel segmented"] < clock
    assert launches_since(kernel_launches()) == {}


def test_a_driver_that_keeps_no_times_is_not_counted():
    import pyopencl as cl

    class Event:
        def get_profiling_info(self, what):
            raise cl.RuntimeError("CL_PROFILING_INFO_NOT_AVAILABLE")

    before = kernel_launches()
    count_launch("nothing", Event())
    assert kernel_launches() == before


@pytest.mark.parametrize("device", OPENCL, ids=lambda device: device.kind)
def test_building_a_kernel_is_preparation_but_not_its_first_run(device):
    arguments = two_mirrors(tiles=400)
    trace_segmented(**arguments, device=device)  # trusted, built
    before = preparation_seconds()
    trace_segmented(**arguments, device=device)
    assert preparation_seconds() == before
    program._kernel.cache_clear()
    program._program.cache_clear()
    run, start = device_seconds(), time.perf_counter()
    trace_segmented(**arguments, device=device)
    clock, run = time.perf_counter() - start, device_seconds() - run
    assert 0.0 < preparation_seconds() - before < clock - run
