"""Study files of ``controller-mor``: controllers of reduced models, judged on the full one."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from wavequake.campaign.schema import Section, StoreSection, Study, each_once
from wavequake.mechanics.mirrors.models import SEGMENT_SUPPORT
from wavequake.workflows.mirrors.study import VariantsCampaignSection, VariantsSection

_LEAST = 1e-12  # of efforts


class SupportedModelSection(Section):
    """An elastic mirror on springs: a glass-ceramic segment, or a circular or annular mirror of aluminium."""

    shape: Literal["segment", "circular", "annular"] = Field(
        default="segment", description="outline of the mirror, which decides its material, too"
    )
    divisions: int = Field(
        default=11, ge=2, le=40, description="elements along the side of a segment, or along the radius"
    )
    spring_n_m: tuple[float, float, float] = Field(
        default=SEGMENT_SUPPORT, strict=False, description="of each support along x, y and z, N/m"
    )
    damping_alpha: float = Field(default=0.0, ge=0, description="1/s, times the mass")
    damping_beta: float = Field(default=5e-6, ge=0, description="s, times the stiffness")
    modes: int = Field(
        default=300,
        ge=10,
        le=3000,
        description="of the full model, followed one by one; the others are their flexibility, with a bound",
    )

    @field_validator("spring_n_m")
    @classmethod
    def _springs_hold(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if min(value) <= 0:
            raise ValueError("each support needs three positive spring constants")
        return value

    @model_validator(mode="after")
    def _modes_decay(self) -> "SupportedModelSection":
        if self.damping_alpha == self.damping_beta == 0:
            raise ValueError(
                "damping_alpha and damping_beta are both 0; modes that nobody controls must decay"
            )
        return self


class SensorsSection(Section):
    """Displacement sensors along z at the nodes of the front face next to these places."""

    radius_m: float | None = Field(
        default=None, gt=0, description="of the sensors; default: 0.9 of the mirror's (its corners')"
    )
    angles_deg: tuple[float, ...] = Field(
        default=(60.0, 180.0, 300.0), min_length=1, strict=False, description="one sensor at each"
    )


class RegulatorSection(Section):
    """Regulator and filter: readings cost (y/length)^2, forces effort (u/force)^2."""

    effort: tuple[float, ...] = Field(
        default=(0.1,),
        min_length=1,
        strict=False,
        description="weight of the forces and density of sensor noise, both in these units; small is fast",
    )
    frequency_hz: float = Field(default=50.0, gt=0, description="1/(2 pi frequency_hz) is the unit of time")
    force_n: float = Field(
        default=5e-3,
        ge=1e-15,
        le=1e15,
        description="unit of force; white forces of unit density shake every actuator",
    )
    length_m: float = Field(default=1e-9, ge=1e-15, le=1e15, description="unit of readings")

    @field_validator("effort")
    @classmethod
    def _efforts_are_positive(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if wrong := [one for one in value if not _LEAST <= one <= 1 / _LEAST]:
            raise ValueError(
                f"an effort is {wrong[0]:g}; forces must cost something: give numbers from {_LEAST:g} to "
                f"{1 / _LEAST:g}"
            )
        return each_once(value)


class JudgedVariantsSection(VariantsSection):
    """Which reduced models get a controller, and in which bands their transfer functions are compared."""

    last_hz: float = Field(default=200.0, gt=0, description="upper end of the band that models are made for")
    first_hz: float = Field(default=1.0, gt=0, description="lower end of the band that models are made for")
    beyond_hz: float = Field(
        default=600.0, gt=0, description="up to where errors above the band are looked at"
    )
    frequencies: int = Field(
        default=800, ge=2, le=20000, description="evenly spread over the band, and as many beyond it"
    )

    @model_validator(mode="after")
    def _bands_rise(self) -> "JudgedVariantsSection":
        if not self.first_hz < self.last_hz < self.beyond_hz:
            raise ValueError("first_hz, last_hz and beyond_hz must rise")
        return self


class ControllerCriterionSection(Section):
    """When a reduced model is good enough for its controller; a loop that is not stable never is."""

    excess: float = Field(
        default=0.05,
        gt=0,
        description="its wavefront is at most this share above the smallest of all variants",
    )
    peak: float = Field(default=4.0, gt=1, description="at most so large is the peak of its sensitivity")


class ExposedSection(Section):
    """The long exposure of a star that the mirror alone reflects."""

    wavelength_nm: float = Field(
        default=550.0, ge=1, le=1e6, description="of the star's light; default: green"
    )
    pixels: int = Field(default=32, ge=8, le=64, description="along one side")
    sampling: float = Field(default=0.25, gt=0, le=2, description="of a pixel, wavelengths over diameters")

    def angles(self) -> NDArray[np.float64]:
        """Return where pixels are along one side, in wavelengths over diameters."""
        return np.asarray(self.sampling * (np.arange(self.pixels) - self.pixels // 2), dtype=np.float64)


class ControllerStoreSection(StoreSection):
    """Where the results go, and what of them is kept."""

    chunk_cases: int = Field(default=2, ge=1, le=100_000, description="K: cases per task and per shard")


class ControllerStudy(Study):
    """A validated study file of ``controller-mor``: a case is a variant with an effort."""

    model: SupportedModelSection = SupportedModelSection()
    sensors: SensorsSection = SensorsSection()
    controller: RegulatorSection = RegulatorSection()
    reduction: JudgedVariantsSection
    criterion: ControllerCriterionSection = ControllerCriterionSection()
    image: ExposedSection = ExposedSection()
    campaign: VariantsCampaignSection = VariantsCampaignSection()
    store: ControllerStoreSection = ControllerStoreSection()

    @property
    def cases(self) -> int:
        """All variants with all efforts, or as many of them as the campaign asks for."""
        every = len(self.reduction.variants) * len(self.controller.effort)
        return min(self.campaign.cases or every, every)
