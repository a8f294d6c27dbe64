"""Study files of the workflow "segment-disturbance": a telescope, its light, what disturbs its segments."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from wavequake.campaign.schema import Section, StoreSection, text_of
from wavequake.chain.images.camera import SharedImagingSection
from wavequake.chain.images.picture import embed_picture
from wavequake.chain.sampling import whole_sets
from wavequake.chain.sources import read_source_files
from wavequake.chain.uncertain import require_independent_sets
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.registry import Disturbance
from wavequake.mechanics.disturbances.sources.base_motion import SegmentShaking
from wavequake.mechanics.disturbances.sources.segment_wind import SegmentWind
from wavequake.optics.polynomials.zernike import MOST_TERMS
from wavequake.optics.shapes.polygon_table import read_polygons
from wavequake.workflows.bodies.files import read_body_files
from wavequake.workflows.bodies.sections import NO_MASS
from wavequake.workflows.bodies.segment_sections import (
    ComparedSegmentsSection,
    SegmentStructureSection,
    UncertainSupports,
    without_bodies,
)
from wavequake.workflows.disturbed_study import DisturbedStudy, WavefrontSection
from wavequake.workflows.mirrors.segment_section import ElasticSegmentSection
from wavequake.workflows.mirrors.study import FULL
from wavequake.workflows.segments.telescope_section import PLACES, OpticsSection, TelescopeSection


class SegmentWavefrontSection(WavefrontSection):
    """What is fitted to the wavefront, and to what of it."""

    zernike_terms: int = Field(
        default=45, ge=4, le=MOST_TERMS, description="Noll coefficients fitted to the wavefront, from piston"
    )


class ImagingSection(SharedImagingSection):
    """The exposure of each case: mean of its instants' point spread functions."""

    enabled: bool = Field(default=True, description="false: no exposures, which are most of the work")
    pixels: int = Field(default=64, ge=8, le=512, multiple_of=2, description="along one side of the image")
    sampling: float = Field(default=0.25, gt=0, le=0.5, description="pixel in lambda/D")
    moments: Literal["auto", 1, 6, 15] = Field(
        default="auto", description="1: piston, 6/15: tip and tilt to 2nd/4th order"
    )
    wavelengths_nm: tuple[Annotated[float, Field(gt=0)], ...] | None = Field(
        default=None,
        strict=False,
        min_length=1,
        max_length=33,
        description="colors of the images; default: that of optics.wavelength_nm, whose lambda/D is the unit",
    )
    weights: tuple[Annotated[float, Field(ge=0)], ...] | None = Field(
        default=None, strict=False, description="light of each color; default: the same of all"
    )

    engine: Literal["auto", "segments", "rays"] = Field(
        default="auto",
        description="exact images of segments that are planes of phase, or sums over rays; auto: rays where "
        "segments or mirrors bend, mirrors stop light or M1 has no edges",
    )

    _new: ClassVar = (*SharedImagingSection._new, "wavelengths_nm", "weights", "engine")

    @model_validator(mode="after")
    def _colors_have_light(self) -> "ImagingSection":
        if self.weights is not None and (
            len(self.weights) != len(self.wavelengths_nm or ()) or not sum(self.weights) > 0.0
        ):
            raise ValueError("weights has one number for each of wavelengths_nm, and one above 0")
        return self


class RareSection(Section):
    """A limit near which all cases are drawn; their weights undo it (docs/decide.md)."""

    measure: str = Field(
        default="wfe_rms", description="wfe_rms, wfe_rms_raw, zernike[noll=4], los or centroid"
    )
    limit: float | None = Field(
        default=None, gt=0, description="of its rms over the instants, in the unit that is stored"
    )
    probability: float | None = Field(
        default=None, gt=1e-200, lt=0.5, description="with which the limit is exceeded, in the place of it"
    )

    @model_validator(mode="after")
    def _one_limit(self) -> "RareSection":
        if (self.limit is None) == (self.probability is None):
            raise ValueError("give either a limit or a probability")
        return self


class SegmentStoreSection(StoreSection):
    """Where the results go, and what of them is kept."""

    keep: tuple[Literal["segment_motion"], ...] = Field(
        default=(), strict=False, description="what to store beside the measures: motion of every segment"
    )

    def identity_record(self) -> dict[str, object]:
        """Return all keys that say what is kept: stores of segmented telescopes always had them."""
        always = self.model_dump(mode="json", exclude={"path", "chunk_cases", "images"})
        return always | super().identity_record()


class SegmentStudy(DisturbedStudy):
    """A validated study file."""

    telescope: TelescopeSection
    segment: ElasticSegmentSection | None = None
    disturbance: tuple[Disturbance, ...] = Field(min_length=1, strict=False)
    optics: OpticsSection = OpticsSection()
    wavefront: SegmentWavefrontSection = SegmentWavefrontSection()
    imaging: ImagingSection = ImagingSection()
    store: SegmentStoreSection = SegmentStoreSection()
    rare: RareSection | None = None
    structure: SegmentStructureSection | None = None
    reduction: ComparedSegmentsSection | None = None

    @model_serializer(mode="wrap")
    def _no_sections_where_there_are_none(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        record: dict[str, Any] = handler(self)
        absent = ["rare", "detector", "segment", "structure", "reduction"]
        absent += ["object"] * (self.study.workflow != "telescope-exposure")  # which always says it
        for key in absent:
            if getattr(self, key) is None:
                record.pop(key, None)
        return record if self.body else without_bodies(record)

    @model_validator(mode="after")
    def _sections_fit_each_other(self) -> "SegmentStudy":
        store = self.store
        if self.segment is not None and not any(isinstance(one, SegmentShaking) for one in self.disturbance):
            raise ValueError(
                "the section segment belongs to model = 'segment-shaking'; add such a disturbance"
            )
        modal = self.optics.light == "modal"
        if self.study.workflow == "segment-disturbance":
            whole_sets(self.campaign, [entry.share for entry in self.disturbance])
        elif self.campaign.sampling != "random":
            raise ValueError(
                "campaign.sampling belongs to the workflows segment-disturbance and system-disturbance"
            )
        if self.study.workflow != "segment-disturbance" and (modal or not self.imaging.enabled):
            raise ValueError(
                "optics.light = 'modal' and imaging.enabled = false belong to the workflow "
                "segment-disturbance"
            )
        if modal and self.imaging.enabled:
            raise ValueError("optics.light = 'modal' makes no images; set imaging.enabled = false")
        self._places_can_be_several()
        self._camera_has_images()
        if self.reduction is not None:
            self._models_can_be_compared()
        self._bodies_fit()
        if self.structure is not None and self.structure.uncertain is not None:
            self._models_can_be_drawn(self.structure.uncertain)
        if self.rare is not None:
            self._rare_cases_can_be_drawn()
        for name in sorted(self.asked):
            if getattr(self, name) is not None and self.study.workflow != "segment-disturbance":
                raise ValueError(f"{name} belongs to the workflow segment-disturbance")
        if store.reduce == "summary" and store.keep:
            raise ValueError("store.reduce = 'summary' keeps nothing over time; leave store.keep out")
        return self

    def _places_can_be_several(self) -> None:
        for one, several in self.optics.alternatives:
            if getattr(self.optics, several) is None:
                continue
            if self.study.workflow != "segment-disturbance" or self.optics.light == "modal":
                raise ValueError(
                    f"optics.{several} belongs to the workflow segment-disturbance, with optics.light = "
                    f"'traced'; give one optics.{one}"
                )
            if self.rare is not None:
                raise ValueError(f"rare needs one of them: give optics.{one}, not {several}")
        if self.optics.wavelengths_nm is not None and self.imaging.wavelengths_nm is not None:
            raise ValueError(
                "imaging.wavelengths_nm adds colors to one image, optics.wavelengths_nm makes images of each "
                "color; choose one"
            )

    def require_one_place(self, what: str) -> None:
        """Raise UserError, naming what is of one field point and wavelength, if there are several."""
        for (one, several), words in zip(self.optics.alternatives, PLACES, strict=True):
            if getattr(self.optics, several) is not None:
                raise UserError(
                    f"{what} of one {words}: choose one by optics.{one} in the place of optics.{several}."
                )

    def _camera_has_images(self) -> None:
        given = [f"imaging.{key}" for key in self.imaging.asked]
        given += ["detector"] * (self.detector is not None)
        if self.object is not None:
            self.object.chosen()
            given += ["object"] * (self.study.workflow not in ("telescope-exposure", "telescope-loop"))
        if given and self.study.workflow != "segment-disturbance":
            raise ValueError(f"{given[0]} belongs to the workflow segment-disturbance")
        if given and not self.imaging.enabled:
            raise ValueError(f"{given[0]} is of images; leave imaging.enabled = false out")
        shortest = min(self.imaging.wavelengths_nm or self.optics.colors_nm)
        if self.imaging.sampling * self.optics.wavelength_nm > 0.5 * shortest * (1.0 + 1e-9):
            raise ValueError(
                f"imaging.sampling must be at most {0.5 * shortest / self.optics.wavelength_nm:.3g} for "
                f"{shortest:g} nm: half of its lambda/D"
            )

    def _models_can_be_compared(self) -> None:
        if self.study.workflow != "segment-disturbance" or self.optics.light == "modal" or self.rare:
            raise ValueError(
                "reduction belongs to the workflow segment-disturbance, with optics.light = 'traced' and "
                "without rare"
            )
        if not (self.segment or any(one.mirror or one.imported for one in self.body)):
            raise ValueError(
                "reduction compares models of elastic segments and bodies with the full ones: add the "
                "section segment, or a [[body]] that is a mirror or imported"
            )
        if self.segment is not None and self.segment.reduced != FULL:
            raise ValueError("reduction compares models with the full one: choose it without segment.reduced")
        if self.campaign.sampling != "random":
            raise ValueError("reduction draws every case at random; leave campaign.sampling out")

    def _bodies_fit(self) -> None:
        massive = any(one.kind for one in self.body)
        if self.link and not massive:
            raise ValueError(f"the section link is of {NO_MASS}")
        structure = self.structure
        if structure is not None and not massive and structure.model_fields_set != {"uncertain"}:
            key = min(structure.model_fields_set - {"uncertain"}, default="")
            raise ValueError(f"{f'structure.{key}' if key else 'the section structure'} is of {NO_MASS}")

    def _models_can_be_drawn(self, uncertain: UncertainSupports) -> None:
        if self.study.workflow != "segment-disturbance":
            raise ValueError("structure.uncertain belongs to the workflow segment-disturbance")
        massive = any(one.kind for one in self.body)
        if not massive and not any(isinstance(entry, SegmentWind) for entry in self.disturbance):
            raise ValueError(
                "structure.uncertain is of the segments' supports, on which segment-wind pushes; this study "
                "has no such disturbance"
            )
        if not massive and uncertain.shapes:
            raise ValueError(f"structure.uncertain.shapes is of {NO_MASS}")
        require_independent_sets(uncertain, self.campaign.sampling)

    def _rare_cases_can_be_drawn(self) -> None:
        if self.study.workflow != "segment-disturbance" or self.optics.light == "modal":
            raise ValueError("rare belongs to the workflow segment-disturbance, with optics.light = 'traced'")
        if self.campaign.sampling != "random" or self.campaign.until is not None:
            raise ValueError("rare draws cases near a limit; leave campaign.sampling and campaign.until out")
        if sum(entry.share > 0 for entry in self.disturbance) != 1:
            raise ValueError("rare needs one disturbance; give share = 0 to the others")

    def unused_keys(self, one_piece: bool) -> Iterator[str]:
        """Yield a sentence on a number of rays that is not of the sampling of this study."""
        optics = self.optics
        used = "sunflower" if one_piece else optics.sampling
        why = "M1 is of one piece" if one_piece else f"optics.sampling is {used!r}"
        for key, sampling in (("rays", "sunflower"), ("rays_per_segment", "segments")):
            if sampling != used and getattr(optics, key) != type(optics).model_fields[key].default:
                yield f"optics.{key} has no effect, as {why}"

    @property
    def stores_images(self) -> bool:
        """Whether images are computed of a case."""
        return self.imaging.enabled

    @classmethod
    def read_files(cls, record: dict[str, Any], base: Path) -> None:
        """Read the polygons of the telescope and the tables of the disturbances."""
        telescope = record.get("telescope")
        if isinstance(telescope, dict) and isinstance(telescope.get("polygons"), str):
            path = base / telescope["polygons"]
            telescope["polygons_csv"] = text_of(path, "telescope.polygons")
            read_polygons(path)  # here an error can name the file
        if isinstance(telescope, dict) and isinstance(telescope.get("corners"), str):
            telescope["corners_csv"] = text_of(base / telescope["corners"], "telescope.corners")
        read_source_files(record, base)
        read_body_files(record, base)
        embed_picture(record, base)


# Keys with which a study keeps every number of its cases, and with which they are random and traced.
WHOLE: dict[str, Any] = {"store.images": "double", "store.reduce": "none", "store.every": 1, "store.keep": []}
TRACED = WHOLE | {"optics.light": "traced", "campaign.sampling": "random", "campaign.until": None}


def without_images(study: SegmentStudy) -> SegmentStudy:
    """Return a study without its images and what a camera makes of them, all else alike."""
    fields = ImagingSection.model_fields
    plain = {key: fields[key].default for key in ImagingSection._new} | {"enabled": False}
    imaging = study.imaging.model_copy(update=plain)
    return study.model_copy(update={"imaging": imaging, "detector": None, "object": None})


def segment_text(study_text: str) -> str:
    """Return the identity text of the segment-disturbance study in one of images or loops."""
    kept = SegmentStudy.model_fields.keys() - {"object"}  # what is imaged changes neither rays nor light
    record = {key: value for key, value in json.loads(study_text).items() if key in kept}
    return json.dumps(record, sort_keys=True, separators=(",", ":"))
