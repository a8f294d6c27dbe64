"""Sections of a study for bodies: what they are made of, what joins them, and reduced models to compare."""

from typing import Annotated, Any, Literal, Self

from pydantic import Field, SerializerFunctionWrapHandler, field_validator, model_serializer, model_validator

from wavequake.campaign.schema import Section
from wavequake.chain.uncertain import UncertainModes
from wavequake.mechanics.importers.checks import Triangle
from wavequake.mechanics.importers.model import PAD_DOFS, PADS, TRIANGLE, ZERO_ROWS, Nodes
from wavequake.mechanics.importers.pads import PadDofs, PadKind
from wavequake.mechanics.nodal.modes import FORMATS as MODE_FILES
from wavequake.workflows.mirrors.compared_models import ComparedSection
from wavequake.workflows.mirrors.study import FULL, canonical

Place = Annotated[float, Field(ge=-1e7, le=1e7)]  # mm: within 10 km
Point = Annotated[tuple[Place, Place, Place], Field(strict=False)]
Vector = Annotated[tuple[float, float, float], Field(strict=False)]
Points = dict[str, Point]
Positive = Annotated[float, Field(gt=0, le=1e15)]
Ratios = Annotated[tuple[float, ...], Field(strict=False)]
Held = str | Annotated[tuple[str, ...], Field(min_length=3, strict=False)]


class SolidSection(Section):
    """Of what a body is made; the defaults are aluminium."""

    youngs_modulus_pa: float = Field(
        default=70e9, gt=0, le=1e16, description="stress over strain, elastic; default: aluminium"
    )
    poisson_ratio: float = Field(
        default=0.33, gt=-1, lt=0.5, description="transverse contraction over extension; default: aluminium"
    )
    density_kg_m3: float = Field(
        default=2700.0, ge=1e-3, le=1e6, description="of the solid material; default: aluminium"
    )


class MirrorBodySection(SolidSection):
    """A built-in elastic mirror behind the first surface of the body, with mounts 1, 2, ... on its rear."""

    shape: Literal["disc", "annulus", "plate"] = Field(
        default="disc",
        description="disc and annulus follow the curvature of the surface; a plate is a flat disc",
    )
    diameter_m: float | None = Field(
        default=None, gt=0, description="default: that of the surface, or of what the beams fill of it"
    )
    inner_diameter_m: float | None = Field(default=None, gt=0, description="of an annulus, required")
    thickness_m: float = Field(gt=0, le=100, description="of the mirror, the same everywhere")
    mount_radius_m: float | None = Field(default=None, gt=0, description="default: 0.645 of the radius")
    mount_angles_deg: tuple[float, ...] = Field(
        default=(0.0, 120.0, 240.0),
        strict=False,
        description="of the mounts, from the x axis of the surface",
    )
    rings: int = Field(default=6, ge=2, le=60, description="elements along the radius; less is coarser")
    figure_terms: int = Field(
        default=28, ge=4, le=231, description="Noll coefficients of the figure that the optics see"
    )
    reduced: str = Field(
        default=FULL, description="model that is taken, e.g. craigb36; full: the intermediate model"
    )

    @field_validator("reduced")
    @classmethod
    def _is_a_model(cls, value: str) -> str:
        return canonical(value)

    @model_validator(mode="after")
    def _an_annulus_has_a_hole(self) -> Self:
        if (self.shape == "annulus") != (self.inner_diameter_m is not None):
            raise ValueError("inner_diameter_m belongs to shape = 'annulus', which needs it")
        return self


class ImportedBodySection(Section):
    """A model from a finite-element program, in the frame of its first surface; nodes are 1, 2, ..."""

    file: str | None = Field(
        default=None,
        exclude=True,
        description="stiffness (.sti, .mtx) or all matrices (.full, .op4, .pch, .npz, .h5)",
    )
    mass: str | None = Field(default=None, exclude=True, description="default: beside file")
    dofs: str | None = Field(default=None, exclude=True, description="default: beside file")
    mesh: str | None = Field(default=None, exclude=True, description="default: beside file")
    units: str | None = Field(default=None, exclude=True, description="e.g. 'm,kg,s,N'")
    interfaces: str | Nodes | None = Field(
        default=None, exclude=True, description="node set or node numbers: what links join"
    )
    surface: str | Nodes | None = Field(
        default=None, exclude=True, description="node set or node numbers of the optical surface"
    )
    triangle: Triangle | None = Field(default=None, exclude=True, description=TRIANGLE)
    zero_rows: Literal["drop"] | None = Field(default=None, exclude=True, description=ZERO_ROWS)
    pads: PadKind | None = Field(default=None, exclude=True, description=PADS)
    pad_dofs: PadDofs = Field(default=3, exclude=True, description=PAD_DOFS)
    damping_alpha: float = Field(default=0.0, ge=0, exclude=True, description="1/s, times the mass")
    damping_beta: float = Field(default=0.0, ge=0, exclude=True, description="s, times the stiffness")
    content: str | None = Field(
        default=None, description="SHA-256 of the imported model; filled in when the study is loaded"
    )
    figure_terms: int = Field(default=28, ge=4, le=231, description="as of a mirror")
    reduced: str = Field(default=FULL, description="as of a mirror")

    @model_validator(mode="after")
    def _is_a_file(self) -> Self:
        if self.content is None:
            raise ValueError("an imported body needs its file")
        return self

    @field_validator("reduced")
    @classmethod
    def _is_a_model(cls, value: str) -> str:
        return canonical(value)


class RigidBodySection(Section):
    """A rigid body: any point of it is a node."""

    mass_kg: float = Field(gt=0, le=1e9, description="of the whole body, surfaces included")
    inertia_kg_m2: Annotated[tuple[Positive, Positive, Positive], Field(strict=False)] = Field(
        description="principal moments about the center of mass, along x, y, z of the body's axes"
    )
    center_mm: Point | None = Field(
        default=None, description="center of mass, x, y, z of the system; default: where the body turns"
    )
    nodes_mm: Points = Field(default={}, description="named points, x, y, z of the system")


class BeamsBodySection(SolidSection):
    """An elastic structure of beams: round tubes that are welded at named nodes."""

    nodes_mm: Points = Field(min_length=2, description="x, y, z of the system")
    members: tuple[Annotated[tuple[str, str], Field(strict=False)], ...] = Field(
        min_length=1, strict=False, description="pairs of nodes"
    )
    diameter_mm: float = Field(gt=0, description="of the tubes")
    wall_mm: float = Field(gt=0, description="of the tubes")
    masses_kg: dict[str, Positive] = Field(default={}, description="at nodes, beside the tubes")
    pieces: int = Field(default=2, ge=1, le=20, description="elements along a member")
    carries: dict[str, Held] = Field(
        default={},
        description="surfaces that move with a node, or as three or more move: { image = 'focus' }",
    )


class ArraysBodySection(Section):
    """What bodies of numbers have in common: a file of arrays."""

    file: str | None = Field(default=None, exclude=True, description="the .npz file")
    file_npz: str = Field(description="that file in base64")
    carries: dict[str, Held] = Field(
        default={}, description="surfaces that move with a node, or as three or more move"
    )


class MatricesBodySection(ArraysBodySection):
    """Own matrices in an .npz file, in the axes of the system.

    mass, stiffness and, if any, damping (n, n); nodes_mm (k, 3); inputs (n, 3 k), whose transpose gives the
    displacements x, y, z of the nodes; perhaps turns (n, 3 k), which gives their rotations, and names (k).
    """


class ModesBodySection(ArraysBodySection):
    """A table of modes in the axes of the system: frequencies, damping and shapes at nodes.

    An .npz file holds frequencies_hz (r), damping_ratios (r, or one number), nodes_mm (k, 3), shapes (r, k, 3
    or 6): displacements and rotations of the nodes for a modal mass of 1 kg; perhaps names (k). In other
    files nodes have their numbers as names. Six modes of 0 Hz make a free body.
    """

    file: str | None = Field(default=None, exclude=True, description=MODE_FILES)
    units: str | None = Field(
        default=None,
        exclude=True,
        description="of .op2, .frd and .rst: length, mass, time, force, e.g. 'mm,t,s,N'",
    )
    mesh: str | None = Field(default=None, exclude=True, description="deck with the nodes of an .op2")
    nodes: tuple[int, ...] = Field(
        default=(), strict=False, exclude=True, description="numbers of those to keep; default: all"
    )
    damping_ratios: float | Ratios | None = Field(
        default=None, exclude=True, description="of all modes, or of each; default: that of the file, or 0"
    )
    modal_masses: float | Ratios = Field(
        default=1.0, exclude=True, description="of the shapes, in the unit of mass; one, or one of each"
    )
    figure_terms: int = Field(
        default=0,
        ge=0,
        le=231,
        description="Noll coefficients that are fitted to the nodes on the first surface, which moves with "
        "them; 0: surfaces move by carries alone",
    )
    off_mm: float = Field(default=0.01, gt=0, description="how far nodes on that surface may lie from it")


NO_MASS = (
    "bodies with mass, but there are none; give a [[body]] a mirror, imported, rigid, beams, matrices or "
    "modes"
)
_KINDS = ("mirror", "imported", "rigid", "beams", "matrices", "modes")


class BodySection(Section):
    """A body: surfaces that move as one, such as the two faces of a lens, or what is elastic or has mass."""

    name: str = Field(min_length=1, description="by which disturbances and links address it")
    surfaces: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description="names, of segmented telescopes patterns, too (M1: all segments); "
        "the first one's axes at rest are those of the body, and it has the body's figure",
    )
    about_mm: Point | None = Field(
        default=None,
        description="where it turns, x, y, z of the system; default: the middle between its first and last "
        "vertex",
    )
    mirror: MirrorBodySection | None = None
    imported: ImportedBodySection | None = None
    rigid: RigidBodySection | None = None
    beams: BeamsBodySection | None = None
    matrices: MatricesBodySection | None = None
    modes: ModesBodySection | None = None

    @property
    def kind(self) -> str | None:
        """What it is made of; None where disturbances alone move it."""
        return next((kind for kind in _KINDS if getattr(self, kind) is not None), None)

    @property
    def carries(self) -> dict[str, Held]:
        """Surfaces that move with a node of it."""
        return dict(getattr(getattr(self, self.kind or "name"), "carries", {}))

    @model_serializer(mode="wrap")
    def _without_what_it_is_not(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        record: dict[str, Any] = write(self)
        return {key: value for key, value in record.items() if key not in _KINDS or value is not None}

    @model_validator(mode="after")
    def _is_one_thing(self) -> Self:
        given = [kind for kind in _KINDS if getattr(self, kind) is not None]
        if len(given) > 1:
            raise ValueError(f"{self.name!r} is {given[0]} and {given[1]}; a body is one of them")
        if not given and not self.surfaces:
            raise ValueError(
                f"{self.name!r} has neither surfaces nor one of {', '.join(_KINDS)}; say what it is"
            )
        if self.mirror and not self.surfaces:
            raise ValueError(f"the mirror {self.name!r} stands behind no surface; name it in surfaces")
        if self.name == "ground" or ("." in self.name and given):
            raise ValueError(f"a body cannot be called {self.name!r}; links call the floor 'ground'")
        return self


class LinkSection(Section):
    """What joins nodes of bodies: springs, legs or rigid connections."""

    name: str = Field(min_length=1, description="of the link in messages and overrides")
    kind: Literal["springs", "legs", "rigid"] = Field(
        description="springs and dampers along x, y, z of the system between nodes at one place; legs that "
        "push and pull along the line between nodes, as those of a hexapod; rigid: nodes at one place move "
        "as one, and turn as one where they can"
    )
    joins: tuple[Annotated[tuple[str, str], Field(strict=False)], ...] = Field(
        min_length=1,
        strict=False,
        description="pairs such as ['M1.1', 'tube.a']: body.node; a rigid body or 'ground' alone is joined "
        "where the other end is",
    )
    stiffness_n_m: float | Vector | None = Field(
        default=None, description="of each spring (x, y, z) or leg, required; a rigid connection has none"
    )
    damping_n_s_m: float | Vector = Field(default=0.0, description="of the damper beside it")

    @model_validator(mode="after")
    def _has_stiffness_or_not(self) -> Self:
        if (self.kind == "rigid") != (self.stiffness_n_m is None):
            what = "takes no" if self.kind == "rigid" else "needs its"
            raise ValueError(f"{self.name!r}, of kind {self.kind}, {what} stiffness_n_m")
        if self.kind == "legs" and isinstance(self.stiffness_n_m, tuple):
            raise ValueError(f"the legs {self.name!r} have one stiffness_n_m each, along their line")
        return self


class UncertainSection(UncertainModes):
    """What is not known of the modes of the structure: every model that is drawn has others."""

    shapes: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="angle in rad by which shapes of neighboring frequencies turn into each other",
    )


class MeasuredModeSection(Section):
    """A mode whose frequency and damping were measured."""

    number: int = Field(ge=1, description="of the mode, by frequency, from 1")
    frequency_hz: float = Field(gt=0, description="measured, in place of the model's")
    damping_ratio: float = Field(
        gt=0, lt=1, description="measured share of critical damping, in place of the model's"
    )
    frequency_error: float = Field(
        default=0.0,
        ge=0,
        le=0.5,
        description="of its logarithm; drawn with [structure.uncertain]",
    )
    damping_error: float = Field(default=0.0, ge=0, le=2, description="the same of the damping ratio")


class StructureSection(Section):
    """What all bodies of mass have in common."""

    ground_mm: Points = Field(default={}, description="named points of the ground, x, y, z of the system")
    damping_ratio: float = Field(
        default=0.01,
        ge=0,
        lt=1,
        description="of every mode of what is joined, beside that of bodies and links",
    )
    last_hz: float = Field(
        default=1200.0, gt=0, description="up to which frequency full models of mirrors are accurate"
    )
    uncertain: UncertainSection | None = None
    mode: tuple[MeasuredModeSection, ...] = Field(default=(), strict=False)

    @model_serializer(mode="wrap")
    def _without_what_is_not_given(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        record: dict[str, Any] = write(self)
        return {key: one for key, one in record.items() if key not in ("uncertain", "mode") or one}

    @field_validator("mode")
    @classmethod
    def _modes_are_named_once(cls, value: tuple[MeasuredModeSection, ...]) -> tuple[MeasuredModeSection, ...]:
        numbers = [one.number for one in value]
        twice = next((number for number in numbers if numbers.count(number) > 1), None)
        if twice is not None:
            raise ValueError(f"mode {twice} is given twice")
        return value


class ComparedModelsSection(ComparedSection):
    """Reduced models of elastic bodies that are compared: every draw is a case with each of them."""

    of: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description="bodies that are reduced; default: all mirrors and imported ones",
    )
