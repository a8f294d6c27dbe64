"""Sections of a study for a segment as an elastic mirror on supports."""

from typing import Literal

from pydantic import Field, field_validator

from wavequake.campaign.schema import Section
from wavequake.mechanics.mirrors.material import GLASS_CERAMIC
from wavequake.mechanics.mirrors.models import SEGMENT_SUPPORT
from wavequake.mechanics.model import RayleighDamping
from wavequake.workflows.mirrors.study import FULL, canonical


class SegmentModelSection(Section):
    """The segment: a hexagonal meniscus on three supports; its side is that of the telescope's segments."""

    thickness_m: float = Field(
        default=0.045, gt=0, le=100, description="of the meniscus; 45 mm is an example"
    )
    mount_radius_m: float | None = Field(
        default=None, gt=0, description="of the supports, toward every other corner; default: 0.6 of the side"
    )
    youngs_modulus_pa: float = Field(
        default=GLASS_CERAMIC.young,
        gt=0,
        le=1e16,
        description="stress over strain, elastic; default: glass ceramic",
    )
    poisson_ratio: float = Field(
        default=GLASS_CERAMIC.poisson,
        gt=-1,
        lt=0.5,
        description="transverse contraction over extension; default: glass ceramic",
    )
    density_kg_m3: float = Field(
        default=GLASS_CERAMIC.density, ge=1e-3, le=1e6, description="of the glass; default: glass ceramic"
    )
    support: Literal["springs", "rigid"] = Field(
        default="springs",
        description="springs: displacements move their far ends; rigid: displacements are prescribed",
    )
    spring_n_m: tuple[float, float, float] = Field(
        default=SEGMENT_SUPPORT, strict=False, description="of each support along x, y and z, N/m"
    )
    damping_alpha: float = Field(default=0.0, ge=0, description="1/s, times the mass")
    damping_beta: float = Field(default=5e-6, ge=0, description="s, times the stiffness")
    divisions: int = Field(default=10, ge=2, le=40, description="elements along a side: finer mesh")
    layers: int = Field(default=1, ge=1, le=8, description="elements through the thickness")

    @field_validator("spring_n_m")
    @classmethod
    def _springs_hold(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if min(value) <= 0:
            raise ValueError("a support needs three positive spring constants, or support = 'rigid'")
        return value

    @property
    def damping(self) -> RayleighDamping:
        """Damping of the segment and its supports."""
        return RayleighDamping(self.damping_alpha, self.damping_beta)


class ElasticSegmentSection(SegmentModelSection):
    """One model that stands for every segment of M1."""

    support: Literal["springs"] = Field(
        default="springs", description="always springs, whose far ends displacements move"
    )
    reduced: str = Field(
        default=FULL, description="model that is taken, e.g. craigb18; full: the intermediate model"
    )
    figure_terms: int = Field(
        default=21, ge=4, le=66, description="Zernike terms of a segment's figure over its circle"
    )
    last_hz: float = Field(
        default=600.0, gt=0, description="up to which frequency the full model is accurate"
    )

    @field_validator("reduced")
    @classmethod
    def _is_a_model(cls, value: str) -> str:
        return canonical(value)
