import re

from wavequake.files import folder
from wavequake.kernels.program import source


def test_headers_are_pasted_into_the_source_that_binaries_are_cached_by():
    text = source("segmented.cl")
    assert "#include" not in text
    for header in folder("kernels").glob("*.h"):
        assert header.read_text(encoding="utf-8") in text


def test_lanes_call_no_built_in_functions():
    code = re.sub(r"//.*", "", source("segmented.cl"))
    assert not re.search(r"\b(fabs|fma|mad|select|isnan|isfinite|copysign|rsqrt|fmin|fmax)\(", code)
