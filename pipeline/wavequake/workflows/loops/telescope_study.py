"""Study files of ``telescope-loop``: the segments of a telescope, what disturbs them, and loops."""

from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from wavequake.campaign.schema import Section, require_own_names
from wavequake.chain.loops.blocks import LoopBlocks
from wavequake.chain.loops.structure import CarryingMode
from wavequake.workflows.exposures.exposure_study import TelescopeExposureStudy
from wavequake.workflows.segments.study import SegmentStudy

_ROUNDING = 1e-9


class LookSection(Section):
    """What is looked at of a run."""

    traced: int = Field(
        default=16,
        ge=0,
        le=4096,
        description="instants of a case that are traced in full, evenly spread: they make the exposure, and "
        "the error of the loop's own linear light is stored",
    )
    share: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="share of a disturbance's cases that are traced, evenly spread from the first one on; "
        "what is traced is missing (NaN) of the others",
    )
    sensors: Literal["linear", "traced"] = Field(
        default="linear",
        description="light that sensors see in the loop; traced: anew in every frame of every case",
    )

    def traces(self, realization: int) -> bool:
        """Return whether a realization is traced: a share of any number of them, but for rounding."""
        before, now = (np.floor(self.share * k + _ROUNDING) for k in (realization - 1, realization))
        return bool(self.traced) and bool(now > before)


class TelescopeLoopStudy(SegmentStudy, LoopBlocks):
    """A validated study file of ``telescope-loop``."""

    mode: tuple[CarryingMode, ...] = Field(default=(), strict=False)
    look: LookSection = LookSection()

    @model_validator(mode="after")
    def _loops_fit_the_telescope(self) -> "TelescopeLoopStudy":
        require_own_names("mode", self.mode)
        most = self.wavefront.zernike_terms
        for each in self.actuator:
            if each.mirror_terms > most:
                raise ValueError(
                    f"actuator.{each.name}.terms is {each.mirror_terms}, more than wavefront.zernike_terms "
                    f"{most}, which cannot tell such deformations apart"
                )
        self.check_runs(self.disturbance, self.wavefront.method, self.wavefront.reference)
        if self.store.keep or self.rare is not None:
            raise ValueError("store.keep and rare belong to segment-disturbance; leave them out")
        if self.object is not None and not self.look.traced:
            raise ValueError("[object] is imaged at traced instants; look.traced must be 1 or more")
        if self.look.traced > self.fewest_instants:
            raise ValueError(
                f"look.traced is {self.look.traced}, but there are cases of {self.fewest_instants} instants"
            )
        return self

    @property
    def stores_images(self) -> bool:
        """Whether images are computed of a case."""
        return bool(self.look.traced)

    @property
    def exposed(self) -> TelescopeExposureStudy:
        """The study of the same telescope's images, with a deformable M2 if an actuator is one."""
        sections = self.model_dump(include=set(SegmentStudy.model_fields) - {"rare"})
        sections["store"] = {}
        sections["study"]["workflow"] = "telescope-exposure"
        terms = max([one.mirror_terms for one in self.actuator], default=0)
        sections["exposure"] = {"scale": 1.0, "figure_terms": max(4, terms)}
        return TelescopeExposureStudy.model_validate(sections, strict=False)
