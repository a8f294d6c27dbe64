"""Gratings, binary optics and perfect lenses as the surface of a study file gives them."""

from typing import Self

from pydantic import Field, model_validator

from wavequake.optics.sections import FileSection
from wavequake.optics.shapes.phases import Diffraction, Effect, PerfectLens

_TERMS = 240


class PhaseSection(FileSection):
    """What a surface does to light beside its shape: an order of diffraction, or a perfect thin lens."""

    order: float = Field(default=1.0, description="of diffraction")
    lines_per_mm: float = Field(default=0.0, description="grooves of a grating along x, spaced along y")
    radial_rad: tuple[float, ...] = Field(
        default=(), strict=False, max_length=_TERMS, description="phase of rho^2, rho^4, ... over the radius"
    )
    polynomial_rad: tuple[float, ...] = Field(
        default=(), strict=False, max_length=_TERMS, description="phase of x, y, x^2, x y, y^2, ... over it"
    )
    radius_mm: float = Field(default=1.0, gt=0, description="by which phases are normalized")
    focal_length_mm: float | None = Field(default=None, description="of a perfect lens, on a plane")

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        diffracts = self.lines_per_mm or self.radial_rad or self.polynomial_rad
        if bool(diffracts) == (self.focal_length_mm is not None):
            raise ValueError("give lines_per_mm, radial_rad or polynomial_rad, or else focal_length_mm")
        if self.focal_length_mm == 0.0:
            raise ValueError("focal_length_mm must not be 0")
        return self


def effect_of(section: PhaseSection | None) -> Effect | None:
    """Return what the surface does to light."""
    if section is None:
        return None
    if section.focal_length_mm is not None:
        return PerfectLens(section.focal_length_mm)
    terms = (section.radial_rad, section.polynomial_rad)
    return Diffraction(section.order, section.lines_per_mm, *terms, section.radius_mm)
