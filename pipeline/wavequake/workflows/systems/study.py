"""Study files of the workflow "system-disturbance": any optical system, and what moves its surfaces."""

from pathlib import Path
from typing import Any

from pydantic import Field, SerializerFunctionWrapHandler, field_validator, model_serializer, model_validator

from wavequake.campaign.schema import Section
from wavequake.chain.images.extended import check_object
from wavequake.chain.images.picture import embed_picture
from wavequake.chain.images.system import SystemImagingSection
from wavequake.chain.modal_options import Light, ModalSample, ModalTolerance, with_light, with_method
from wavequake.chain.sampling import whole_sets
from wavequake.chain.sources import read_source_files
from wavequake.chain.uncertain import require_independent_sets
from wavequake.mechanics.disturbances.element_motion import ElementDisturbance
from wavequake.mechanics.disturbances.registry import parts
from wavequake.optics.systems.file import SystemSection, embed_file
from wavequake.workflows.bodies.files import read_body_files
from wavequake.workflows.bodies.sections import (
    NO_MASS,
    StructureSection,
)
from wavequake.workflows.disturbed_study import DisturbedStudy

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


class SystemStudy(DisturbedStudy):
    """A validated study file."""

    system: SystemSection
    structure: StructureSection = StructureSection()
    disturbance: tuple[ElementDisturbance, ...] = Field(min_length=1, strict=False)
    optics: SystemOpticsSection = SystemOpticsSection()
    imaging: SystemImagingSection | None = None

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
    def _nothing_acts_on_segments(cls, value: tuple[Any, ...]) -> tuple[Any, ...]:
        for entry in value:
            if getattr(entry, "act", "mount") != "mount":
                raise ValueError(
                    f"{entry.name!r} acts on {entry.act}, which belongs to segmented telescopes; a mirror is "
                    'tilted by the model "surface-vibration"'
                )
        return value

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
    def cases(self) -> int:
        """Number of cases to run: where nothing is random, each disturbance has one at its share."""
        shares = [entry.share for entry in self.disturbance if entry.share]
        if len(self.repeated) < len(shares):
            return self.campaign.cases
        return min(self.campaign.cases, sum(shares) * len(self.compared))

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
