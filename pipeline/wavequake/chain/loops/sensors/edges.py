"""Edge sensors between the segments of a mirror."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.chain.loops.block import Sensor, register
from wavequake.chain.loops.light import Light
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.sources.edge_sensors import sensor_matrix, shared_edges


@register
class EdgeSensors(Sensor):
    """Two sensors per shared edge: difference of height across the gap and the dihedral angle by an arm, nm.

    They see the segments, not the light. Smooth modes of the mirror, focus above all, are seen by the arm
    alone, which changes with the gap: what it truly is may differ from what controllers believe.
    """

    units: ClassVar[str] = "nm"
    sees: ClassVar[Literal["light", "bodies"]] = "bodies"

    model: Literal["edges"] = "edges"
    arm_m: float = Field(default=0.05, ge=0, le=10, description="reading per dihedral angle, as believed")
    true_arm_m: float | None = Field(default=None, ge=0, le=10, description="as it is; default: as believed")
    offset_m: float = Field(default=0.100722, ge=0, description="from the end of the edge, gap closed")

    def labels(self, light: Light) -> tuple[str, ...]:
        """Return the two segments of each edge, and which end of it."""
        with self._named():
            first, second, _ = shared_edges(light.layout)
        names = light.layout.names
        return tuple(
            f"{names[a]}-{names[b]}/{end}" for end in (1, 2) for a, b in zip(first, second, strict=True)
        )

    def matrix(self, light: Light, nominal: bool = False) -> NDArray[np.float64]:
        """Return readings per dz (nm), rx, ry (nrad) of all segments, (2 E, 3 S)."""
        arm = self.arm_m if nominal or self.true_arm_m is None else self.true_arm_m
        with self._named():
            found = sensor_matrix(light.layout, arm, self.offset_m)
        dense = found.matrix.toarray()
        piston, x_slope, y_slope = (dense[:, part::3] for part in range(3))
        # z = slope_x x + slope_y y is the rotation (slope_y, -slope_x).
        return np.hstack([piston, y_slope * found.radius, -x_slope * found.radius])

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Say of what fails which sensor it is."""
        try:
            yield
        except UserError as error:
            raise UserError(f"sensor.{self.name}: {error}") from None
