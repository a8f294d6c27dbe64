"""Random but constant misalignment and figures of surfaces, bodies and segments that are chosen by name."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.population import NonNegative
from wavequake.mechanics.disturbances.rigid import RigidSizes
from wavequake.mechanics.disturbances.source import Names, Randoms, Source, register
from wavequake.mechanics.disturbances.streams import Random

NollIndex = Annotated[int, Field(ge=4, le=2016, strict=False)]

_NANO = 1e-9


@register
class SurfaceRandom(Source):
    """Independent Gaussian misalignment of surfaces and bodies, constant over the instants of a case."""

    independent: ClassVar = "element"

    model: Literal["surface-random"] = "surface-random"
    instants: int = Field(default=1, ge=1, le=4096, description="all alike")
    of: Names = Field(
        description="names of surfaces, bodies and segments, or patterns such as A*; each moves for itself"
    )
    rms: RigidSizes = Field(description="dx_um, dy_um, dz_um, rx_urad, ry_urad, rz_urad of each element")

    def draw(self, layout: SegmentLayout, time: NDArray[np.float64], randoms: Randoms) -> Motion:
        """Draw six numbers for each element."""
        sizes = self.rms.si()
        moved = {
            name: np.tile(randoms(f"{self.name}/{name}").standard_normal(6) * sizes, (len(time), 1))
            for name in self.elements(layout)
        }
        return still(len(time), len(layout), rigid=moved)


@register
class SurfaceDeformation(Source):
    """Independent Gaussian figure errors of surfaces or segments, constant over the instants of a case."""

    independent: ClassVar = "element"

    model: Literal["surface-deformation"] = "surface-deformation"
    instants: int = Field(default=1, ge=1, le=4096, description="all alike")
    of: Names = Field(description="names of surfaces or segments, or patterns such as L*")
    rms_nm: dict[NollIndex, NonNegative] = Field(
        min_length=1,
        description="surface rms by Noll index j >= 4 over the radius that the surface deforms in: its "
        "normalization radius or semi-diameter, or else what the beams of all fields fill; of a segment its "
        "circumscribed circle, of a telescope's mirror its footprint on the axis",
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
