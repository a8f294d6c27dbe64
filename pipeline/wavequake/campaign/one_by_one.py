"""Chunks of cases that are computed one after the other."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from wavequake.campaign.contract import DONE, RAISED, ChunkResult, Variable
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.errors import UserError


def unknown_arrays(variables: Mapping[str, Variable], cases: int) -> dict[str, NDArray[Any]]:
    """Return arrays (case, ...) of which nothing is known: NaN, or 0 where they are of whole numbers."""
    blank = {name: np.nan if np.dtype(one.dtype).kind in "fc" else 0 for name, one in variables.items()}
    return {name: np.full((cases, *one.shape), blank[name], one.dtype) for name, one in variables.items()}


def one_by_one(
    variables: Mapping[str, Variable],
    cases: NDArray[np.int64],
    compute: Callable[[int], Mapping[str, ArrayLike]],
    clock: Stopwatch | None = None,
) -> ChunkResult:
    """Compute cases one by one; one that raises a UserError is quarantined with its sentence.

    On one BLAS thread, so that a case's bits do not depend on where it is computed. A case may know fewer
    instants than there is room for; the others stay unknown.
    """
    arrays = unknown_arrays(variables, len(cases))
    status, messages = np.full(len(cases), DONE, dtype=np.int8), [""] * len(cases)
    with threadpool_limits(1):
        for row, case in enumerate(cases.tolist()):
            try:
                found = compute(case)
            except UserError as error:
                status[row], messages[row] = RAISED, str(error)
                continue
            for name, values in found.items():
                place: tuple[int | slice, ...] = (row, *(slice(length) for length in np.shape(values)))
                arrays[name][place] = values
    return ChunkResult(arrays, status, tuple(messages), {} if clock is None else clock.seconds)
