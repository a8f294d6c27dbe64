"""What study files of disturbed optics have in common: of segmented telescopes, and of any other system."""

from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from wavequake.campaign.schema import Section, Study, require_own_names
from wavequake.chain.images.camera import DetectorSection
from wavequake.chain.images.extended import ObjectSection
from wavequake.chain.sampling import SampledCampaignSection, replicate_labels, slots
from wavequake.chain.uncertain import shared_models
from wavequake.mechanics.disturbances.registry import with_own_axes
from wavequake.optics.polynomials.zernike import MOST_TERMS
from wavequake.workflows.asked_sections import AllowSection, BudgetSection
from wavequake.workflows.bodies.sections import BodySection, ComparedModelsSection, LinkSection
from wavequake.workflows.mirrors.study import FULL


class WavefrontSection(Section):
    """What is fitted to wavefronts, and to what of them."""

    zernike_terms: int = Field(
        default=28,
        ge=4,
        le=MOST_TERMS,
        description="by Noll index; annular where the pupil is obscured; needs 2 to 5 rays per term",
    )
    method: Literal["opd", "slopes"] = Field(
        default="opd",
        description="coefficients and line of sight from path lengths, or from ray slopes alone "
        "(Störkle 2018, Eq. 4.20): these see tilts and figures, but no piston of a segment or of the pupil",
    )
    basis: Literal["annular", "circular"] = Field(
        default="annular",
        description="of the stored coefficients where the pupil is obscured; circular ones are equivalent "
        "(Eq. 3.53), but the sum of their squares is not the rms over the annulus, which stays that of the "
        "annular ones",
    )
    reference: Literal["chief", "fitted"] = Field(
        default="chief",
        description="center of the reference sphere in the image: where the (virtual) chief ray arrives, or "
        "that of the sphere that fits the wavefront best (section 3.3.3; needs method opd)",
    )

    @model_validator(mode="after")
    def _slopes_have_no_sphere(self) -> "WavefrontSection":
        if self.method == "slopes" and self.reference == "fitted":
            raise ValueError("reference = 'fitted' needs path lengths; choose method = 'opd' for it")
        return self

    @property
    def plain(self) -> bool:
        """Whether it is from path lengths about the chief ray."""
        return self.method == "opd" and self.reference == "chief"


class DisturbedStudy(Study):
    """A study whose cases are realizations of disturbances of optics."""

    campaign: SampledCampaignSection = SampledCampaignSection()
    body: tuple[BodySection, ...] = Field(default=(), strict=False)
    link: tuple[LinkSection, ...] = Field(default=(), strict=False)
    wavefront: WavefrontSection = WavefrontSection()
    object: ObjectSection | None = None
    detector: DetectorSection | None = None
    allow: AllowSection | None = None
    budget: BudgetSection | None = None
    reduction: ComparedModelsSection | None = None

    asked: ClassVar[frozenset[str]] = frozenset({"allow", "budget"})
    if TYPE_CHECKING:  # each kind has its own
        disturbance: tuple[Any, ...]
        optics: Any
        structure: Any

    @field_validator("disturbance", check_fields=False)
    @classmethod
    def _populations_are_sound(cls, value: tuple[Any, ...]) -> tuple[Any, ...]:
        require_own_names("disturbance", value)
        names = [entry.name for entry in value]
        for entry in value:
            chosen = getattr(entry, "of", ())
            twice = next((name for name in chosen if chosen.count(name) > 1), None)
            if twice is not None:
                raise ValueError(f"{entry.name!r} names {twice!r} twice; name it once")
            for part in chosen if entry.model == "combine" else ():
                if part not in names or part == entry.name:
                    raise ValueError(
                        f"{entry.name!r} combines {part!r}, which is not another disturbance of this study"
                    )
        if not any(entry.share for entry in value):
            raise ValueError("every disturbance has share 0, so there is nothing to run")
        return with_own_axes(value)

    @model_validator(mode="after")
    def _modal_light_is_of_path_lengths(self) -> "DisturbedStudy":
        if self.optics.light == "modal" and not self.wavefront.plain:
            raise ValueError(
                "optics.light = 'modal' needs wavefront.method = 'opd' and wavefront.reference = 'chief'"
            )
        return self

    @property
    def compared(self) -> tuple[str, ...]:
        """Models of what is elastic that are compared, the full one first; a draw is a case with each."""
        return (FULL, *self.reduction.variants) if self.reduction is not None else (FULL,)

    @property
    def fewest_instants(self) -> int:
        """Number of instants of the shortest case."""
        return int(min(entry.instants for entry in self.disturbance if entry.share))


def case_labels(study: DisturbedStudy, cases: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Return the labels of cases: disturbance, realization and seed."""
    which, places = slots([entry.share for entry in study.disturbance], cases)
    realizations, model = np.divmod(places, len(study.compared))
    models = {"reduction": np.array(study.compared, dtype=object)[model]}
    return {
        "disturbance": np.array([entry.name for entry in study.disturbance], dtype=object)[which],
        **(models if study.reduction is not None else {}),
        "realization": realizations,
        "seed": np.full(len(cases), study.study.seed, dtype=np.int64),
        **replicate_labels(study.campaign, realizations),
        **shared_models(study.structure.uncertain if study.structure else None, realizations),
    }
