import re

import numpy as np

from wavequake.files import folder
from wavequake.kernels.program import aligned_empty, source


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
