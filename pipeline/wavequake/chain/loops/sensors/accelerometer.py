"""Accelerometers on segments, M2 and points of the structure."""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.chain.loops.block import register
from wavequake.chain.loops.light import Light
from wavequake.chain.loops.sensors.displacement import OfBodies
from wavequake.control.sampled.channel import Dynamics, acceleration, first_order, in_series


@register
class Accelerometers(OfBodies):
    """Accelerations of segments along or about their own axes, of M2 or of points, in m/s^2 and rad/s^2.

    A proof mass on a spring shows them up to its resonance. It sees no constant and hardly any slow motion.
    """

    units: ClassVar[str] = "m/s^2"

    model: Literal["accelerometer"] = "accelerometer"
    resonance_hz: float = Field(default=500.0, ge=1e-3, le=1e6, description="of its proof mass")
    damping: float = Field(default=0.7, gt=0, le=10, description="damping ratio of the resonance")

    def dynamics(self) -> Dynamics:
        """Return how its proof mass, and its electronics if they are slow, follow an acceleration."""
        mass = acceleration(self.resonance_hz, self.damping)
        return mass if self.bandwidth_hz is None else in_series(mass, first_order(self.bandwidth_hz))

    def matrix(self, light: Light, nominal: bool = False) -> NDArray[np.float64]:
        """Return readings per motion of bodies in nm and nrad, each twice derived, (m, 3 S + 6 + N)."""
        return 1e-9 * super().matrix(light, nominal)
