"""Sensors of where segments are, against the ground."""

from fnmatch import fnmatchcase
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.chain.loops.block import Light, Sensor, register
from wavequake.errors import UserError

_DOFS = ("dz", "rx", "ry")


class OfSegments(Sensor):
    """What a sensor on each of some segments reads."""

    sees: ClassVar[Literal["light", "segments"]] = "segments"

    segments: tuple[str, ...] = Field(
        default=("*",), min_length=1, strict=False, description="names or patterns, as A*"
    )
    dofs: tuple[Literal["dz", "rx", "ry"], ...] = Field(
        default=("dz",), min_length=1, strict=False, description="of dz, rx, ry"
    )

    def labels(self, light: Light) -> tuple[str, ...]:
        """Return the degree of freedom and the segment, one degree of freedom after the other."""
        names = light.layout.names
        return tuple(f"{dof}[{names[place]}]" for dof in self.dofs for place in self._places(light))

    def matrix(self, light: Light, nominal: bool = False) -> NDArray[np.float64]:
        """Return readings per dz (nm), rx, ry (nrad) of all segments, (m, 3 S)."""
        places, count = self._places(light), len(light.layout)
        rows = [_DOFS.index(dof) * count + place for dof in self.dofs for place in places]
        return np.asarray(np.eye(3 * count)[rows])

    def _places(self, light: Light) -> list[int]:
        names = light.layout.names
        for pattern in self.segments:
            if not any(fnmatchcase(name, pattern) for name in names):
                raise UserError(
                    f"sensor.{self.name}.segments: there is no segment {pattern!r}; there are {names[0]} to "
                    f"{names[-1]}."
                )
        return [
            place for place, name in enumerate(names) if any(fnmatchcase(name, one) for one in self.segments)
        ]


@register
class DisplacementSensors(OfSegments):
    """Where segments are along or about their own axes: dz in nm, rx and ry in nrad."""

    units: ClassVar[str] = "nm"

    model: Literal["displacement"] = "displacement"
