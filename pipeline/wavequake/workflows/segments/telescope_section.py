"""The telescope of a study of segments, one by name or of one's own, and the light that it takes in."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from wavequake.campaign.schema import Section
from wavequake.chain.modal_options import Light, ModalSample, ModalTolerance, with_light, with_method
from wavequake.kernels.trace.status import MOST_SURFACES
from wavequake.optics.sections import Pair


class SurfaceSection(Section):
    """One surface of a custom telescope after M1 (the last one is the image plane)."""

    name: str = Field(description="by which disturbances and results speak of it")
    radius_mm: float | None = Field(
        default=None, description="None is a plane; positive if the center lies on +z"
    )
    conic: float = Field(default=0.0, description="conic constant: 0 a sphere, -1 a paraboloid")
    even_asphere: tuple[float, ...] = Field(
        default=(), strict=False, max_length=8, description="of rho^2, rho^4, ... in mm^-1, mm^-3, ..."
    )
    distance_mm: float = Field(description="along the light from the previous surface", gt=0)
    tilt_deg: float = Field(
        default=0.0,
        gt=-90,
        lt=90,
        description="of a fold mirror about its y axis; a lens or window turns alone",
    )
    semi_diameter_mm: float | None = Field(
        default=None, gt=0, description="light beyond it is vignetted; None is a mirror without an edge"
    )
    glass: str | Annotated[float, Field(gt=0)] | None = Field(
        default=None,
        description='of a lens or window: what follows, a glass, an index or "air"; None is a mirror',
    )
    body: str | None = Field(
        default=None,
        min_length=1,
        description="name by which the surfaces that have it, such as the faces of a lens, move together",
    )

    @model_serializer(mode="wrap")
    def _conic_mirrors_say_nothing_of_others(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        record: dict[str, Any] = handler(self)
        for key in ("even_asphere", "glass", "body"):
            if not getattr(self, key):
                record.pop(key, None)
        return record


# Telescopes whose glass is that of polygons which belong to their names.
_OF_POLYGONS = ("tmt", "tmt-18", "jwst", "elt", "keck", "gtc", "het", "gmt")


class TelescopeSection(Section):
    """Which telescope, and what may be changed of it."""

    name: Literal["tmt", "tmt-18", "tmt-thesis", "jwst", "elt", "keck", "gtc", "het", "gmt", "custom"] = (
        Field(description="of a bundled telescope, or custom: one of your own")
    )
    side_mm: float | None = Field(default=None, gt=0, description="tmt-18: side length of the hexagons")
    gap_mm: float | None = Field(default=None, ge=0, description="tmt, tmt-18: gap between the segments")
    polygons: str | None = Field(
        default=None, exclude=True, description="custom: CSV file of polygons (read when the study is loaded)"
    )
    polygons_csv: str | None = Field(default=None, description="custom: the text of that file")
    corners: str | None = Field(
        default=None,
        exclude=True,
        description="all but tmt-thesis and custom: CSV file segment,corner,dx_mm,dy_mm of displaced "
        "corners of glass; corners count from 1, counter-clockwise (read when the study is loaded)",
    )
    corners_csv: str | None = Field(default=None, description="the text of that file")
    primary_radius_mm: float | None = Field(
        default=None, lt=0, description="custom: radius of M1, concave < 0"
    )
    primary_conic: float = Field(
        default=-1.0, description="custom: conic constant of M1; default: a paraboloid"
    )
    surfaces: tuple[SurfaceSection, ...] = Field(default=(), strict=False, max_length=MOST_SURFACES)

    @model_validator(mode="after")
    def _keys_fit_the_telescope(self) -> "TelescopeSection":
        owners = {
            "side_mm": ("tmt-18",),
            "gap_mm": ("tmt", "tmt-18"),
            "corners": _OF_POLYGONS,
            "corners_csv": _OF_POLYGONS,
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


# What there may be several of, in the order of `OpticsSection.alternatives`.
PLACES = ("field point", "wavelength")


class OpticsSection(Section):
    """Light and rays."""

    wavelength_nm: float = Field(default=550.0, gt=0, le=1e6, description="of the light; default: green")
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
    fields_arcmin: tuple[Pair, ...] | None = Field(
        default=None,
        strict=False,
        min_length=1,
        max_length=32,
        description="several stars at once, in place of field_arcmin: numbers get the dimension field, and "
        "all stars see the same motion; M2 is tilted for the line of sight of the first one",
    )
    wavelengths_nm: tuple[Annotated[float, Field(gt=0, le=1e6)], ...] | None = Field(
        default=None,
        strict=False,
        min_length=1,
        max_length=32,
        description="several wavelengths at once, in place of wavelength_nm: numbers get the dimension "
        "wavelength; lambda/D is that of the first one",
    )
    light: Light = Field(
        default="traced",
        description="of segment-disturbance: trace every instant, or take wavefronts from derivatives that "
        "are traced once (modal: for up to millions of cases of small motions; no images)",
    )
    modal_tolerance_nm: ModalTolerance = 0.1
    modal_sample: ModalSample = 0.001

    alternatives: ClassVar = (("field_arcmin", "fields_arcmin"), ("wavelength_nm", "wavelengths_nm"))

    @property
    def points_arcmin(self) -> tuple[tuple[float, float], ...]:
        """All field points."""
        return self.fields_arcmin or (self.field_arcmin,)

    @property
    def colors_nm(self) -> tuple[float, ...]:
        """All wavelengths; lambda/D is that of the first one."""
        return self.wavelengths_nm or (self.wavelength_nm,)

    @model_validator(mode="after")
    def _places_are_different(self) -> "OpticsSection":
        for one, several, what in zip(*zip(*self.alternatives, strict=True), PLACES, strict=True):
            given = getattr(self, several)
            if given is None:
                continue
            if one in self.model_fields_set:
                raise ValueError(f"{one} and {several} are given; choose one")
            if len(set(given)) < len(given):
                raise ValueError(f"{several} names a {what} twice")
        if self.wavelengths_nm is not None:  # what asks for one wavelength means the first one
            object.__setattr__(self, "wavelength_nm", self.wavelengths_nm[0])
            self.model_fields_set.discard("wavelength_nm")
        return self

    @model_serializer(mode="wrap")
    def _one_kind_of_field(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        record: dict[str, Any] = handler(self)
        for one, several in self.alternatives:
            record.pop(several if getattr(self, several) is None else one, None)
        return with_method(record)

    @model_validator(mode="before")
    @classmethod
    def _method_is_light(cls, given: Any) -> Any:
        return with_light(given)
