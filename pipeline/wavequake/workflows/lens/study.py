"""Study files of the lens experiment: bench, stage, errors, sensor, controllers."""

from typing import Annotated, Literal, Self, get_args

from pydantic import Field, field_validator, model_validator

from wavequake.campaign.schema import CampaignSection, Section, Study, each_once, require_own_names
from wavequake.chain.loops.block import CONTROLLERS, SENSORS, AnyBlock, Controller, Sensor
from wavequake.chain.loops.closing import check_part, check_rates, check_sensors
from wavequake.chain.loops.controllers.off import Off
from wavequake.chain.loops.controllers.perfect import Perfect
from wavequake.control.experiment import CONTROLLERS as OWN

Six = tuple[float, float, float, float, float, float]
Five = tuple[float, float, float, float, float]
Root = Annotated[tuple[float, float], Field(strict=False)]
Springs = Literal["initial", "changed"]
Arithmetic = Literal["float", "q31", "q16"]
# What controllers of the registry move.
STAGE = "stage"


class BenchSection(Section):
    """The pendulum chain: the fitted (synthetic) bench, with what is given here in place."""

    springs: tuple[Springs, ...] = Field(
        default=("initial",), min_length=1, strict=False, description="configurations of Fig. 5.37"
    )
    lens_kg: Six | None = Field(
        default=None, strict=False, description="mass of each lens; default: of the fitted bench"
    )
    ring_kg: Six | None = Field(
        default=None, strict=False, description="mass of each ring; default: of the fitted bench"
    )
    housing_kg: float | None = Field(
        default=None, gt=0, description="mass of the housing; default: of the fitted bench"
    )
    lens_springs_n_m: Six | None = Field(default=None, strict=False, description="between lens and ring")
    ring_springs_n_m: Six | None = Field(default=None, strict=False, description="between ring and housing")
    couplings_n_m: Five | None = Field(default=None, strict=False, description="between neighboring rings")
    housing_spring_n_m: float | None = Field(
        default=None, ge=0, description="between housing and ground; default: of the fitted bench"
    )
    alpha: float = Field(default=0.03, ge=0, description="1/s, Rayleigh damping times the mass")
    beta: float = Field(default=3e-4, ge=0, description="s, Rayleigh damping times the stiffness")

    _each_once = field_validator("springs")(each_once)


class LensStageSection(Section):
    """The linear stage as it was identified: zeros and poles as (real, imaginary) in 1/s."""

    zeros: tuple[Root, ...] = Field(
        default=((1000.0, 0.0), (480.0, 850.0), (480.0, -850.0)),
        strict=False,
        description="at most as many as poles; in the right half plane: wrong way first",
    )
    poles: tuple[Root, ...] = Field(
        default=((-377.0, 0.0), (-360.0, 293.0), (-360.0, -293.0)),
        strict=False,
        min_length=1,
        description="with negative real parts; ours, as the text tells none",
    )
    gain: float = Field(
        default=0.97, ge=1e-6, le=1e6, description="position over command at rest; 0.97: Fig. 5.10 to 5.12"
    )
    delay_ms: float = Field(
        default=0.0, ge=0, le=100, multiple_of=0.1, description="pure delay beside the lag of the poles"
    )


class ErrorsSection(Section):
    """What the plants have and their nominal model lacks; standard deviations of logarithms, if not units."""

    stiffness: float = Field(default=0.02, ge=0, le=0.2, description="of each spring")
    friction_mn: float = Field(default=0.3, ge=0, le=100, description="of each lens's bearing")
    stage_gain: float = Field(default=0.01, ge=0, le=0.5, description="of the gain of the stage")
    stage_poles: float = Field(
        default=0.05, ge=0, le=0.5, description="of its real pole and its pair of poles"
    )
    blow: float = Field(default=0.01, ge=0, le=0.5, description="of the strength of each blow")
    trigger_ms: float = Field(
        default=0.1, ge=0, le=10, description="longest time until the trigger begins a step; up to it, evenly"
    )
    strip_um: float = Field(default=40.0, ge=0, le=1000, description="largest error of the magnetic strip")
    adc_noise: float = Field(default=0.7, ge=0, le=100, description="steps of the 12-bit converter")
    camera_um: float = Field(default=20.0, ge=0, le=1000, description="unsteadiness of the light point")


class LensControllerSection(Section):
    """Sample times and delays; the reference's are those of its Section 5.4.1."""

    ff_step_ms: float = Field(
        default=2.0, ge=1, le=100, multiple_of=1, description="sample time of FF (feedforward)"
    )
    fi_step_ms: float = Field(default=8.0, ge=1, le=100, multiple_of=1, description="sample time of FI")
    both_step_ms: float = Field(default=2.0, ge=1, le=100, multiple_of=1, description="of FF+FI")
    modal_step_ms: float = Field(
        default=2.0, ge=1, le=100, multiple_of=1, description="sample time of modal regulators"
    )
    ff_delay_ms: float = Field(
        default=1.0,
        ge=0,
        le=100,
        multiple_of=0.1,
        description="from sampling to the command of FF (feedforward)",
    )
    fi_delay_ms: float = Field(
        default=3.0,
        ge=0,
        le=100,
        multiple_of=0.1,
        description="from sampling to the command of FI, the filter without the blow",
    )
    both_delay_ms: float = Field(
        default=1.0, ge=0, le=100, multiple_of=0.1, description="from sampling to the command of FF+FI"
    )
    modal_delay_ms: float = Field(
        default=0.2,
        ge=0,
        le=100,
        multiple_of=0.1,
        description="from sampling to the command of modal regulators",
    )
    nominal_noise: float = Field(default=0.01, gt=0, le=1, description="share of a mode's amplitude per step")
    identified_noise: float = Field(
        default=0.003, gt=0, le=1, description="the same, of the modes that were identified"
    )


class FirmwareSection(Section):
    """The boards' firmware, compiled for this machine, beside the controllers in double precision."""

    arithmetic: tuple[Arithmetic, ...] = Field(
        default=(), strict=False, description="run the firmware in these; none: no compiler is needed"
    )
    design: Literal["nominal", "identified"] = Field(
        default="nominal", description="the modal regulator that it runs; identified is built plant by plant"
    )

    _each_once = field_validator("arithmetic")(each_once)


class LensTimeSection(Section):
    """Length of each run; the standard deviation is taken after 1 s."""

    duration_s: float = Field(default=6.0, ge=2, le=120, description="from the blow to the end of a run")
    step_ms: float = Field(default=2.0, ge=1, le=100, multiple_of=1, description="of the stored histories")


class LensCampaignSection(CampaignSection):
    """How much of the study to run, and on which device; not part of its identity."""

    cases: int = Field(default=40, ge=1, le=100_000_000, description="plants that are drawn and run")


class LensStudy(Study):
    """A validated study file of ``lens-experiment``: a case is a plant with one configuration of springs."""

    bench: BenchSection = BenchSection()
    stage: LensStageSection = LensStageSection()
    errors: ErrorsSection = ErrorsSection()
    controller: LensControllerSection = LensControllerSection()
    firmware: FirmwareSection = FirmwareSection()
    sensor: tuple[Annotated[Sensor, AnyBlock(SENSORS)], ...] = Field(default=(), strict=False)
    loop: tuple[Annotated[Controller, AnyBlock(CONTROLLERS)], ...] = Field(default=(), strict=False)
    time: LensTimeSection = LensTimeSection()
    campaign: LensCampaignSection = LensCampaignSection()

    @property
    def fewest_instants(self) -> int:
        """Number of stored instants of each run."""
        return round(self.time.duration_s * 1e3 / self.time.step_ms) + 1

    @model_validator(mode="after")
    def _histories_are_whole(self) -> Self:
        steps = self.time.duration_s * 1e3 / self.time.step_ms
        if abs(steps - round(steps)) > 1e-6:
            raise ValueError("duration_s must be a multiple of step_ms")
        return self

    @field_validator("loop")
    @classmethod
    def _varied_values_are_controllers(cls, value: tuple[Controller, ...]) -> tuple[Controller, ...]:
        return tuple(one for each in value for one in each.varied())

    @model_validator(mode="after")
    def _loops_fit(self) -> Self:
        own = *OWN, *(f"firmware-{one}" for one in get_args(Arithmetic))
        require_own_names("sensor", self.sensor)
        require_own_names("controller", self.loop, own)
        for one in self.loop:
            if one.beside:
                raise ValueError(f"nothing runs beside the controller {one.name!r}: there is one stage")
            if isinstance(one, Off):
                continue
            check_part(one, "sensor", [each.name for each in self.sensor])
            if one.actuator:
                check_part(one, "actuator", [STAGE])
            check_sensors(one, self.sensor)
            if not isinstance(one, Perfect):
                check_rates(one, self.sensors(one)[0], [("the bench", self.time.duration_s)])
        return self

    def sensors(self, one: Controller) -> tuple[Sensor, ...]:
        """Return the sensors of a controller."""
        known = {each.name: each for each in self.sensor}
        return tuple(known[name] for name in (one.sensor, *one.also_reads) if name)
