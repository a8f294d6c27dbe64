"""What all disturbances of a study file have in common."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

NonNegative = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]

MOST_ON_AXIS = 4096
"""Instants of a case, of what is not given over time by a file."""


class Population(BaseModel):
    """One population of cases: frozen, strict, unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$", description="also names its random numbers")
    duration_s: float = Field(default=0.1, gt=0, le=1e5, description="time that one case covers")
    instants: int = Field(
        default=16, ge=1, le=MOST_ON_AXIS, description="at (i + 1) duration / n; multiples of 16 fill tiles"
    )
    share: int = Field(
        default=1,
        ge=0,
        le=1000,
        description="rows it takes of the repeating pattern of cases; 0: only a part of combinations",
    )


def time_axis(population: Population) -> NDArray[np.float64]:
    """Return the instants (i + 1) duration / n in s, shape (n,).

    The last one is the end of the case, and t = 0, where a motion from rest is zero, is left out.
    """
    return population.duration_s * np.arange(1, population.instants + 1) / population.instants
