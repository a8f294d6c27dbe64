"""A deformable M2."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.chain.loops.block import Actuator, register
from wavequake.chain.loops.light import Light
from wavequake.optics.polynomials.zernike import MOST_TERMS
from wavequake.optics.segments.telescope import M2
from wavequake.optics.systems.system import States

MM_PER_NM = 1e-6


@register
class DeformableM2(Actuator):
    """Zernike deformations of M2 in nm, Noll 2 and up over the beam's footprint (Störkle 2018, Eq. 4.26)."""

    model: Literal["m2-figure"] = "m2-figure"
    terms: int = Field(default=105, ge=2, le=MOST_TERMS, description="highest Noll index")

    @property
    def mirror_terms(self) -> int:
        """Noll terms by which it deforms M2."""
        return self.terms

    def channels(self, light: Light) -> tuple[str, ...]:
        """Return Z2, Z3, ..."""
        return tuple(f"Z{j}" for j in range(2, self.terms + 1))

    def put(self, light: Light, states: States, positions: NDArray[np.float64]) -> None:
        """Add positions to the figure of M2."""
        figure = states.deformations[M2]
        assert figure is not None
        figure[: len(positions), 1 : self.terms] += positions * MM_PER_NM
