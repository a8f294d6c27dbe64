"""A sensor of the line of sight: a camera that takes the centre of a guide star."""

from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from wavequake.chain.loops.block import Centroids, Sensor, register
from wavequake.chain.loops.light import Light


@register
class LineOfSightSensor(Sensor, Centroids):
    """The line of sight along x and y in mas."""

    units: ClassVar[str] = "mas"

    model: Literal["line-of-sight"] = "line-of-sight"

    def labels(self, light: Light) -> tuple[str, ...]:
        """Return x and y."""
        return ("x", "y")

    def matrix(self, light: Light, nominal: bool = False) -> NDArray[np.float64]:
        """Return the line of sight of what is seen."""
        return np.eye(2, light.optical)

    def noise_rms(self, light: Light) -> float:
        """Return that of the sensor and of its photons."""
        return float(np.hypot(super().noise_rms(light), self.centroid_rms()))
