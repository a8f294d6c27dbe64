"""What a trace through a sequence of surfaces takes and gives. Lengths in mm.

A `Sequence` holds what does not change from instant to instant; poses, deformations and reference spheres
come per instant. Every shape is packed as a conic plus even powers plus a polynomial in x and y plus a grid;
each part may be absent.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Action = Literal["reflect", "refract", "pass"]
Basis = Literal["monomial", "chebyshev"]

OK = 0
VIGNETTED = 1  # hits the surface outside its aperture
MISS = 2  # does not hit the surface
TOTAL_REFLECTION = 3
DIVERGED = 4  # the iteration finds no point of the surface: it folds over


@dataclass(frozen=True)
class Polynomial:
    """A polynomial of total degree `degree` in u = x / radius and v = y / radius, mm.

    ``coefficients[(i + j) (i + j + 1) / 2 + j]`` belongs to u^i v^j, or to T_i(u) T_j(v) in the Chebyshev
    basis, which stays accurate beyond degree 16.
    """

    degree: int
    radius: float
    coefficients: Array
    basis: Basis = "monomial"


@dataclass(frozen=True)
class Grid:
    """A bicubic B-spline on a regular grid, mm; zero slope and constant value continue it beyond its edge.

    ``coefficients[row, column]`` belongs to the node at (x0 + column dx, y0 + row dy).
    """

    x0: float
    y0: float
    dx: float
    dy: float
    coefficients: Array


@dataclass(frozen=True)
class Region:
    """A closed shape in the surface's x and y: where light passes, or where it is blocked.

    ``kind`` is "circle" (numbers: x, y, radius) or "polygon" (numbers: a, b, c of half planes
    a x + b y <= c, one after the other; convex). An aperture is the intersection of its regions and of the
    complements of the blocking ones.
    """

    kind: Literal["circle", "polygon"]
    numbers: tuple[float, ...]
    blocks: bool = False


@dataclass(frozen=True)
class Element:
    """One surface. ``index`` is the refractive index after it; a reflection and a pass keep the former one.

    ``even[k]`` multiplies (x^2 + y^2)^(k + 1). ``deformation_degree``, ``deformation_radius`` and
    ``deformation_basis`` describe the polynomial that is given per instant (-1: none), ``deformation_grid``
    the grid that is given per instant (its own coefficients are ignored). Static and moving parts add up.
    """

    curvature: float = 0.0
    conic: float = 0.0
    action: Action = "pass"
    index: float = 1.0
    even: tuple[float, ...] = ()
    polynomial: Polynomial | None = None
    grid: Grid | None = None
    deformation_degree: int = -1
    deformation_radius: float = 1.0
    deformation_basis: Basis = "monomial"
    deformation_grid: Grid | None = None
    regions: tuple[Region, ...] = ()


@dataclass(frozen=True)
class Sequence:
    """L elements in the order in which light meets them, the last being the image plane.

    ``index`` is the refractive index before the first element.
    """

    elements: tuple[Element, ...]
    index: float = 1.0


@dataclass(frozen=True)
class Rays:
    """N rays before the first element, shared by all instants.

    ``position`` and unit ``direction`` have the shape (3, N), in the frame that the first pose starts from;
    ``path`` (N,) is the optical path length that each ray brings along.
    """

    position: Array
    direction: Array
    path: Array


@dataclass(frozen=True)
class Moving:
    """What changes from instant to instant, T instants.

    Attributes
    ----------
    poses : ndarray, shape (T, L, 12)
        From the frame of the previous element (first: that of the rays) to that of each element: a point p
        becomes A p + o, nine entries of A by rows, then o.
    deformations : tuple of (ndarray of shape (T, terms) or None)
        Polynomial coefficients of each element, in the order of `Polynomial`.
    grids : tuple of (ndarray of shape (T, rows, columns) or None)
        B-spline coefficients of each element's ``deformation_grid``.
    spheres : ndarray, shape (T, 4), or None
        Center (x, y, z) in the image frame and radius of the reference sphere. The ray is followed to the
        sphere on the side from which it comes (radius > 0) or goes to (radius < 0). None: to the image.
    """

    poses: Array
    deformations: tuple[Array | None, ...] = ()
    grids: tuple[Array | None, ...] = ()
    spheres: Array | None = None


@dataclass(frozen=True)
class TracedRays:
    """Rays at the last element in its frame, shape (T, N) each; lost rays are NaN.

    ``path`` is the optical path length to the reference sphere (to the image without one), ``u`` and ``v``
    are x and y of the unit direction, whose z has the sign ``w_sign`` (T, N). ``status`` is 0 or says why a
    ray is lost, ``surface`` at which element (-1: none).
    """

    path: Array
    x: Array
    y: Array
    u: Array
    v: Array
    w_sign: NDArray[np.int8]
    status: NDArray[np.int8]
    surface: NDArray[np.int8]
    vignetted: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """Rays that each element's aperture stops, summed over the instants, shape (L,)."""
