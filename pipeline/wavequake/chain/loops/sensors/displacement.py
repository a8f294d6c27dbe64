"""Sensors of where segments, M2 and points of the structure are, against the ground."""

from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.chain.loops.block import Sensor, register
from wavequake.chain.loops.light import Light
from wavequake.chain.loops.structure import Dof
from wavequake.errors import UserError
from wavequake.optics.derivatives.central import DOFS

_DOFS = ("dz", "rx", "ry")


class OfBodies(Sensor):
    """What a sensor on each of some segments, on M2 or on points of the structure reads."""

    sees: ClassVar[Literal["light", "bodies"]] = "bodies"

    segments: tuple[str, ...] | None = Field(
        default=None,
        strict=False,
        description="names or patterns, as A*; default: all, or none where m2 or nodes are named",
    )
    dofs: tuple[Literal["dz", "rx", "ry"], ...] = Field(
        default=("dz",), min_length=1, strict=False, description="of segments: of dz, rx, ry"
    )
    m2: tuple[Dof, ...] = Field(default=(), strict=False, description="of M2: of dx, dy, dz, rx, ry, rz")
    nodes: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description="names or patterns of points that [[mode]] blocks move, or of nodes of bodies, as "
        "tube.top1.dx",
    )

    def labels(self, light: Light) -> tuple[str, ...]:
        """Return degree of freedom and segment, one after the other, then those of M2, then nodes."""
        return tuple(label for label, _ in self._read(light))

    def matrix(self, light: Light, nominal: bool = False) -> NDArray[np.float64]:
        """Return readings per motion of bodies, (m, 3 S + 6 + N)."""
        found = np.zeros((len(self._read(light)), light.bodies))
        for row, (_, place) in enumerate(self._read(light)):
            found[row, place] = 1.0
        return found

    def _read(self, light: Light) -> list[tuple[str, int]]:
        """Return what is read by name, and its places among the motions of bodies.

        Raises
        ------
        UserError
            If there is no such segment or node, or nothing is read.
        """
        names, count = light.layout.names, len(light.layout)
        everywhere = () if self.m2 or self.nodes else ("*",)
        segments = self._places("segments", everywhere if self.segments is None else self.segments, names)
        found = [
            (f"{dof}[{names[place]}]", _DOFS.index(dof) * count + place)
            for dof in self.dofs
            for place in segments
        ]
        found += [(f"{dof}[M2]", 3 * count + DOFS.index(dof)) for dof in self.m2]
        found += [
            (light.nodes[place], 3 * count + 6 + place)
            for place in self._places("nodes", self.nodes, light.nodes)
        ]
        if not found:
            raise UserError(f"sensor.{self.name} reads nothing; name segments, m2 or nodes.")
        return found

    def _places(self, key: str, patterns: Sequence[str], names: Sequence[str]) -> list[int]:
        for pattern in patterns:
            if not any(fnmatchcase(name, pattern) for name in names):
                none = (
                    "there are no segments"
                    if key == "segments"
                    else "no [[mode]] block and no body with mass has nodes"
                )
                there = f"there are {names[0]} to {names[-1]}" if names else none
                raise UserError(f"sensor.{self.name}.{key}: there is no {key[:-1]} {pattern!r}; {there}.")
        return [place for place, name in enumerate(names) if any(fnmatchcase(name, one) for one in patterns)]


@register
class DisplacementSensors(OfBodies):
    """Where segments are along or about their own axes, or M2 or points of the structure: nm, or nrad."""

    units: ClassVar[str] = "nm"

    model: Literal["displacement"] = "displacement"
