"""How many cases share a chunk: one task, one file of every array, and what a crash may cost a worker."""

from math import prod

import numpy as np

from wavequake.campaign.contract import Template

# Store and scheduler take some 20 ms of CPU time per chunk: the more cases share it the better. But workers
# end together only where there are many chunks for each or as many for all: few cases make eight.
_SOME, _MANY, _MOST = 20, 200, 400
_SOME_CHUNKS, _MANY_CHUNKS = 8, 40
_BYTES = 2**28  # of a chunk while it is computed; a worker has a few copies of what is stored


def default_chunk(cases: int, template: Template) -> int:
    """Return the number of cases per chunk of a new store.

    It is an eighth of the cases, from 20 to 200, or where that is more a fortieth, up to 400; fewer where a
    chunk would take more than 256 MB.
    """
    eighth = min(max(_SOME, -(-cases // _SOME_CHUNKS)), _MANY)
    fortieth = min(-(-cases // _MANY_CHUNKS), _MOST)
    fitting = _BYTES // max(1, template.working_bytes, stored_bytes(template))
    return max(1, min(max(eighth, fortieth), fitting))


def stored_bytes(template: Template) -> int:
    """Return the bytes that a store keeps of each case."""
    return sum(prod(one.shape) * np.dtype(one.dtype).itemsize for one in template.per_case.values())
