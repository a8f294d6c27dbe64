"""Shapes of optical surfaces, how they deform, and their apertures. Lengths in mm."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from wavequake.optics.shapes.forms.conic import Conic
from wavequake.optics.shapes.forms.even_asphere import EvenAsphere
from wavequake.optics.shapes.forms.extended_polynomial import ExtendedPolynomial
from wavequake.optics.shapes.forms.grid_sag import GridSag
from wavequake.optics.shapes.forms.zernike_sag import ZernikeSag
from wavequake.optics.shapes.shape import Shape

__all__ = [
    "Conic",
    "Deformation",
    "EvenAsphere",
    "ExtendedPolynomial",
    "GridDeformation",
    "GridSag",
    "Opening",
    "Shape",
    "SurfaceAction",
    "ZernikeDeformation",
    "ZernikeSag",
]


@dataclass(frozen=True)
class GridDeformation:
    """The grid on which a surface may deform from instant to instant (heights along z, mm)."""

    rows: int
    columns: int
    dx: float
    dy: float


@dataclass(frozen=True)
class ZernikeDeformation:
    """Which Noll Zernike polynomials may deform a surface from instant to instant (heights along z, mm).

    Where there is a ``residual`` grid, too, its heights by rows follow the coefficients: what a fit by the
    polynomials left, so that nothing is lost.
    """

    terms: int
    pupil_radius: float
    obscuration: float = 0.0
    residual: GridDeformation | None = None

    @property
    def size(self) -> int:
        """How many numbers deform the surface at one instant."""
        return self.terms + (self.residual.rows * self.residual.columns if self.residual else 0)


Deformation = ZernikeDeformation | GridDeformation


@dataclass(frozen=True)
class Opening:
    """Where a surface lets light through: a circle, an annulus or a simple polygon, less what stands in it.

    ``outer`` and ``inner`` are radii (inner 0: none); ``corners`` (counterclockwise) replace the outer
    circle. Each spider arm is a strip: angle (rad) from the x axis and full width. ``dark`` are the corners
    (counterclockwise) of a simple polygon that stops light. All are about ``center``, by default the vertex.
    """

    outer: float = np.inf
    inner: float = 0.0
    corners: tuple[tuple[float, float], ...] = ()
    arms: tuple[tuple[float, float], ...] = ()
    center: tuple[float, float] = (0.0, 0.0)
    dark: tuple[tuple[float, float], ...] = ()


SurfaceAction = Literal["reflect", "refract", "pass"]
