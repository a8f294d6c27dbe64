"""Shapes of optical surfaces and of their apertures. Lengths in mm."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Conic:
    """A plane (infinite radius), sphere or conic (Störkle 2018, Eq. 3.18); radius > 0: center on +z."""

    radius: float = np.inf
    conic: float = 0.0


@dataclass(frozen=True)
class EvenAsphere:
    """A conic plus C_0 rho^2 + C_1 rho^4 + ... (Störkle 2018, Eq. 3.19)."""

    radius: float
    conic: float
    coefficients: tuple[float, ...]


@dataclass(frozen=True)
class ExtendedPolynomial:
    """A conic plus C_0 x + C_1 y + C_2 x^2 + C_3 x y + ... (Störkle 2018, Eq. 3.22, Table 3.1).

    x and y are divided by ``normalization_radius``, so the coefficients are lengths.
    """

    radius: float
    conic: float
    coefficients: tuple[float, ...]
    normalization_radius: float = 1.0


@dataclass(frozen=True)
class ZernikeSag:
    """A conic plus Noll Zernike polynomials over a pupil, annular where ``obscuration`` > 0.

    ``coefficients`` in mm, from j = 1.
    """

    radius: float
    conic: float
    coefficients: tuple[float, ...]
    pupil_radius: float
    obscuration: float = 0.0


@dataclass(frozen=True)
class GridSag:
    """A conic plus heights (rows, columns) on a regular grid, centered about the vertex; C2-continuous."""

    radius: float
    conic: float
    heights: Array
    dx: float
    dy: float


Shape = Conic | EvenAsphere | ExtendedPolynomial | ZernikeSag | GridSag


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
    """Where a surface lets light through: a circle, an annulus or a simple polygon, less spider arms.

    ``outer`` and ``inner`` are radii (inner 0: none); ``corners`` (counterclockwise) replace the outer
    circle. Each spider arm is a strip: angle (rad) from the x axis and full width. All are about ``center``,
    by default the vertex.
    """

    outer: float = np.inf
    inner: float = 0.0
    corners: tuple[tuple[float, float], ...] = ()
    arms: tuple[tuple[float, float], ...] = ()
    center: tuple[float, float] = (0.0, 0.0)


SurfaceAction = Literal["reflect", "refract", "pass"]
