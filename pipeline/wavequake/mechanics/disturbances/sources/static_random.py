"""Random but constant misalignment and figure of the segments: what alignment and polishing leave behind."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.mechanics.disturbances.motion import Motion, still
from wavequake.mechanics.disturbances.population import NonNegative
from wavequake.mechanics.disturbances.source import Randoms, SegmentSource, register
from wavequake.mechanics.disturbances.streams import Random

NollIndex = Annotated[int, Field(ge=4, le=66, strict=False)]


@register
class StaticRandom(SegmentSource):
    """Independent random rigid motion and figure of every segment, constant over the instants of a case."""

    independent: ClassVar = "element"

    model: Literal["static-random"] = "static-random"
    piston_nm: float = Field(default=0.0, ge=0, description="rms of dz along the segment's normal")
    piston_distribution: Literal["gaussian", "uniform"] = Field(
        default="gaussian", description="uniform: between -sqrt(3) and +sqrt(3) times piston_nm"
    )
    tip_nrad: float = Field(default=0.0, ge=0, description="rms of rx, about the segment's local x axis")
    tilt_nrad: float = Field(default=0.0, ge=0, description="rms of ry, about the segment's local y axis")
    in_plane_um: float = Field(default=0.0, ge=0, description="rms of dx and of dy")
    clocking_urad: float = Field(default=0.0, ge=0, description="rms of rz, about the segment's normal")
    figure_nm: dict[NollIndex, NonNegative] = Field(
        default={},
        description="surface rms by Noll index j >= 4, over the segment's circumscribed circle; "
        "exposures of figured segments are sums over rays",
    )

    def draw(self, layout: SegmentLayout, time: NDArray[np.float64], randoms: Randoms) -> Motion:
        """Draw one realization."""
        return draw_static(self, layout, time, randoms(self.name))

    def analytic_rms(self, layout: SegmentLayout) -> tuple[float, Literal["mas", "nm"]]:
        """Return that of the pistons."""
        return self.piston_nm, "nm"


def draw_static(
    parameters: StaticRandom, layout: SegmentLayout, time: NDArray[np.float64], generator: Random
) -> Motion:
    """Draw one misalignment and figure.

    Every number is drawn whether its rms is zero or not: changing one rms leaves the other draws alone.
    """
    count = len(layout)
    unit = generator.standard_normal((count, 6))
    uniform_piston = generator.uniform(-np.sqrt(3.0), np.sqrt(3.0), count)
    if parameters.piston_distribution == "uniform":
        unit[:, 2] = uniform_piston
    in_plane = parameters.in_plane_um * 1e-6
    rms = np.array(
        [
            in_plane,
            in_plane,
            parameters.piston_nm * 1e-9,
            parameters.tip_nrad * 1e-9,
            parameters.tilt_nrad * 1e-9,
            parameters.clocking_urad * 1e-6,
        ]
    )
    terms = max(parameters.figure_nm, default=0)
    motion = still(len(time), count, terms)
    motion.segment_motion[:] = unit * rms
    figure_rms = np.array([parameters.figure_nm.get(noll, 0.0) * 1e-9 for noll in range(1, terms + 1)])
    motion.segment_figure[:] = generator.standard_normal((terms, count)).T * figure_rms
    return motion
