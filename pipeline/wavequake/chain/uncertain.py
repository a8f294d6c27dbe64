"""What of modes is not known, as study files say it, and which cases share a model of them."""

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.campaign.schema import Section

STREAM = "~structure"  # no disturbance can have this name


class UncertainModes(Section):
    """How far frequencies and damping ratios may be off: they are log-normal."""

    frequency: float = Field(
        default=0.0, ge=0, le=0.5, description="of each mode: standard deviation of its logarithm"
    )
    damping: float = Field(default=0.0, ge=0, le=2, description="the same of each damping ratio")
    repeats: int = Field(
        default=2,
        ge=1,
        le=1000,
        description="cases of a disturbance that share a model: two or more let reports part the variance "
        "into excitation and model",
    )


def require_independent_sets(uncertain: UncertainModes | None, sampling: str) -> None:
    """Raise ValueError if cases share models and are stratified at once."""
    if uncertain is not None and uncertain.repeats > 1 and sampling != "random":
        raise ValueError(
            "cases that share a model (structure.uncertain.repeats) are no independent sets; take "
            'campaign.sampling = "random", or structure.uncertain.repeats = 1'
        )


def shared_models(
    uncertain: UncertainModes | None, realizations: NDArray[np.int64]
) -> dict[str, NDArray[np.int64]]:
    """Return the column that says which cases share a model: they are a set that is independent of others."""
    if uncertain is None or uncertain.repeats == 1:
        return {}
    return {"replicate": realizations // uncertain.repeats}
