"""Study files of ``segment-control``: the loop that holds the segments of a mirror by edge sensors."""

from itertools import pairwise
from typing import Literal

from pydantic import Field, field_validator, model_validator

from wavequake.campaign.schema import CampaignSection, Section, Study, require_own_names
from wavequake.chain.loops.structure import ModeSection


class MirrorSection(Section):
    """Segments, and the actuators and edge sensors of each."""

    telescope: Literal["tmt", "tmt-18"] = Field(default="tmt", description="whose segments: 492 or 18")
    curved: bool = Field(
        default=True, description="lever arms in each segment's plane; false: seen along the axis"
    )
    actuator_radius_m: float = Field(
        default=0.531, ge=0.01, le=10, description="of the circle of the three actuators"
    )
    actuator_angles_deg: tuple[float, float, float] = Field(
        default=(90.0, 210.0, 330.0),
        strict=False,
        description="of the three actuators about a segment's center",
    )
    arm_m: float = Field(
        default=0.05, ge=1e-4, le=10, description="reading per dihedral angle, at the nominal gap"
    )
    offset_m: float = Field(default=0.100722, ge=0, description="of a sensor from the end of its edge")
    sensor_nm: float = Field(default=1.0, ge=0, description="white noise of a sensor, rms per frame")
    servo_hz: float | None = Field(
        default=20.0, gt=0, description="of an actuator's local position loop, second order; none: at once"
    )
    servo_damping: float = Field(default=0.5, gt=0, le=10, description="damping ratio of that servo")

    @field_validator("actuator_angles_deg")
    @classmethod
    def _actuators_are_apart(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        first, second, third = sorted(one % 360 for one in value)
        if min(second - first, third - second, 360 + first - third) < 1:
            raise ValueError("three actuators need three angles, 1 deg or more apart")
        return value


class SlowSection(Section):
    """Modes of the mirror that are controlled more slowly (or faster) than the others."""

    first: int = Field(ge=1, description="mode, counted from the least seen one, which is 1 (focus)")
    last: int = Field(ge=1, description="the last mode of this gain, counted alike")
    factor: float = Field(gt=0, le=10, description="of the gain")

    @model_validator(mode="after")
    def _in_order(self) -> "SlowSection":
        if self.last < self.first:
            raise ValueError(f"last ({self.last}) is below first ({self.first})")
        return self


class ControlSection(Section):
    """An integrator for each mode that the sensors see."""

    rate_hz: float = Field(default=50.0, gt=0, le=1e5, description="frames and commands per second")
    latency_frames: float = Field(
        default=1.0, ge=0, le=10, description="from the end of a frame to its command; any fraction"
    )
    bandwidths_hz: tuple[float, ...] = Field(
        default=(0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0),
        min_length=1,
        strict=False,
        description="frequencies at which the loop gain of an integrator is 1, rising",
    )
    leak: float = Field(default=0.0, ge=0, lt=1, description="of the integrators, per command")
    slow: tuple[SlowSection, ...] = Field(default=(), strict=False)

    @model_validator(mode="after")
    def _bandwidths_rise(self) -> "ControlSection":
        values = self.bandwidths_hz
        if min(values) <= 0 or any(b <= a for a, b in pairwise(values)):
            raise ValueError("bandwidths_hz must be positive and rise")
        if values[-1] > self.rate_hz / 6:
            raise ValueError(
                f"a bandwidth is {values[-1]:g} Hz, more than a sixth of rate_hz = {self.rate_hz:g}, beyond "
                "which an integrator has a gain above 1"
            )
        taken: set[int] = set()
        for one in self.slow:
            mine = set(range(one.first, one.last + 1))
            if mine & taken:
                raise ValueError(f"slow names mode {min(mine & taken)} twice")
            taken |= mine
        return self


class SeenMode(ModeSection):
    """A mode of the structure that carries the segments."""

    @field_validator("zernike")
    @classmethod
    def _bends(cls, value: dict[int, float]) -> dict[int, float]:
        if not any(abs(size) > 0 for noll, size in value.items() if noll > 3):
            raise ValueError("edge sensors do not see tilts of the whole mirror; name a Noll index j >= 4")
        return value


class GustSection(Section):
    """Wind on the segments, as the disturbance ``segment-wind`` has it."""

    mean_speed_m_s: float = Field(default=1.0, gt=0, le=100, description="U, over the mirror")
    turbulence_intensity: float = Field(
        default=0.5, gt=0, le=2, description="rms of the gusts over the mean speed"
    )
    length_scale_m: float = Field(default=5.0, gt=0, description="L, integral scale of the turbulence")
    stiffness_n_um: float = Field(default=10.0, gt=0, description="static force over motion of a segment")


class ErrorsSection(Section):
    """What the controller does not know of mirror and sensors: rms of independent relative errors."""

    sensor_gain: float = Field(
        default=0.02, ge=0, lt=1, description="of each edge sensor, reading per displacement"
    )
    actuator_gain: float = Field(default=0.05, ge=0, lt=1, description="of each actuator, stroke per command")
    entries: float = Field(default=1e-3, ge=0, lt=1, description="of every entry of the interaction matrix")
    arm: float = Field(
        default=0.1, ge=0, lt=1, description="of all dihedral arms together: gaps of another width"
    )
    misplaced_mm: float = Field(default=1.0, ge=0, le=100, description="of sensors along their edges")


class PeakSection(Section):
    """When a loop is fast enough."""

    peak: float = Field(default=2.0, gt=1, description="largest sensitivity |S| that is accepted")


class SegmentControlCampaign(CampaignSection):
    """How many errors to draw."""

    cases: int = Field(default=8, ge=1, le=1_000_000, description="draws of the errors")


class SegmentControlStudy(Study):
    """A validated study file of ``segment-control``."""

    mirror: MirrorSection = MirrorSection()
    control: ControlSection = ControlSection()
    mode: tuple[SeenMode, ...] = Field(min_length=1, strict=False)
    wind: GustSection = GustSection()
    errors: ErrorsSection = ErrorsSection()
    criterion: PeakSection = PeakSection()
    campaign: SegmentControlCampaign = SegmentControlCampaign()

    @field_validator("mode")
    @classmethod
    def _names_differ(cls, value: tuple[SeenMode, ...]) -> tuple[SeenMode, ...]:
        require_own_names("mode", value)
        return value
