"""Study files of ``tip-tilt-vibration``: the line of sight under wind and vibration lines, by controllers."""

from typing import Literal

from pydantic import Field, field_validator, model_validator

from wavequake.campaign.schema import CampaignSection, Section, Study, each_once


class ShakenSection(Section):
    """What moves the line of sight along one axis."""

    wind_percentile: Literal[0, 50, 75] = Field(default=50, description="of TMT's wind shake; 0: no wind")
    lines: Literal["vlt-eris", "keck", "elt-windshake-8ms", "none"] = Field(
        default="vlt-eris", description="set of vibration lines (docs/systems.md); those along the motion"
    )
    lines_mas: float = Field(default=10.0, gt=0, le=1e9, description="rms of the lines together")
    fwhm_hz: float = Field(default=0.2, ge=0.01, le=2.0, description="width of the lines of a set")

    @model_validator(mode="after")
    def _something_moves(self) -> "ShakenSection":
        if self.wind_percentile == 0 and self.lines == "none":
            raise ValueError("neither wind nor lines move the line of sight; name one of them")
        return self


_FASTEST_HZ = 1e6


class LoopSection(Section):
    """A sensor that averages over frames, a mirror that holds commands, and what is between."""

    rates_hz: tuple[float, ...] = Field(
        default=(100.0, 500.0, 1000.0), min_length=1, strict=False, description="frames per second"
    )
    controllers: tuple[Literal["integrator", "lqg"], ...] = Field(
        default=("integrator", "lqg"),
        min_length=1,
        strict=False,
        description="which ones close the loop, at each rate",
    )
    delay_frames: int = Field(
        default=2, ge=1, le=10, description="1: what a frame shows acts in the next one"
    )
    gain: float | None = Field(default=None, gt=0, description="of the integrator; default: the best one")
    noise_mas: float = Field(default=5.0, gt=0, le=1e9, description="of the sensor, per frame")
    lines_off: float = Field(
        default=0.0,
        gt=-0.5,
        lt=0.5,
        description="by which share all lines are higher than LQG believes: robustness of the model",
    )

    @field_validator("rates_hz")
    @classmethod
    def _rates_are_positive(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if wrong := [rate for rate in value if not 0.0 < rate <= _FASTEST_HZ]:
            raise ValueError(f"a rate is {wrong[0]:g} Hz; it must be positive and at most {_FASTEST_HZ:g} Hz")
        return value

    _each_once = field_validator("rates_hz", "controllers")(each_once)


class SimulatedSection(Section):
    """The runs in time that stand beside the exact values."""

    duration_s: float = Field(default=60.0, gt=0, le=3600, description="60 s or more for wind")
    settling_s: float = Field(default=5.0, ge=0, le=3600, description="before that, not counted")


class TipTiltCampaign(CampaignSection):
    """How much of the study to run: realizations of every controller at every rate."""

    cases: int = Field(
        default=120, ge=1, le=1_000_000, description="realizations, each of every controller at every rate"
    )


class TipTiltStudy(Study):
    """A validated study file of ``tip-tilt-vibration``."""

    shaken: ShakenSection = ShakenSection()
    loop: LoopSection = LoopSection()
    simulated: SimulatedSection = SimulatedSection()
    campaign: TipTiltCampaign = TipTiltCampaign()

    @model_validator(mode="after")
    def _runs_have_frames(self) -> "TipTiltStudy":
        slow = min(self.loop.rates_hz)
        if self.simulated.duration_s * slow < 10 * self.loop.delay_frames:
            raise ValueError(
                f"simulated.duration_s is {self.simulated.duration_s:g} s, shorter than ten delays of "
                f"{self.loop.delay_frames} frames at {slow:g} Hz"
            )
        return self
