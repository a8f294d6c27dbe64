"""Study files of the workflows "telescope-exposure" and "mirror-exposure"."""

from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from wavequake.campaign.schema import Section
from wavequake.chain.images.extended import ObjectSection
from wavequake.chain.images.picture import embed_picture
from wavequake.optics.polynomials.zernike import MOST_TERMS
from wavequake.workflows.mirrors.study import MirrorStudy
from wavequake.workflows.segments.study import SegmentStudy


class ExposureSection(Section):
    """How strongly the telescope is disturbed, and what the deformable M2 can do about it."""

    scale: float = Field(
        default=5.0,
        gt=0,
        le=1e6,
        description="of all disturbances, so that the image shows what they do; all numbers are those of the "
        "scaled motion",
    )
    figure_terms: int | None = Field(
        default=None,
        ge=4,
        le=MOST_TERMS,
        description="Noll terms with which M2 is deformed; default: as many as wavefront.zernike_terms",
    )


class TelescopeExposureStudy(SegmentStudy):
    """A validated study file of ``telescope-exposure``."""

    exposure: ExposureSection = ExposureSection()

    @model_validator(mode="after")
    def _the_correction_is_measured(self) -> "TelescopeExposureStudy":
        if not self.wavefront.plain:
            raise ValueError("exposures need wavefront.method = 'opd' and wavefront.reference = 'chief'")
        if self.figure_terms > self.wavefront.zernike_terms:
            raise ValueError(
                f"exposure.figure_terms {self.figure_terms} is more than wavefront.zernike_terms "
                f"{self.wavefront.zernike_terms}, which cannot tell such deformations apart"
            )
        if self.store.keep:
            raise ValueError("store.keep belongs to segment-disturbance; leave it out")
        return self

    @property
    def figure_terms(self) -> int:
        """Number of Noll terms of M2's deformation."""
        return self.exposure.figure_terms or self.wavefront.zernike_terms


class MirrorExposureStudy(MirrorStudy):
    """A validated study file of ``mirror-exposure``: cases are the variants of each model."""

    object: ObjectSection | None = None

    @model_validator(mode="after")
    def _the_object_is_one(self) -> "MirrorExposureStudy":
        if self.object is not None:
            self.object.chosen()
        return self

    @classmethod
    def read_files(cls, record: dict[str, Any], base: Path) -> None:
        """Read the picture of the object beside what the mirror reads."""
        super().read_files(record, base)
        embed_picture(record, base)
