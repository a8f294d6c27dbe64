"""What the sections of a study file that describe optics have in common."""

from math import isinf
from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

MM_PER_NM = 1e-6


class FileSection(BaseModel):
    """A part of a study file: unknown keys and numbers that are not finite are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)


Pair = Annotated[tuple[float, float], Field(strict=False)]
Radius = Annotated[
    float | None, BeforeValidator(lambda given: None if isinstance(given, float) and isinf(given) else given)
]
"""In mm; None and inf are a plane."""
