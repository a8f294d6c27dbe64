"""Actuators of the segments of M1."""

from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from wavequake.chain.loops.block import Actuator, each_once, register
from wavequake.chain.loops.light import Light
from wavequake.control.sampled.channel import Dynamics, in_series, second_order
from wavequake.optics.derivatives.central import DOFS
from wavequake.optics.systems.system import States

_UNITS = np.repeat([1e-6, 1e-9], 3)


@register
class SegmentActuators(Actuator):
    """All segments of M1 along or about their own axes: pistons (dz) in nm, tips and tilts in nrad.

    With a stiffness, a servo (`bandwidth_hz`) moves the foot of a spring that carries the segment's mass.
    """

    model: Literal["segments"] = "segments"
    dofs: Annotated[tuple[Literal["dz", "rx", "ry"], ...], AfterValidator(each_once)] = Field(
        default=("dz",), min_length=1, strict=False, description="of dz, rx, ry"
    )
    stiffness_n_um: float | None = Field(
        default=None,
        ge=1e-6,
        le=1e9,
        description="of a segment's actuators together, along z, in place of resonance_hz; needs segment_kg",
    )
    segment_kg: float | None = Field(default=None, ge=1e-3, le=1e9, description="mass that they carry")

    @model_validator(mode="after")
    def _a_spring_carries_a_mass(self) -> "SegmentActuators":
        if (self.stiffness_n_um is None) != (self.segment_kg is None):
            raise ValueError(f"the actuator {self.name!r}: give stiffness_n_um and segment_kg together")
        if self.stiffness_n_um is not None and self.resonance_hz is not None:
            raise ValueError(
                f"the actuator {self.name!r}: stiffness_n_um and segment_kg make a resonance; leave "
                "resonance_hz out"
            )
        if self.stiffness_n_um is not None and self.dofs != ("dz",):
            raise ValueError(
                f"the actuator {self.name!r}: stiffness_n_um is that of pistons; set dofs = ['dz']"
            )
        return self

    def dynamics(self) -> Dynamics:
        """Return how a channel follows: servo, then mass on spring."""
        if self.stiffness_n_um is None or self.segment_kg is None:
            return super().dynamics()
        hertz = float(np.sqrt(1e6 * self.stiffness_n_um / self.segment_kg) / (2 * np.pi))
        return in_series(super().dynamics(), second_order(hertz, self.damping))

    @property
    def carried_kg(self) -> float | None:
        """Mass of a segment."""
        return self.segment_kg

    @property
    def segment_dofs(self) -> tuple[int, ...]:
        """Places of `dofs` among the six of a rigid body."""
        return tuple(map(DOFS.index, self.dofs))

    def channels(self, light: Light) -> tuple[str, ...]:
        """Return the degree of freedom and the segment, one degree of freedom after the other."""
        return tuple(f"{dof}[{name}]" for dof in self.dofs for name in light.layout.names)

    def put(self, light: Light, states: States, positions: NDArray[np.float64]) -> None:
        """Add positions to the motions of the segments."""
        count, segments = len(positions), states.segment_motion.shape[1]
        for index, dof in enumerate(self.segment_dofs):
            part = positions[:, index * segments : (index + 1) * segments]
            states.segment_motion[:count, :, dof] += part * _UNITS[dof]
