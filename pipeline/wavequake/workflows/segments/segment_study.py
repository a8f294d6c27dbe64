"""Study files of the workflow "segment-disturbance": a telescope, its light, what disturbs its segments."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from wavequake.campaign.schema import Section, StoreSection, Study, text_of
from wavequake.chain.sampling import SampledCampaignSection, whole_sets
from wavequake.chain.sources import read_source_files
from wavequake.kernels.trace.status import MOST_SURFACES
from wavequake.mechanics.disturbances.registry import Combine, Disturbance, with_own_axes
from wavequake.optics.polynomials.zernike import MOST_TERMS
from wavequake.optics.shapes.polygon_table import read_polygons


class SurfaceSection(Section):
    """One surface of a custom telescope after M1 (the last one is the image plane)."""

    name: str
    radius_mm: float | None = Field(
        default=None, description="None is a plane; positive if the center lies on +z"
    )
    conic: float = 0.0
    distance_mm: float = Field(description="along the light from the previous surface", gt=0)
    tilt_deg: float = Field(default=0.0, gt=-90, lt=90, description="of a fold mirror about its y axis")
    semi_diameter_mm: float | None = Field(
        default=None, gt=0, description="light beyond it is vignetted; None is a mirror without an edge"
    )


class TelescopeSection(Section):
    """Which telescope, and what may be changed of it."""

    name: Literal["tmt", "tmt-18", "tmt-thesis", "jwst", "custom"]
    side_mm: float | None = Field(default=None, gt=0, description="tmt-18: side length of the hexagons")
    gap_mm: float | None = Field(default=None, ge=0, description="tmt, tmt-18: gap between the segments")
    polygons: str | None = Field(
        default=None, exclude=True, description="custom: CSV file of polygons (read when the study is loaded)"
    )
    polygons_csv: str | None = Field(default=None, description="custom: the text of that file")
    corners: str | None = Field(
        default=None,
        exclude=True,
        description="tmt, tmt-18, jwst: CSV file segment,corner,dx_mm,dy_mm of displaced corners of glass; "
        "corners count from 1, counter-clockwise (read when the study is loaded)",
    )
    corners_csv: str | None = Field(default=None, description="the text of that file")
    primary_radius_mm: float | None = Field(
        default=None, lt=0, description="custom: radius of M1, concave < 0"
    )
    primary_conic: float = -1.0
    surfaces: tuple[SurfaceSection, ...] = Field(default=(), strict=False, max_length=MOST_SURFACES)

    @model_validator(mode="after")
    def _keys_fit_the_telescope(self) -> "TelescopeSection":
        owners = {
            "side_mm": ("tmt-18",),
            "gap_mm": ("tmt", "tmt-18"),
            "corners": ("tmt", "tmt-18", "jwst"),
            "corners_csv": ("tmt", "tmt-18", "jwst"),
            "polygons": ("custom",),
            "polygons_csv": ("custom",),
            "primary_radius_mm": ("custom",),
            "surfaces": ("custom",),
            "primary_conic": ("custom",),
        }
        for key, names in owners.items():
            default = type(self).model_fields[key].default
            if getattr(self, key) != default and self.name not in names:
                raise ValueError(f"{key} belongs to the telescope {' or '.join(names)}, not to {self.name}")
        if self.name == "custom":
            for key in ("primary_radius_mm", "surfaces"):
                if getattr(self, key) in (None, ()):
                    raise ValueError(f"a custom telescope needs {key}")
            if self.polygons is None and self.polygons_csv is None:
                raise ValueError("a custom telescope needs polygons, a CSV file")
        return self


class OpticsSection(Section):
    """Light and rays."""

    wavelength_nm: float = Field(default=550.0, gt=0, le=1e6)
    sampling: Literal["segments", "sunflower"] = Field(
        default="segments",
        description="rays over all glass, or over the annulus of the pupil; the glass of tmt-18 reaches to "
        "1.21 times the radius of its annulus, where the polynomials are not orthogonal: "
        "take sunflower where its coefficients matter",
    )
    rays_per_segment: Literal[6, 18, 36, 72] = Field(
        default=18,
        description="of a hexagon, six triangles: 18 for piston and tilt; "
        "36 for figures j <= 6, 72 for higher ones and for few, large segments",
    )
    rays: int = Field(default=2000, ge=10, le=2_000_000, description="sunflower: rays over the annulus")
    field_arcmin: tuple[float, float] = Field(
        default=(0.0, 0.0), strict=False, description="of the star; the image plane stays, not refocused"
    )
    method: Literal["standard", "modal"] = Field(
        default="standard",
        description="of segment-disturbance: trace every instant, or take wavefronts from derivatives that "
        "are traced once (modal: for up to millions of cases of small motions; no images)",
    )
    modal_tolerance_nm: float = Field(
        default=0.1,
        gt=0,
        description="modal: a case whose OPD may miss this much of second order (rms) is traced in full",
    )
    modal_sample: float = Field(
        default=0.001,
        ge=0,
        le=1,
        description="modal: share of cases that are traced besides, to measure the error; the first 100 "
        "cases always are",
    )


class WavefrontSection(Section):
    """What is fitted to the wavefront, and to what of it."""

    zernike_terms: int = Field(default=45, ge=4, le=MOST_TERMS)
    method: Literal["opd", "slopes"] = Field(
        default="opd",
        description="coefficients and line of sight from path lengths, or from ray slopes alone "
        "(Störkle 2018, Eq. 4.20): these see tilts and figures, but no piston of a segment or of the pupil",
    )
    basis: Literal["annular", "circular"] = Field(
        default="annular",
        description="of the stored coefficients; circular ones are equivalent (Eq. 3.53), but the sum of "
        "their squares is not the rms over the annulus, which stays that of the annular ones",
    )
    reference: Literal["chief", "fitted"] = Field(
        default="chief",
        description="center of the reference sphere in the image: where the virtual chief ray arrives, or "
        "that of the sphere that fits the wavefront best (section 3.3.3; needs method opd)",
    )

    @model_validator(mode="after")
    def _slopes_have_no_sphere(self) -> "WavefrontSection":
        require_path_lengths(self.method, self.reference)
        return self


def require_path_lengths(method: str, reference: str) -> None:
    """Raise ValueError if a sphere is to be fitted to wavefronts whose path lengths are not to be used."""
    if method == "slopes" and reference == "fitted":
        raise ValueError("reference = 'fitted' needs path lengths; choose method = 'opd' for it")


class ImagingSection(Section):
    """The exposure of each case: mean of its instants' point spread functions."""

    enabled: bool = Field(default=True, description="false: no exposures, which are most of the work")
    pixels: int = Field(default=64, ge=8, le=512, multiple_of=2)
    sampling: float = Field(default=0.25, gt=0, le=0.5, description="pixel in lambda/D")
    moments: Literal["auto", 1, 6, 15] = Field(
        default="auto", description="1: piston, 6/15: tip and tilt to 2nd/4th order"
    )


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

    keep: tuple[Literal["segment_motion"], ...] = Field(default=(), strict=False)

    def identity_record(self) -> dict[str, object]:
        """Return all keys that say what is kept: stores of segmented telescopes always had them."""
        always = self.model_dump(mode="json", exclude={"path", "chunk_cases", "images"})
        return always | super().identity_record()


class SegmentStudy(Study):
    """A validated study file."""

    campaign: SampledCampaignSection = SampledCampaignSection()
    telescope: TelescopeSection
    disturbance: tuple[Disturbance, ...] = Field(min_length=1, strict=False)
    optics: OpticsSection = OpticsSection()
    wavefront: WavefrontSection = WavefrontSection()
    imaging: ImagingSection = ImagingSection()
    store: SegmentStoreSection = SegmentStoreSection()
    rare: RareSection | None = None

    @model_serializer(mode="wrap")
    def _no_rare_section_where_there_is_none(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        record: dict[str, Any] = handler(self)
        if self.rare is None:
            record.pop("rare", None)
        return record

    @field_validator("disturbance")
    @classmethod
    def _names_are_unique(cls, value: tuple[Any, ...]) -> tuple[Any, ...]:
        names = [entry.name for entry in value]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two disturbances are called {name!r}; each needs a name of its own")
        for entry in value:
            chosen = getattr(entry, "of", ())
            if not isinstance(entry, Combine):
                twice = next((name for name in chosen if chosen.count(name) > 1), None)
                if twice is not None:
                    raise ValueError(f"{entry.name!r} names {twice!r} twice; name it once")
                continue
            if len(set(chosen)) < len(chosen):
                raise ValueError(f"{entry.name!r} combines a disturbance with itself; name each one once")
            for part in chosen:
                if part not in names or part == entry.name:
                    raise ValueError(
                        f"{entry.name!r} combines {part!r}, which is not another disturbance of this study"
                    )
        if not any(entry.share for entry in value):
            raise ValueError("every disturbance has share 0, so there is nothing to run")
        return with_own_axes(value)

    @model_validator(mode="after")
    def _sections_fit_each_other(self) -> "SegmentStudy":
        store, wavefront = self.store, self.wavefront
        modal = self.optics.method == "modal"
        if self.study.workflow == "segment-disturbance":
            whole_sets(self.campaign, [entry.share for entry in self.disturbance])
        elif self.campaign.sampling != "random":
            raise ValueError(
                "campaign.sampling belongs to the workflows segment-disturbance and system-disturbance"
            )
        if self.study.workflow != "segment-disturbance" and (modal or not self.imaging.enabled):
            raise ValueError(
                "optics.method = 'modal' and imaging.enabled = false belong to the workflow "
                "segment-disturbance"
            )
        if modal and self.imaging.enabled:
            raise ValueError("optics.method = 'modal' makes no images; set imaging.enabled = false")
        if modal and (wavefront.method != "opd" or wavefront.reference != "chief"):
            raise ValueError(
                "optics.method = 'modal' needs wavefront.method = 'opd' and wavefront.reference = 'chief'"
            )
        if self.rare is not None:
            self._rare_cases_can_be_drawn()
        if store.reduce == "summary" and store.keep:
            raise ValueError("store.reduce = 'summary' keeps nothing over time; leave store.keep out")
        return self

    def _rare_cases_can_be_drawn(self) -> None:
        if self.study.workflow != "segment-disturbance" or self.optics.method == "modal":
            raise ValueError(
                "rare belongs to the workflow segment-disturbance, with optics.method = 'standard'"
            )
        if self.campaign.sampling != "random" or self.campaign.until is not None:
            raise ValueError("rare draws cases near a limit; leave campaign.sampling and campaign.until out")
        if sum(entry.share > 0 for entry in self.disturbance) != 1:
            raise ValueError("rare needs one disturbance; give share = 0 to the others")

    @property
    def fewest_instants(self) -> int:
        """Number of instants of the shortest case."""
        return min(entry.instants for entry in self.disturbance if entry.share)

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
