"""Why a ray is lost: one table for all traces, on the host as in ``kernels/status.h``."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

OK = 0
VIGNETTED = 1  # hits the surface outside its aperture
MISS = 2  # does not hit the surface
TOTAL_REFLECTION = 3
DIVERGED = 4  # the iteration finds no point of the surface: it folds over
GAP = 5  # meets the glass of no segment
NO_ORDER = 6  # its order of diffraction leaves at no real angle

_REASONS = 8
MOST_SURFACES = 127 // _REASONS - 1  # after M1, of which a status of 8 bits can tell

Codes = TypeVar("Codes", int, NDArray[np.int8])


def lost_at(reason: int, surface: int) -> int:
    """Return the status of a ray that is lost at a surface after a segmented mirror (-1: at the mirror)."""
    return reason + _REASONS * (surface + 1)


def surface_of(status: Codes) -> Codes:
    """Return at which surface after the segmented mirror rays are lost (-1: at it, or nowhere)."""
    return status // _REASONS - 1
