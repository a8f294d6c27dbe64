"""Study files of the workflow "system-disturbance": any optical system, and what moves its surfaces."""

from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field, SerializerFunctionWrapHandler, field_validator, model_serializer, model_validator

from wavequake.campaign.schema import Section, Study
from wavequake.chain.images.camera import DetectorSection
from wavequake.chain.images.extended import ObjectSection, check_object
from wavequake.chain.images.picture import embed_picture
from wavequake.chain.images.system import SystemImagingSection
from wavequake.chain.modal_options import Light, ModalSample, ModalTolerance, with_light, with_method
from wavequake.chain.sampling import SampledCampaignSection, whole_sets
from wavequake.chain.sources import read_source_files
from wavequake.chain.uncertain import require_independent_sets
from wavequake.mechanics.disturbances.element_motion import ElementDisturbance
from wavequake.mechanics.disturbances.registry import parts, with_own_axes
from wavequake.optics.polynomials.zernike import MOST_TERMS
from wavequake.optics.systems.file import SystemSection, embed_file
from wavequake.workflows.asked_sections import AllowSection, BudgetSection
from wavequake.workflows.bodies.files import read_body_files
from wavequake.workflows.bodies.sections import (
    NO_MASS,
    BodySection,
    ComparedModelsSection,
    LinkSection,
    StructureSection,
)
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.segments.study import require_path_lengths

_OF_MASSES = ("link", "structure", "reduction")
WITHOUT_IMAGES = {"imaging": None, "object": None, "detector": None}
"""What makes a study one without images, and without what a camera makes of them."""


class SystemOpticsSection(Section):
    """Rays per field point and wavelength, spread evenly over the pupil."""

    rays: int = Field(
        default=500, ge=10, le=1_000_000, description="traced per field point, wavelength and instant"
    )
    light: Light = Field(
        default="traced",
        description="trace every instant, or take wavefronts and images from derivatives that are traced "
        "once (modal: many cases of small motions)",
    )
    modal_tolerance_nm: ModalTolerance = 0.1
    modal_sample: ModalSample = 0.001

    @model_serializer(mode="wrap")
    def _traced_studies_say_nothing_of_it(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        record: dict[str, Any] = write(self)
        if self.light == "traced":
            record = {key: value for key, value in record.items() if key == "rays"}
        return with_method(record)

    @model_validator(mode="before")
    @classmethod
    def _method_is_light(cls, given: Any) -> Any:
        return with_light(given)


class SystemWavefrontSection(Section):
    """What is fitted to the wavefronts, and to what of them."""

    zernike_terms: int = Field(
        default=28,
        ge=4,
        le=MOST_TERMS,
        description="by Noll index; annular where the pupil is obscured; needs 2 to 5 rays per term",
    )
    method: Literal["opd", "slopes"] = Field(
        default="opd",
        description="coefficients and line of sight from path lengths, or from ray slopes alone "
        "(Störkle 2018, Eq. 4.20), which do not know piston; they agree as far as zernike_terms describe the "
        "wavefront",
    )
    basis: Literal["annular", "circular"] = Field(
        default="annular",
        description="of the stored coefficients where the pupil is obscured; circular ones are equivalent "
        "(Eq. 3.53), but the sum of their squares is not the rms over the annulus, which stays that of the "
        "annular ones",
    )
    reference: Literal["chief", "fitted"] = Field(
        default="chief",
        description="center of the reference sphere in the image: where the chief ray through the center of "
        "the stop arrives, or that of the sphere that fits the wavefront best (section 3.3.3; needs method "
        "opd)",
    )

    @model_validator(mode="after")
    def _slopes_have_no_sphere(self) -> "SystemWavefrontSection":
        require_path_lengths(self.method, self.reference)
        return self


class SystemStudy(Study):
    """A validated study file."""

    campaign: SampledCampaignSection = SampledCampaignSection()
    system: SystemSection
    body: tuple[BodySection, ...] = Field(default=(), strict=False)
    link: tuple[LinkSection, ...] = Field(default=(), strict=False)
    structure: StructureSection = StructureSection()
    reduction: ComparedModelsSection | None = None
    disturbance: tuple[ElementDisturbance, ...] = Field(min_length=1, strict=False)
    optics: SystemOpticsSection = SystemOpticsSection()
    wavefront: SystemWavefrontSection = SystemWavefrontSection()
    imaging: SystemImagingSection | None = None
    object: ObjectSection | None = None
    detector: DetectorSection | None = None
    allow: AllowSection | None = None
    budget: BudgetSection | None = None

    asked: ClassVar[frozenset[str]] = frozenset({"allow", "budget"})

    @model_serializer(mode="wrap")
    def _without_structure_there_is_none(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        record: dict[str, Any] = write(self)
        if not any(body.kind for body in self.body):
            record = {key: value for key, value in record.items() if key not in _OF_MASSES}
        if self.detector is None:
            record.pop("detector", None)
        return record

    @field_validator("disturbance")
    @classmethod
    def _populations_are_sound(cls, value: tuple[Any, ...]) -> tuple[Any, ...]:
        names = [entry.name for entry in value]
        for entry in value:
            if names.count(entry.name) > 1:
                raise ValueError(f"two disturbances are called {entry.name!r}; each needs a name of its own")
            chosen = getattr(entry, "of", ())
            twice = next((name for name in chosen if chosen.count(name) > 1), None)
            if twice is not None:
                raise ValueError(f"{entry.name!r} names {twice!r} twice; name it once")
            if entry.model == "combine":
                unknown = next((name for name in chosen if name not in names or name == entry.name), None)
                if unknown is not None:
                    raise ValueError(
                        f"{entry.name!r} combines {unknown!r}, which is not another disturbance of this study"
                    )
            if getattr(entry, "act", "mount") != "mount":
                raise ValueError(
                    f"{entry.name!r} acts on {entry.act}, which belongs to segmented telescopes; a mirror is "
                    'tilted by the model "surface-vibration"'
                )
        if not any(entry.share for entry in value):
            raise ValueError("every disturbance has share 0, so there is nothing to run")
        return with_own_axes(value)

    @model_validator(mode="after")
    def _objects_have_images(self) -> "SystemStudy":
        if self.detector is not None and self.imaging is None:
            raise ValueError("a detector sees images: add the section [imaging], or leave it out")
        if self.object is not None:
            if self.imaging is None:
                raise ValueError("an object is seen in images: add the section [imaging], or leave it out")
            self.object.chosen()
            check_object(self.object, self.imaging.pixels, self.imaging.sampling)
        return self

    @model_validator(mode="after")
    def _modal_light_is_of_path_lengths(self) -> "SystemStudy":
        if self.optics.light == "modal" and (
            self.wavefront.method != "opd" or self.wavefront.reference != "chief"
        ):
            raise ValueError(
                "optics.light = 'modal' needs wavefront.method = 'opd' and wavefront.reference = 'chief'"
            )
        return self

    @model_validator(mode="after")
    def _bodies_have_names_of_their_own(self) -> "SystemStudy":
        names = [body.name for body in self.body] + [surface.name for surface in self.system.surface]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"two bodies or surfaces are called {twice!r}; each needs a name of its own")
        return self

    @model_validator(mode="after")
    def _links_join_bodies(self) -> "SystemStudy":
        given = [key for key in _OF_MASSES if key in self.model_fields_set and getattr(self, key)]
        if given and not any(body.kind for body in self.body):
            raise ValueError(f"the section {given[0]} is of {NO_MASS}")
        return self

    @model_validator(mode="after")
    def _models_are_drawn_at_random(self) -> "SystemStudy":
        require_independent_sets(self.structure.uncertain, self.campaign.sampling)
        return self

    @model_validator(mode="after")
    def _sampling_is_complete(self) -> "SystemStudy":
        whole_sets(self.campaign, [entry.share for entry in self.disturbance])
        return self

    @property
    def repeated(self) -> tuple[str, ...]:
        """Names of the disturbances that have cases which are all alike: nothing in them is random."""
        return tuple(entry.name for entry in self.disturbance if entry.share and self._is_given(entry))

    def _is_given(self, entry: ElementDisturbance) -> bool:
        sources = parts(self.disturbance, entry)
        return all(part.instants_of_file() is not None or not part.random for part in sources)

    @property
    def disturbed(self) -> "SystemStudy":
        """The study of the system and its disturbances alone."""
        return self

    @property
    def compared(self) -> tuple[str, ...]:
        """Models of elastic bodies that are compared, the full one first; a draw is a case with each."""
        return (FULL, *self.reduction.variants) if self.reduction is not None else (FULL,)

    @property
    def cases(self) -> int:
        """Number of cases to run: where nothing is random, each disturbance has one at its share."""
        shares = [entry.share for entry in self.disturbance if entry.share]
        if len(self.repeated) < len(shares):
            return self.campaign.cases
        return min(self.campaign.cases, sum(shares) * len(self.compared))

    @property
    def fewest_instants(self) -> int:
        """Number of instants of the shortest case."""
        return min(entry.instants for entry in self.disturbance if entry.share)

    @property
    def stores_images(self) -> bool:
        """Whether exposures are computed."""
        return self.imaging is not None

    @classmethod
    def read_files(cls, record: dict[str, Any], base: Path) -> None:
        """Read the lens file, the spectra of the line of sight, and histories."""
        if isinstance(record.get("system"), dict):
            embed_file(record["system"], base)
        embed_picture(record, base)
        read_source_files(record, base)
        read_body_files(record, base)
