"""Study files of the mirror workflows: a mirror's model, its reduced variants, excitations and optics."""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    Field,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)

from wavequake.campaign.schema import (
    CampaignSection,
    Section,
    StoreSection,
    Study,
    each_once,
    require_own_names,
    text_of,
)
from wavequake.errors import UserError
from wavequake.mechanics.importers.checks import Triangle
from wavequake.mechanics.importers.model import PAD_DOFS, PADS, TRIANGLE, ZERO_ROWS, ImportedModel, Nodes
from wavequake.mechanics.importers.pads import PadDofs, PadKind
from wavequake.mechanics.vibration.excitations import AnyExcitation
from wavequake.optics.polynomials.zernike import MOST_TERMS
from wavequake.reduction.names import orders_of, parse
from wavequake.workflows.mirrors.model_store import keep_imported
from wavequake.workflows.mirrors.own_files import own_file

FULL = "full"


class ModelSection(Section):
    """The mirror: built-in shapes, or a model from a finite-element program (``file``)."""

    shapes: tuple[Literal["circular", "annular"], ...] = Field(
        default=("circular",), strict=False, description="built-in mirrors; left out where a file is given"
    )
    diameter_m: float = Field(default=1.0, gt=0, description="outer one of the mirror")
    inner_diameter_m: float = Field(default=0.4, gt=0, description="of the annular mirror")
    thickness_m: float = Field(default=0.02, gt=0, le=100, description="of the mirror, the same everywhere")
    focal_length_m: float = Field(
        default=1.7, gt=0, description="of the parabola; it puts the defocus mode of the defaults at 295 Hz"
    )
    youngs_modulus_pa: float = Field(
        default=70e9, gt=0, le=1e16, description="stress over strain, elastic; default: aluminium"
    )
    poisson_ratio: float = Field(
        default=0.33, gt=-1, lt=0.5, description="transverse contraction over extension; default: aluminium"
    )
    density_kg_m3: float = Field(
        default=2700.0,
        ge=1e-3,
        le=1e6,
        description="of the mirror; default: aluminium, as in the reference text",
    )
    mount_radius_m: float = Field(default=0.333, gt=0, description="of the interface nodes on the rear face")
    mount_angles_deg: tuple[float, ...] = Field(
        default=(0.0, 120.0, 240.0),
        strict=False,
        description="of the interface nodes, from x; default: 120 deg apart",
    )
    damping_alpha: float = Field(default=0.0, ge=0, description="1/s, times the mass")
    damping_beta: float = Field(default=5e-6, ge=0, description="s, times the stiffness")
    rings: int | None = Field(
        default=None,
        ge=1,
        le=60,
        description="elements along the radius, and around in proportion: 6 by default, less is coarser",
    )
    file: str | None = Field(
        default=None,
        exclude=True,
        description="stiffness (.sti, .mtx) or all matrices (.full, .op4, .pch, .npz, .h5)",
    )
    mass: str | None = Field(default=None, exclude=True, description="of a file; default: beside it")
    dofs: str | None = Field(default=None, exclude=True, description="of a file; default: beside it")
    mesh: str | None = Field(default=None, exclude=True, description="of a file; default: beside it")
    units: str | None = Field(default=None, description="of a file, e.g. 'm,kg,s,N'")
    interfaces: str | Nodes | None = Field(default=None, description="of a file: node set or node numbers")
    surface: str | Nodes | None = Field(default=None, description="of a file: nodes of the optical surface")
    triangle: Triangle | None = Field(default=None, exclude=True, description=f"of a file: {TRIANGLE}")
    zero_rows: Literal["drop"] | None = Field(
        default=None, exclude=True, description=f"of a file: {ZERO_ROWS}"
    )
    pads: PadKind | None = Field(default=None, exclude=True, description=f"of a file: {PADS}")
    pad_dofs: PadDofs | None = Field(default=None, exclude=True, description=f"of a file: {PAD_DOFS}")
    content: str | None = Field(
        default=None, description="SHA-256 of the imported model; filled in when the study is loaded"
    )

    @model_validator(mode="after")
    def _a_file_says_what_it_is(self) -> "ModelSection":
        files = ("mass", "dofs", "mesh")
        keys = (*files, "units", "interfaces", "surface", "triangle", "zero_rows", "pads", "pad_dofs")
        given = [key for key in keys if getattr(self, key) is not None]
        if self.content is None and given:
            raise ValueError(f"{given[0]} belongs to a model file; give file, too")
        if not self.shapes and self.content is None:
            raise ValueError("shapes is empty; name a built-in mirror, or give a file")
        return self


OwnName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]*$", max_length=40)]


class VariantsSection(Section):
    """Which reduced models are made, and up to which frequency."""

    own: dict[OwnName, str] = Field(
        default={},
        exclude=True,
        description="your own reduced models by name, to be listed in variants: .npz of basis, or of mass, "
        "stiffness, damping, inputs and surface; .mtx of a basis (read when the study is loaded)",
    )
    own_files: dict[OwnName, str] = Field(default={}, description="these files in base64")
    variants: tuple[str, ...] = Field(
        min_length=1, strict=False, description="e.g. 'craigb36'; 'craigb{18:108:18}' is 18, 36, .. 108"
    )
    last_hz: float = Field(default=1200.0, gt=0, description="upper end of the band that the basis covers")

    @property
    def compared(self) -> tuple[str, ...]:
        """All variants."""
        return self.variants

    @field_validator("variants")
    @classmethod
    def _variants_are_canonical(cls, value: tuple[str, ...], info: ValidationInfo) -> tuple[str, ...]:
        own = info.data.get("own_files", {})
        names = tuple(
            name if name in own else canonical(name, or_full=False)
            for one in value
            for name in ([one] if one in own else _orders_of(one))
        )
        return each_once(names)

    @model_validator(mode="after")
    def _own_models_have_been_read(self) -> "VariantsSection":
        unread = self.own.keys() - self.own_files.keys()
        if unread:
            raise ValueError(
                "own models belong to the workflows mirror-mor, mirror-exposure and mirror-trace"
            )
        return self

    @model_serializer(mode="wrap")
    def _own_models_are_named_where_there_are_any(
        self, handler: SerializerFunctionWrapHandler
    ) -> dict[str, Any]:
        record: dict[str, Any] = handler(self)
        if not self.own_files:
            record.pop("own_files", None)
        return record


class ReductionSection(VariantsSection):
    """Which variants are compared, and over which frequencies."""

    reference: str = Field(default=FULL, description="what errors refer to: 'full', or a variant")
    first_hz: float = Field(default=5.0, gt=0, description="lower end of the band that is compared")
    frequencies: int = Field(default=600, ge=2, le=20000, description="evenly spread over the band")
    spot_checks: int = Field(
        default=3, ge=0, le=50, description="frequencies at which the sweep's basis is checked in full"
    )

    @property
    def hertz(self) -> NDArray[np.float64]:
        """The frequencies (n,) at which they are compared, Hz."""
        return np.asarray(np.linspace(self.first_hz, self.last_hz, self.frequencies))

    @property
    def compared(self) -> tuple[str, ...]:
        """All variants, the reference first."""
        return (self.reference, *(name for name in self.variants if name != self.reference))

    @field_validator("reference")
    @classmethod
    def _reference_is_canonical(cls, value: str) -> str:
        return canonical(value)

    @model_validator(mode="after")
    def _frequencies_rise(self) -> "ReductionSection":
        if self.first_hz >= self.last_hz:
            raise ValueError(f"first_hz {self.first_hz:g} must be below last_hz {self.last_hz:g}")
        return self


def _orders_of(name: str) -> list[str]:
    """Return the names of a range of orders, ``krylov{36:108:36}(200)``, or the name itself."""
    try:
        return orders_of(name)
    except UserError as error:
        raise ValueError(str(error).rstrip(".")) from None


def canonical(name: str, or_full: bool = True) -> str:
    """Return the canonical name of a reduced model, or "full"; ValueError if it is none."""
    try:
        return name if or_full and name == FULL else str(parse(name))
    except UserError as error:
        raise ValueError(str(error).rstrip(".")) from None


class TimeSection(Section):
    """Instants of the time response."""

    duration_s: float = Field(default=0.02, gt=0, description="from rest to the last instant")
    step_s: float = Field(default=1e-4, gt=0, description="between two instants")

    @property
    def instants(self) -> int:
        """Number of instants, the first at 0."""
        return round(self.duration_s / self.step_s) + 1

    @property
    def seconds(self) -> NDArray[np.float64]:
        """The instants (n,), s."""
        return np.arange(self.instants, dtype=np.float64) * self.step_s

    @model_validator(mode="after")
    def _has_instants(self) -> "TimeSection":
        if not 2 <= self.instants <= 100_000:
            raise ValueError(f"duration_s / step_s makes {self.instants} instants; 2 to 100000 are possible")
        return self


class MirrorOpticsSection(Section):
    """Light on the mirror: a star on the axis, imaged at the focus."""

    wavelength_nm: float = Field(default=550.0, gt=0, le=1e6, description="of the light; default: green")
    rays: int = Field(default=1000, ge=50, le=200_000, description="evenly spread over the mirror")
    zernike_terms: int | None = Field(
        default=None,
        ge=6,
        le=MOST_TERMS,
        description="of surface and wavefront; default 231 circular, 105 annular",
    )
    focal_length_m: float | None = Field(
        default=None, gt=0, description="default: that of the model's parabola"
    )


class TraceOpticsSection(MirrorOpticsSection):
    """Light on the mirror, and when more than the Zernike polynomials of its figure is traced."""

    residual_limit: float = Field(
        default=1e-3,
        ge=0,
        le=1,
        description="share of the deformation that the polynomials may miss; where they miss more, what they "
        "leave is traced with them as a grid (0: always, 1: never)",
    )


class MirrorImagingSection(Section):
    """The exposure over the time response."""

    pixels: int = Field(default=64, ge=8, le=512, multiple_of=2, description="along one side of the image")
    sampling: float = Field(default=0.25, gt=0, le=0.5, description="pixel in lambda/D")
    pupil_samples: int = Field(
        default=96, ge=16, le=1024, description="points of the wavefront along the diameter"
    )
    instants: int = Field(default=101, ge=1, le=100_000, description="at most, evenly spread")
    scale: float = Field(default=1.0, gt=0, description="of the wavefront: exaggerates small vibrations")


class CriterionSection(Section):
    """When a variant is good enough."""

    measure: Literal["wfe", "los", "image"] = Field(
        default="wfe", description="error that decides: of wavefront, line of sight or image"
    )
    largest: float = Field(
        default=0.01,
        gt=0,
        description="wfe: share of the reference's largest value over time; los: lambda/D; image: L2 norm",
    )
    excitations: tuple[str, ...] = Field(
        default=(), strict=False, description="which ones decide; all if left out"
    )


class VariantsCampaignSection(CampaignSection):
    """How much of the study to run, and on which device; not part of its identity."""

    cases: int | None = Field(default=None, ge=1, description="default: all variants")  # type: ignore[assignment]


class MirrorStoreSection(StoreSection):
    """Where the results go, and what of them is kept."""

    chunk_cases: int = Field(default=5, ge=1, le=100_000, description="K: cases per task and per shard")


def _names_are_unique(value: tuple[Any, ...]) -> tuple[Any, ...]:
    require_own_names("excitation", value)
    return value


Excitations = Annotated[
    tuple[AnyExcitation, ...], Field(min_length=1, strict=False), AfterValidator(_names_are_unique)
]


class AnyMirrorStudy(Study):
    """What the studies of mirrors have in common: cases are the variants of each model."""

    model: ModelSection = ModelSection()
    reduction: VariantsSection
    excitation: Excitations
    time: TimeSection = TimeSection()
    optics: MirrorOpticsSection = MirrorOpticsSection()
    campaign: VariantsCampaignSection = VariantsCampaignSection()
    store: MirrorStoreSection = MirrorStoreSection()

    @property
    def models(self) -> tuple[str, ...]:
        """Names of the models: the built-in shapes, or "file"."""
        return ("file",) if self.model.content is not None else self.model.shapes

    @property
    def compared(self) -> tuple[str, ...]:
        """The variants of each model, the reference first where there is one."""
        return self.reduction.compared

    @property
    def cases(self) -> int:
        """All variants of all models, or as many of them as the campaign asks for."""
        every = len(self.models) * len(self.compared)
        return min(self.campaign.cases or every, every)

    @property
    def fewest_instants(self) -> int:
        """Number of instants of each case."""
        return self.time.instants

    @classmethod
    def read_files(cls, record: dict[str, Any], base: Path) -> None:
        """Import the model that the study names, and read the records of its excitations."""
        for entry in record.get("excitation") or ():
            if isinstance(entry, dict) and isinstance(entry.get("file"), str):
                entry["file_csv"] = text_of(base / entry["file"], f"excitation.{entry.get('name')}.file")
        reduction = record.get("reduction")
        if isinstance(reduction, dict) and isinstance(reduction.get("own"), dict):
            reduction["own_files"] = {
                str(name): own_file(base / str(file), f"reduction.own.{name}")
                for name, file in reduction["own"].items()
            }
        model = record.get("model")
        if not isinstance(model, dict) or model.keys() - ModelSection.model_fields.keys():
            return  # a misspelled key is said before what would be wrong without it
        if isinstance(model.get("file"), str):
            keys = {key: value for key, value in model.items() if key in ImportedModel.model_fields}
            model["content"] = keep_imported(keys, base)
            model.pop("shapes", None)


class MirrorStudy(AnyMirrorStudy):
    """A validated study file of ``mirror-mor``; the first variant of each model is the reference."""

    reduction: ReductionSection
    imaging: MirrorImagingSection = MirrorImagingSection()
    criterion: CriterionSection = CriterionSection()

    @model_validator(mode="after")
    def _criterion_names_excitations(self) -> "MirrorStudy":
        names = [entry.name for entry in self.excitation]
        for name in self.criterion.excitations:
            if name not in names:
                raise ValueError(f"criterion.excitations names {name!r}; there are {', '.join(names)}")
        return self

    @property
    def stores_images(self) -> bool:
        """Whether images are computed of a case."""
        return True


class TraceStudy(AnyMirrorStudy):
    """A validated study file of ``mirror-trace``."""

    optics: TraceOpticsSection = TraceOpticsSection()
    time: TimeSection = TimeSection(duration_s=0.0199)
