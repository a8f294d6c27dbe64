import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from wavequake.files import folder
from wavequake.kernels.device import program
from wavequake.kernels.device.devices import NUMPY, list_devices
from wavequake.kernels.device.program import aligned_empties, aligned_empty, launch, source, watch


def test_headers_are_pasted_into_the_source_that_binaries_are_cached_by():
    text = source("segmented.cl")
    assert "#include" not in text
    raw = (folder("kernels") / "segmented.cl").read_text(encoding="utf-8")
    headers = re.findall(r'#include "(.+)"', raw)
    assert len(headers) >= 2
    for header in headers:
        assert (folder("kernels") / header).read_text(encoding="utf-8") in text


def test_lanes_call_no_built_in_functions():
    code = re.sub(r"//.*", "", source("segmented.cl"))
    assert not re.search(r"\b(fabs|fma|mad|select|isnan|isfinite|copysign|rsqrt|fmin|fmax)\(", code)


def test_new_arrays_begin_with_a_page():
    for shape, dtype in (((3, 5), np.float64), ((7,), np.int8), ((0, 4), np.float64)):
        array = aligned_empty(shape, dtype)
        assert (array.shape, array.dtype) == (shape, dtype)
        assert array.ctypes.data % 4096 == 0 or array.size == 0
        assert array.flags.c_contiguous


@pytest.mark.parametrize(("count", "shared"), [(2000, True), (1, True), (0, True), (100_000, False)])
def test_arrays_that_are_written_together_begin_with_pages_of_their_own(count, shared):
    dtypes = [np.float64, np.int8, np.float64, np.int8]
    arrays = aligned_empties((2, count), dtypes)
    for number, (array, dtype) in enumerate(zip(arrays, dtypes, strict=True)):
        assert (array.shape, array.dtype, array.flags.c_contiguous) == ((2, count), dtype, True)
        assert array.ctypes.data % 4096 == 0 or not count
        array[:] = number
    assert [set(array.ravel()) for array in arrays] == [{n} if count else set() for n in range(4)]
    # Of large ones each goes by itself: who keeps the codes does not keep the rays.
    assert (arrays[0].base is arrays[1].base) is shared


@pytest.mark.parametrize(
    ("kind", "statuses", "glances"),
    [("cpu", [3, 2, 1, 0], 4), ("cpu", [2, -36], 2), ("cpu", [1] * 2000, 1000), ("gpu", [3], 0)],
)
def test_short_work_is_watched_until_it_ends_or_fails_or_lasts(kind, statuses, glances):
    pytest.importorskip("pyopencl")
    seen = []

    class Event:
        @property
        def command_execution_status(self):
            seen.append(statuses[len(seen)])
            return seen[-1]

    watch(SimpleNamespace(flush=lambda: None), replace(NUMPY, kind=kind), Event())
    assert len(seen) == glances


SLOW = """
__kernel void slow(const int rounds, __global float *out)
{
    float sum = get_global_id(1);
    for (int k = 0; k < rounds; ++k)
        sum = 0.5f * sum + 1.0f;
    out[get_global_id(1)] = sum;
}
"""


@pytest.mark.parametrize("device", list_devices(), ids=lambda device: device.kind)
def test_what_is_interrupted_leaves_no_kernel_behind_that_writes_to_arrays(device, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    if device == NUMPY:
        pytest.skip("NumPy has no queue")
    monkeypatch.setattr(program, "watch", interrupt)
    out = aligned_empty((16,), np.float32)
    out[:] = 0
    if device.kind != "cpu":
        monkeypatch.setattr(program, "_fetch", interrupt)
    with pytest.raises(KeyboardInterrupt):
        launch(device, "slow", (), (1, 16, 1), [np.int32(10**8)], [out], text=SLOW, group=16)
    if device.kind == "cpu":
        np.testing.assert_array_equal(out, 2)  # the limit of the sum: the kernel had ended
