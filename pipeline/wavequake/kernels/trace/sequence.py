"""What a trace through a sequence of surfaces takes and gives. Lengths in mm.

A `Sequence` holds what does not change from instant to instant; poses, deformations and reference spheres
come per instant. Every shape is packed as a conic plus even powers plus a polynomial in x and y plus a grid
plus a form; each part may be absent.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.trace.status import VIGNETTED

Array = NDArray[np.float64]
MOST_SURFACES = 126  # their numbers are bytes
Action = Literal["reflect", "refract", "pass"]


@dataclass(frozen=True)
class Ring:
    """The basis of Zernike polynomials of unit rms over the ring of radii `inner` (0: the circle) to 1."""

    inner: float = 0.0


Basis = Literal["monomial"] | Ring


@dataclass(frozen=True)
class Polynomial:
    """A polynomial of total degree `degree` in u = x / radius and v = y / radius, mm.

    ``coefficients[(i + j) (i + j + 1) / 2 + j]`` belongs to u^i v^j. On a ring coefficients have the order of
    `wavequake.kernels.trace.ring.ring_order`: these sums keep 13 digits at any degree, those of monomials 10
    at degree 20 and 7 at degree 30.
    """

    degree: int
    radius: float
    coefficients: Array
    basis: Basis = "monomial"


@dataclass(frozen=True)
class Grid:
    """A bicubic B-spline on a regular grid, mm.

    ``coefficients[row, column]`` belongs to the node at (x0 + column dx, y0 + row dy). The spline ends at the
    last nodes but one, where it still has four nodes about it; a constant value continues it beyond.
    """

    x0: float
    y0: float
    dx: float
    dy: float
    coefficients: Array


@dataclass(frozen=True)
class Form:
    """A height in closed form: what a function of ``kernels/forms.h``, or its twin in NumPy, takes.

    ``near`` is None for a height over the conic of the element. Else the form is all of the surface, and the
    search for where a ray meets it starts on a paraboloid of this curvature, 1/mm.
    """

    name: Literal["radial", "biconic", "toroid", "qbfs", "qcon"]
    numbers: tuple[float, ...]
    near: float | None = None


@dataclass(frozen=True)
class Phase:
    """A path that a surface adds to light, mm, as a function of x and y: gratings and binary optics.

    ``even`` and ``polynomial`` (of monomials) as those of `Element`. Light bends by the path's slopes.
    """

    even: tuple[float, ...] = ()
    polynomial: Polynomial | None = None


@dataclass(frozen=True)
class Focus:
    """A perfect thin lens in a plane: n' times the slope behind is n times that before, less power times x.

    ``vergence`` is the reciprocal distance of the object plane before the lens, which it images with equal
    paths; negative for a virtual one, 0 at infinity. Both in 1/mm.
    """

    power: float
    vergence: float = 0.0


@dataclass(frozen=True)
class Region:
    """A closed shape in the surface's x and y: where light passes, or where it is blocked.

    ``kind`` is "circle" (numbers: x, y, radius), "polygon" (numbers: a, b, c of half planes
    a x + b y <= c, one after the other; convex) or "outline" (a, b, c, lowest and highest y of each edge of
    any simple polygon). An aperture is the intersection of its regions and of the complements of the
    blocking ones.
    """

    kind: Literal["circle", "polygon", "outline"]
    numbers: tuple[float, ...]
    blocks: bool = False


@dataclass(frozen=True)
class Gradient:
    """How n^2 changes in a medium, in the frame of the element that begins it.

    ``radial[k]`` multiplies (x^2 + y^2)^(k + 1), ``axial[k]`` multiplies z^(k + 1), both in powers of 1/mm;
    they add to the square of the element's index. Rays take steps of ``step`` mm at the index where they
    enter.
    """

    radial: tuple[float, ...]
    axial: tuple[float, ...]
    step: float


@dataclass(frozen=True)
class Element:
    """One surface. ``index`` is the refractive index after it; a reflection and a pass keep the former one.

    Where a refraction begins a medium with a ``gradient``, ``index`` is that at the element's origin.

    ``even[k]`` multiplies (x^2 + y^2)^(k + 1). ``deformation_degree``, ``deformation_radius`` and
    ``deformation_basis`` describe the polynomial that is given per instant (-1: none), ``deformation_grid``
    the grid that is given per instant (its own coefficients are ignored). Static and moving parts add up.
    A ``phase`` acts whatever the action is. Light that may meet the element twice meets it where it crosses
    it towards +z (``sense`` 1) or -z (-1); 0: in the sense in which it crosses the vertex plane.
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
    gradient: Gradient | None = None
    form: Form | None = None
    phase: Phase | Focus | None = None
    sense: Literal[-1, 0, 1] = 0


@dataclass(frozen=True, eq=False)
class Sequence:
    """L elements in the order in which light meets them, the last being the image plane.

    It equals only itself. ``index`` is the refractive index before the first element. Batches in which an
    element does not turn are traced by a shorter program than others, unless one for both is ``turning``:
    that is a sixth slower for them, and takes seconds less to compile.
    """

    elements: tuple[Element, ...]
    index: float = 1.0
    turning: bool = False


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
    ray is lost (`wavequake.kernels.trace.status`), ``surface`` at which element (-1: none; L: it misses the
    reference sphere). A device with
    memory of its own keeps what it traced until NumPy asks for it, see `wavequake.kernels.device.resident`.
    """

    path: Array
    x: Array
    y: Array
    u: Array
    v: Array
    w_sign: NDArray[np.int8]
    status: NDArray[np.int8]
    surface: NDArray[np.int8]
    elements: int = 0

    @property
    def vignetted(self) -> NDArray[np.int64]:
        """Rays that the aperture of each of ``elements`` stops, summed over the instants, shape (L,)."""
        stopped = self.surface[self.status == VIGNETTED]
        return np.bincount(stopped, minlength=self.elements).astype(np.int64)


def check_sequence(sequence: Sequence, rays: Rays, moving: Moving) -> None:
    """Check that sequence, rays and moving parts fit together and that the surfaces are finite.

    Raises
    ------
    UserError
        If there are more than 126 surfaces, one has coefficients that are not finite, or an index that is
        not positive.
    ValueError
        If shapes do not fit together.
    """
    elements, instants = sequence.elements, len(moving.poses)
    if not elements:
        raise ValueError("the sequence has no elements; the last one is the image plane")
    if len(elements) > MOST_SURFACES:
        raise UserError(f"The system has {len(elements)} surfaces; at most {MOST_SURFACES} can be traced.")
    _require("rays.path", rays.path, (rays.path.size,))
    _require("rays.position", rays.position, (3, rays.path.size))
    _require("rays.direction", rays.direction, (3, rays.path.size))
    _require("moving.poses", moving.poses, (instants, len(elements), 12))
    if moving.spheres is not None:
        _require("moving.spheres", moving.spheres, (instants, 4))
    for name, arrays in (("deformations", moving.deformations), ("grids", moving.grids)):
        if len(arrays) not in (0, len(elements)):
            raise ValueError(f"moving.{name} has {len(arrays)} entries for {len(elements)} elements")
    check_surfaces(sequence)
    for number, element in enumerate(elements):
        _check_moving(number, element, moving, instants)


def check_surfaces(sequence: Sequence) -> None:
    """Check what does not move; raises as `check_sequence`."""
    for number, element in enumerate(sequence.elements):
        fixed, grid = element.polynomial, element.grid
        _require_finite(number, "curvature", element.curvature)
        _require_finite(number, "conic constant", element.conic)
        if element.even:
            _require_finite(number, "even power coefficients", element.even)
        if element.form is not None:
            _require_finite(number, "numbers of its form", (*element.form.numbers, element.form.near or 0.0))
        if element.phase is not None:
            _require_phase(number, sequence)
        if not (math.isfinite(element.index) and element.index > 0.0):
            raise UserError(f"surface {number}: the refractive index is {element.index}; it must be positive")
        if element.gradient is not None:
            _require_finite(number, "gradient", element.gradient.radial + element.gradient.axial)
            if not (np.isfinite(element.gradient.step) and element.gradient.step > 0.0):
                raise UserError(
                    f"surface {number}: the step through its gradient is {element.gradient.step} mm; it must "
                    "be positive"
                )
        if fixed is not None:
            _require(f"polynomial of element {number}", fixed.coefficients, (terms(fixed.degree),))
            _require_finite(number, "polynomial coefficients", fixed.coefficients)
        if grid is not None:
            _require_finite(number, "grid heights", grid.coefficients)
            if grid.coefficients.ndim != 2 or min(grid.coefficients.shape) < 4:
                raise ValueError(f"the grid of element {number} must have at least 4 rows and columns")


def _require_phase(number: int, sequence: Sequence) -> None:
    element = sequence.elements[number]
    media = [one.gradient for one in sequence.elements[: number + 1] if one.action == "refract"]
    if media and any(media[-2 if element.action == "refract" else -1 :]):
        raise UserError(f"surface {number}: it diffracts where the index varies, which cannot be traced")
    phase = element.phase
    if isinstance(phase, Focus):
        _require_finite(number, "power", (phase.power, phase.vergence))
        if element.action == "reflect":
            raise UserError(f"surface {number}: a perfect lens cannot be a mirror")
    elif phase is not None:
        _require_finite(number, "phase", phase.even)
        if phase.polynomial is not None:
            _require_finite(number, "phase", phase.polynomial.coefficients)


def bends(sequence: Sequence) -> bool:
    """Return whether rays bend between surfaces, where the index varies."""
    return any(element.gradient is not None for element in sequence.elements)


def terms(degree: int) -> int:
    """Return the number of terms of a polynomial of total degree up to `degree` in two variables."""
    return (degree + 1) * (degree + 2) // 2


def _check_moving(number: int, element: Element, moving: Moving, instants: int) -> None:
    deformation = moving.deformations[number] if moving.deformations else None
    grid = moving.grids[number] if moving.grids else None
    if (deformation is None) != (element.deformation_degree < 0):
        wanted = "None" if element.deformation_degree < 0 else "given"
        raise ValueError(
            f"the deformation of element {number} must be {wanted}, as its deformation_degree is"
        )
    if (grid is None) != (element.deformation_grid is None):
        wanted = "None" if element.deformation_grid is None else "given"
        raise ValueError(f"the grid of element {number} must be {wanted}, as its deformation_grid is")
    if deformation is not None:
        _require(f"deformation {number}", deformation, (instants, terms(element.deformation_degree)))
        _require_finite(number, "deformation", deformation)
    if grid is not None:
        _require(f"grid {number}", grid, (instants, *grid.shape[1:]))
        _require_finite(number, "grid deformation", grid)
        if grid.ndim != 3 or min(grid.shape[1:]) < 4:
            raise ValueError(f"the grid of element {number} must have at least 4 rows and columns")


def _require_finite(number: int, what: str, values: float | tuple[float, ...] | Array) -> None:
    finite = math.isfinite(values) if isinstance(values, float) else np.isfinite(values).all()
    if not finite:
        raise UserError(f"surface {number}: {what} must be finite, and a value is not")


def _require(name: str, array: NDArray[np.float64], shape: tuple[int, ...]) -> None:
    if array.shape != shape or array.dtype != np.float64:
        raise ValueError(f"{name} is {array.dtype} {array.shape}; it must be float64 {shape}")
