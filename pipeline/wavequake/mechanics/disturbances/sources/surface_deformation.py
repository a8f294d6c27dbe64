"""Random but constant figures of surfaces and segments that are chosen by name."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.population import NonNegative
from wavequake.mechanics.disturbances.source import Names, Randoms, Source, register
from wavequake.mechanics.disturbances.streams import Random

NollIndex = Annotated[int, Field(ge=4, le=2016, strict=False)]

_NANO = 1e-9


@register
class SurfaceDeformation(Source):
    """Independent Gaussian figure errors of surfaces, constant over the instants of a case."""

    fits: ClassVar = ("surfaces",)
    independent: ClassVar = "element"

    model: Literal["surface-deformation"] = "surface-deformation"
    instants: int = Field(default=1, ge=1, le=4096, description="all alike")
    of: Names = Field(description="names of surfaces, or patterns such as L*")
    rms_nm: dict[NollIndex, NonNegative] = Field(
        min_length=1,
        description="surface rms by Noll index j >= 4 over the radius that the surface deforms in: its "
        "normalization radius or semi-diameter, or else what the beams of all fields fill",
    )

    def draw(self, layout: SegmentLayout, time: NDArray[np.float64], randoms: Randoms) -> Motion:
        """Draw the coefficients of each surface."""
        figures = {name: _figure(self, randoms(f"{self.name}/{name}")) for name in self.elements(layout)}
        return still(len(time), len(layout), figure=figures)

    def figure_terms(self, layout: SegmentLayout) -> dict[str, int]:
        """Return the highest index, for each surface."""
        return dict.fromkeys(self.elements(layout), max(self.rms_nm))


def _figure(part: SurfaceDeformation, random: Random) -> NDArray[np.float64]:
    terms = max(part.rms_nm)
    rms = np.array([part.rms_nm.get(noll, 0.0) * _NANO for noll in range(1, terms + 1)])
    return np.asarray(random.standard_normal(terms) * rms)
