"""One surface of an optical system as a study file gives it (see `wavequake.optics.systems.file`)."""

import difflib
from collections.abc import Mapping
from dataclasses import replace
from math import isinf
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import (
    Field,
    ModelWrapValidatorHandler,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from wavequake.errors import UserError
from wavequake.optics.media.glasses import AIR, Medium, constant, glass
from wavequake.optics.media.gradients import GradientIndex
from wavequake.optics.sections import MM_PER_NM, FileSection, Pair
from wavequake.optics.shapes.sag_file import read_sag
from wavequake.optics.shapes.shape import shape_of_keys
from wavequake.optics.shapes.shapes import (
    Conic,
    Deformation,
    EvenAsphere,
    ExtendedPolynomial,
    GridSag,
    Opening,
    Shape,
    SurfaceAction,
    ZernikeDeformation,
    ZernikeSag,
)
from wavequake.optics.systems.phase_file import PhaseSection

Degrees = Annotated[float, Field(ge=-360, le=360)]
Heights = Annotated[tuple[float, ...], Field(strict=False)]
_SHAPES = ("even_asphere", "polynomial_mm", "zernike_nm", "sag_mm")


class SurfaceSection(FileSection):
    """One surface of a system, in the order in which light meets them; the last one is the image.

    Shapes that `wavequake.optics.shapes.shape.register` adds have keys of their own beside these.
    """

    name: str = Field(min_length=1, description="by which disturbances, bodies and results speak of it")
    distance_mm: float = Field(default=0.0, description="along the light from the previous surface")
    radius_mm: float | None = Field(
        default=None, description="None or inf is a plane; positive if the center lies on +z"
    )
    conic: float = Field(default=0.0, description="conic constant: 0 a sphere, -1 a paraboloid")
    even_asphere: tuple[float, ...] = Field(
        default=(), strict=False, max_length=16, description="of rho^2, rho^4, ... in mm^-1, mm^-3, ..."
    )
    polynomial_mm: tuple[float, ...] = Field(
        default=(), strict=False, description="of x, y, x^2, x y, y^2, ... over the normalization radius"
    )
    zernike_nm: tuple[float, ...] = Field(
        default=(), strict=False, description="sag by Noll index, from 1, over the normalization radius"
    )
    sag_mm: tuple[Heights, ...] = Field(
        default=(),
        strict=False,
        description="heights on a regular grid about the vertex: rows from the lowest y",
    )
    sag_file: str | None = Field(
        default=None, exclude=True, description="of sag_mm: .csv, .npy or a Zemax grid file .dat"
    )
    sag_spacing_mm: Pair | None = Field(default=None, description="of the grid's columns and rows")
    normalization_radius_mm: float | None = Field(
        default=None, gt=0, description="of polynomials and Zernike terms; default: the semi-diameter"
    )
    zernike_obscuration: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        description="inner over outer radius of annular polynomials; 0: circular ones",
    )
    deformation_terms: int = Field(
        default=0,
        ge=0,
        le=2016,
        description="Noll terms by which the surface may deform from instant to instant",
    )
    glass: str | float | None = Field(
        default=None, description='what follows: "mirror", a glass, "air", an index; None changes nothing'
    )
    gradient_radial: tuple[float, ...] = Field(
        default=(),
        strict=False,
        description="what n^2 of the glass changes by: of r^2, r^4, ... in mm^-2, ...",
    )
    gradient_axial: tuple[float, ...] = Field(
        default=(), strict=False, description="the same along the axis: of z, z^2, ... in mm^-1, mm^-2, ..."
    )
    gradient_step_mm: float | None = Field(
        default=None, gt=0, description="of the rays; default: a hundredth of the gradient's length"
    )
    semi_diameter_mm: float | None = Field(default=None, gt=0, description="light passes within")
    inner_mm: float = Field(default=0.0, ge=0, description="radius of a hole or a central obscuration")
    corners_mm: tuple[Pair, ...] = Field(
        default=(), strict=False, description="of a polygon, counterclockwise; instead of the semi-diameter"
    )
    arms: tuple[Pair, ...] = Field(
        default=(), strict=False, description="spider arms: angle from x in degrees, width in mm"
    )
    dark_mm: tuple[Pair, ...] = Field(
        default=(), strict=False, description="corners of a polygon that stops light, counterclockwise"
    )
    center_mm: Pair = Field(
        default=(0.0, 0.0), strict=False, description="of all of these, beside the vertex"
    )
    tilt_deg: tuple[Degrees, Degrees, Degrees] = Field(
        default=(0.0, 0.0, 0.0), strict=False, description="Cardan angles about x, y and z"
    )
    decenter_mm: tuple[float, float] = Field(
        default=(0.0, 0.0), strict=False, description="shift of the vertex along x and y"
    )
    fold: bool = Field(default=False, description="the axis goes on as this tilted mirror reflects it")
    stop: bool = Field(
        default=False, description="whether it is the aperture stop; one surface of a system is"
    )
    phase: PhaseSection | None = Field(default=None, description="a grating, binary optic or perfect lens")
    _own: tuple[type[Shape], FileSection] | None = PrivateAttr(default=None)  # a registered shape, its keys

    @model_validator(mode="wrap")
    @classmethod
    def _keys_of_registered_shapes(cls, given: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Take the keys of registered shapes apart from those that every surface has."""
        if not isinstance(given, dict):
            return handler(given)
        found = shape_of_keys({key: value for key, value in given.items() if key not in cls.model_fields})
        if found is None or found[0].keys is None:
            return handler(given)
        shape, own = found
        section = handler({key: value for key, value in given.items() if key not in own})
        other = next((key for key in _SHAPES if getattr(section, key)), section.sag_file and "sag_file")
        if other:
            raise ValueError(f"the surface {section.name} has {' and '.join([other, *own])}; choose one")
        section._own = shape, found[0].keys.model_validate(own)
        return section

    @model_serializer(mode="wrap")
    def _with_keys_of_registered_shapes(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        record: dict[str, Any] = handler(self)
        for key in ("phase", "dark_mm"):  # stores of studies go on from before there were any
            if not getattr(self, key):
                record.pop(key, None)
        return record if self._own is None else record | self._own[1].model_dump(mode="json")

    @field_validator("radius_mm", mode="before")
    @classmethod
    def _plane(cls, radius: Any) -> Any:
        """Take an infinite radius as none."""
        return None if isinstance(radius, float) and isinf(radius) else radius

    @field_validator("glass")
    @classmethod
    def _mirror(cls, glass: str | float | None) -> str | float | None:
        """Take a mirror, as a glass, in upper and lower case."""
        return "mirror" if isinstance(glass, str) and glass.lower() == "mirror" else glass

    @model_validator(mode="after")
    def _keys_fit_each_other(self) -> "SurfaceSection":
        shapes = [key for key in _SHAPES if getattr(self, key)]
        if self.sag_file is not None and "sag_mm" not in shapes:
            shapes.append("sag_file")
        if len(shapes) > 1:
            raise ValueError(f"the surface {self.name} has {' and '.join(shapes)}; choose one")
        if self.sag_spacing_mm is not None and not (self.sag_mm or self.sag_file):
            raise ValueError(
                f"the surface {self.name} has sag_spacing_mm but no heights: give sag_file or sag_mm"
            )
        if self.sag_mm and self.sag_spacing_mm is None:
            raise ValueError(
                f"the surface {self.name} needs sag_spacing_mm, the distances of its columns and rows"
            )
        if len({len(row) for row in self.sag_mm}) > 1:
            raise ValueError(f"the rows of sag_mm of {self.name} are not equally long")
        if self.sag_spacing_mm is not None and not min(self.sag_spacing_mm) > 0.0:
            raise ValueError(f"sag_spacing_mm of {self.name} must be positive")
        if (self.gradient_radial or self.gradient_axial) and self.glass in (None, "mirror"):
            raise ValueError(
                f"the surface {self.name} needs the glass, or the index, to which its gradient adds"
            )
        if self.radius_mm == 0.0:
            raise ValueError(f"the surface {self.name} has the radius 0; leave radius_mm out for a plane")
        needs_radius = self.polynomial_mm or self.zernike_nm or self.deformation_terms
        if needs_radius and self.normalization_radius_mm is None and self.semi_diameter_mm is None:
            raise ValueError(
                f"the surface {self.name} needs normalization_radius_mm or semi_diameter_mm for its terms"
            )
        if self.semi_diameter_mm is not None and self.inner_mm >= self.semi_diameter_mm:
            raise ValueError(
                f"the surface {self.name} passes no light: inner_mm must be less than semi_diameter_mm"
            )
        if self.corners_mm and (len(self.corners_mm) < 3 or self.semi_diameter_mm is not None):
            raise ValueError(
                f"the surface {self.name} needs at least 3 corners_mm, and no semi_diameter_mm beside them"
            )
        if self.dark_mm and len(self.dark_mm) < 3:
            raise ValueError(f"the surface {self.name} needs at least 3 corners of dark_mm")
        if not all(width > 0.0 for _, width in self.arms):
            raise ValueError(f"the surface {self.name} has a spider arm without a positive width")
        if self.fold and self.glass != "mirror":
            raise ValueError(f'the surface {self.name} folds the axis, so its glass must be "mirror"')
        if isinstance(self.glass, float) and self.glass <= 0:
            raise ValueError(
                f"the surface {self.name} has the refractive index {self.glass:g}, it must be positive"
            )
        return self


def medium_after(
    section: SurfaceSection, glasses: Mapping[str, Medium]
) -> tuple[SurfaceAction, Medium | GradientIndex]:
    """Return what a surface does and the medium after it; the user's `glasses` go before the catalogue's."""
    action, medium = _glass(section, glasses)
    if not (section.gradient_radial or section.gradient_axial):
        return action, medium
    name = f"{medium.name} with a gradient"
    step = section.gradient_step_mm
    return action, GradientIndex(name, medium, section.gradient_radial, section.gradient_axial, step)


def _glass(section: SurfaceSection, glasses: Mapping[str, Medium]) -> tuple[SurfaceAction, Medium]:
    if section.glass is None:
        return "pass", AIR
    if section.glass == "mirror":
        return "reflect", AIR
    if isinstance(section.glass, float):
        return "refract", constant(section.glass)
    if section.glass.lower() == "air":
        return "refract", AIR
    if section.glass.upper() in glasses:
        return "refract", glasses[section.glass.upper()]
    try:
        return "refract", glass(section.glass)
    except UserError as error:
        near = difflib.get_close_matches(section.glass.lower(), ["mirror", "air"], n=1, cutoff=0.7)
        hint = f' Did you mean "{near[0]}"?' if near else ""
        raise UserError(f"The surface {section.name}: {error}{hint}") from None


def shape_of(section: SurfaceSection) -> Shape:
    """Return the shape of a surface in mm; raises UserError as the shape does."""
    radius = np.inf if section.radius_mm is None else section.radius_mm
    if section._own is not None:
        shape, keys = section._own
        return shape.from_keys(keys, radius, section.conic, _norm(section))
    if section.even_asphere:
        return EvenAsphere(radius, section.conic, section.even_asphere)
    if section.polynomial_mm:
        return ExtendedPolynomial(radius, section.conic, section.polynomial_mm, _norm(section))
    if section.zernike_nm:
        sag = tuple(MM_PER_NM * value for value in section.zernike_nm)
        return ZernikeSag(radius, section.conic, sag, _norm(section), section.zernike_obscuration)
    if section.sag_mm or section.sag_file:
        heights, spacing = _heights(section)
        return GridSag(radius, section.conic, heights, *spacing)
    return Conic(radius, section.conic)


def _heights(section: SurfaceSection) -> tuple[np.ndarray, tuple[float, float]]:
    """Return the heights of a grid and the distances of its nodes, from the file if they are not embedded."""
    if section.sag_mm:
        record: dict[str, Any] = {"sag_mm": section.sag_mm}
    else:
        record = {"name": section.name, "sag_file": section.sag_file}
        embed_sag(record, Path())
    spacing = section.sag_spacing_mm or record.get("sag_spacing_mm")
    if spacing is None:
        raise UserError(f"The surface {section.name} needs sag_spacing_mm, the distances of its nodes.")
    return np.array(record["sag_mm"]), (float(spacing[0]), float(spacing[1]))


def embed_sag(record: dict[str, Any], base: Path) -> None:
    """Add the heights in the sag file that the record of a surface names, relative to `base`.

    Raises
    ------
    UserError
        If the file cannot be read, or neither it nor the record says how far its nodes are apart.
    """
    if not isinstance(record.get("sag_file"), str) or "sag_mm" in record:
        return
    table = read_sag(base / record["sag_file"])
    record["sag_mm"] = table.heights.tolist()
    if table.spacing is not None:
        if "sag_spacing_mm" in record:
            raise UserError(
                f"The surface {record.get('name')}: {record['sag_file']} says how far its nodes are apart; "
                "leave out sag_spacing_mm."
            )
        record["sag_spacing_mm"] = list(table.spacing)


def _norm(section: SurfaceSection) -> float:
    if section.normalization_radius_mm is None and section.semi_diameter_mm is not None:
        return section.semi_diameter_mm + float(np.hypot(*section.center_mm))  # about the vertex
    return section.normalization_radius_mm or np.nan


def deformation_of(section: SurfaceSection) -> Deformation | None:
    """Return how a surface may deform."""
    if section.deformation_terms == 0:
        return None
    return ZernikeDeformation(section.deformation_terms, _norm(section), section.zernike_obscuration)


def opening_of(section: SurfaceSection) -> Opening | None:
    """Return where a surface lets light through; None: everywhere."""
    outer = np.inf if section.semi_diameter_mm is None else section.semi_diameter_mm
    arms = tuple((float(np.deg2rad(angle)), width) for angle, width in section.arms)
    opening = Opening(outer, section.inner_mm, section.corners_mm, arms, dark=section.dark_mm)
    return None if opening == Opening() else replace(opening, center=section.center_mm)
