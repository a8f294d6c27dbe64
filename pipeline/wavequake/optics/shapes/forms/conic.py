"""Planes, spheres and conics."""

from dataclasses import dataclass

import numpy as np

from wavequake.optics.shapes.shape import Shape, register


@register
@dataclass(frozen=True)
class Conic(Shape):
    """A plane (infinite radius), sphere or conic (Störkle 2018, Eq. 3.18); radius > 0: center on +z."""

    radius: float = np.inf
    conic: float = 0.0

    def words(self) -> str:
        """Return nothing: radius and conic constant say all."""
        return ""
