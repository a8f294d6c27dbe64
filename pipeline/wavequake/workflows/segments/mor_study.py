"""Study files of ``segment-mor``: a segment's reduced models on their supports, judged by the telescope."""

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from wavequake.campaign.schema import Section, StoreSection, Study, each_once, text_of
from wavequake.mechanics.disturbances.sources.static_random import StaticRandom
from wavequake.optics.polynomials.zernike import MOST_TERMS
from wavequake.workflows.mirrors.segment_section import SegmentModelSection
from wavequake.workflows.mirrors.study import (
    CriterionSection,
    Excitations,
    ReductionSection,
    TimeSection,
    VariantsCampaignSection,
)
from wavequake.workflows.segments.study import ImagingSection, SegmentStudy, SegmentWavefrontSection
from wavequake.workflows.segments.telescope_section import OpticsSection, TelescopeSection


class SegmentsSection(Section):
    """Which segments of the telescope are shaken, and how one differs from another."""

    disturbed: tuple[Literal["one", "all"], ...] = Field(
        default=("one", "all"),
        min_length=1,
        strict=False,
        description="one segment, all of them, or each of both",
    )
    name: str | None = Field(default=None, description="the one segment; default: the first of the telescope")
    signs: Literal["random", "alike"] = Field(
        default="random",
        description="of sinusoids, blows and records, which are the same at all segments but for their sign",
    )
    figure_terms: int = Field(
        default=21, ge=4, le=66, description="Zernike terms of a segment's figure over its circle"
    )

    @field_validator("name", mode="before")
    @classmethod
    def _names_may_be_numbers(cls, value: object) -> object:
        return str(value) if type(value) is int else value

    _each_once = field_validator("disturbed")(each_once)


class TracedTimeSection(TimeSection):
    """Instants of the time response, and how many of them are traced through the telescope."""

    duration_s: float = Field(default=0.1, gt=0, description="from rest to the last instant")
    step_s: float = Field(default=5e-4, gt=0, description="between two instants of the response")
    traced: int = Field(default=48, ge=1, le=4096, description="at most, evenly spread; 16 fill a tile")


class SegmentMorOpticsSection(Section):
    """Light and rays, and the Zernike terms of the telescope's wavefront."""

    wavelength_nm: float = Field(default=550.0, gt=0, le=1e6, description="of the light; default: green")
    sampling: Literal["segments", "sunflower"] = Field(
        default="segments", description="rays over all glass, or over the annulus of the pupil"
    )
    rays_per_segment: Literal[6, 18, 36, 72] = Field(
        default=36, description="of a hexagon, six triangles; 72 for few, large segments"
    )
    rays: int = Field(default=2000, ge=10, le=2_000_000, description="sunflower: rays over the annulus")
    field_arcmin: tuple[float, float] = Field(default=(0.0, 0.0), strict=False, description="of the star")
    zernike_terms: int = Field(
        default=45, ge=4, le=MOST_TERMS, description="Noll coefficients fitted to the wavefront, from piston"
    )


class SegmentMorImagingSection(Section):
    """The exposure over the traced instants."""

    pixels: int = Field(default=32, ge=8, le=512, multiple_of=2, description="along one side of the image")
    sampling: float = Field(default=0.25, gt=0, le=0.5, description="pixel in lambda/D")


class SegmentMorStoreSection(StoreSection):
    """Where the results go, and what of them is kept."""

    chunk_cases: int = Field(default=3, ge=1, le=100_000, description="K: cases per task and per shard")


class SegmentMorStudy(Study):
    """A validated study file of ``segment-mor``: cases are variants, with one or all segments shaken."""

    telescope: TelescopeSection
    model: SegmentModelSection = SegmentModelSection()
    segments: SegmentsSection = SegmentsSection()
    reduction: ReductionSection
    excitation: Excitations
    time: TracedTimeSection = TracedTimeSection()
    optics: SegmentMorOpticsSection = SegmentMorOpticsSection()
    imaging: SegmentMorImagingSection = SegmentMorImagingSection()
    criterion: CriterionSection = CriterionSection()
    campaign: VariantsCampaignSection = VariantsCampaignSection()
    store: SegmentMorStoreSection = SegmentMorStoreSection()

    @model_validator(mode="after")
    def _sections_fit_each_other(self) -> "SegmentMorStudy":
        names = [entry.name for entry in self.excitation]
        for name in self.criterion.excitations:
            if name not in names:
                raise ValueError(f"criterion.excitations names {name!r}; there are {', '.join(names)}")
        for entry in self.excitation:
            if self.model.support == "rigid" and entry.acts == "force":
                raise ValueError(
                    f"the excitation {entry.name!r} is a force, but rigid supports that carry a force hold "
                    "nothing; choose model.support = 'springs'"
                )
            if self.model.support == "springs" and entry.others == "free":
                raise ValueError(
                    f"the excitation {entry.name!r} leaves other directions free, but springs hold them; "
                    "leave others out, or choose model.support = 'rigid'"
                )
        return self

    @property
    def compared(self) -> tuple[str, ...]:
        """The variants, the reference first."""
        return self.reduction.compared

    @property
    def cases(self) -> int:
        """All variants with one and with all segments shaken, or as many as the campaign asks for."""
        every = len(self.segments.disturbed) * len(self.compared)
        return min(self.campaign.cases or every, every)

    @property
    def fewest_instants(self) -> int:
        """Number of traced instants of each case."""
        return min(self.time.traced, self.time.instants - 1)

    @property
    def stores_images(self) -> bool:
        """Whether images are computed of a case."""
        return True

    @classmethod
    def read_files(cls, record: dict[str, Any], base: Path) -> None:
        """Read the tables of the telescope and the records of the excitations."""
        SegmentStudy.read_files(record, base)
        for entry in record.get("excitation") or ():
            if isinstance(entry, dict) and isinstance(entry.get("file"), str):
                entry["file_csv"] = text_of(base / entry["file"], f"excitation.{entry.get('name')}.file")


def telescope_study(study: SegmentMorStudy) -> SegmentStudy:
    """Return the telescope, light and image as a study of ``segment-disturbance``, whose bench is reused.

    Its only disturbance is a figure of zero, which says how many terms a segment's figure has.
    """
    optics = OpticsSection(**study.optics.model_dump(exclude={"zernike_terms"}))
    return SegmentStudy(
        study=study.study.model_copy(update={"workflow": "segment-disturbance", "title": ""}),
        telescope=study.telescope,
        disturbance=(StaticRandom(name="figure", figure_nm={study.segments.figure_terms: 0.0}, instants=1),),
        optics=optics,
        wavefront=SegmentWavefrontSection(zernike_terms=study.optics.zernike_terms),
        imaging=ImagingSection(pixels=study.imaging.pixels, sampling=study.imaging.sampling),
    )
