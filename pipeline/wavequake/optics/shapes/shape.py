"""What every shape of an optical surface offers, and the registry of shapes. Lengths in mm.

A shape is a frozen dataclass in a file of its own: a conic, whose ``radius`` and ``conic`` every shape has,
and heights over it, or a surface that is none. The file says all that the package asks: heights and slopes,
what the trace takes, the keys of a study file, the surface type of a lens file. `register` makes it known to
study and lens files.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Form, Grid, Polynomial
from wavequake.kernels.trace.surfaces import conic_sag, conic_slopes
from wavequake.optics.sections import FileSection
from wavequake.registry import Registry

if TYPE_CHECKING:
    from wavequake.optics.zemax.rows import Row

Array = NDArray[np.float64]
SagAndSlopes = tuple[Array, Array, Array]

SMALLEST_RADIUS = 1e-9  # mm; a far smaller one overflows


@dataclass(frozen=True)
class Packed:
    """What the trace adds to a conic: even powers, a polynomial in x and y, a grid, a form.

    Each may be absent; a form may also be all of the surface. As of
    `wavequake.kernels.trace.sequence.Element`: ``even[k]`` multiplies (x^2 + y^2)^(k + 1).
    """

    even: tuple[float, ...] = ()
    polynomial: Polynomial | None = None
    grid: Grid | None = None
    form: Form | None = None


class Shape:
    """A conic (its radius infinite: a plane; positive: center on +z), and heights over it.

    Only what differs from a bare conic need be said. Pickled shapes reach workers.

    Attributes
    ----------
    radius, conic : float
        Fields of every shape.
    keys : type of FileSection, or None
        The keys that a study file gives a surface of this shape, beside ``radius_mm`` and ``conic``.
    zemax : str
        The surface type of .zmx files; empty: they have none.
    """

    radius: float
    conic: float
    keys: ClassVar[type[FileSection] | None] = None
    zemax: ClassVar[str] = ""

    def sag(self, x: Array, y: Array) -> SagAndSlopes:
        """Return the height at x and y, mm, and its slopes; NaN where the surface does not reach."""
        curvature = 1.0 / self.radius
        slope_x, slope_y = conic_slopes(x, y, curvature, self.conic)
        over, over_x, over_y = self.over_conic(x, y)
        return conic_sag(x, y, curvature, self.conic) + over, slope_x + over_x, slope_y + over_y

    def over_conic(self, x: Array, y: Array) -> SagAndSlopes:
        """Return the heights over the conic at x and y of one shape, mm, and their slopes along x and y."""
        return np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)

    def packed(self) -> Packed:
        """Return the heights over the conic as the trace evaluates them."""
        return Packed()

    def require(self) -> None:
        """Raise UserError unless the numbers beside radius and conic constant make a surface."""

    def added_curvature(self) -> float:
        """Return the mean curvature of the heights at the vertex, 1/mm, which paraxial rays see."""
        packed = self.packed()
        steps = [1e-4 * packed.polynomial.radius] if packed.polynomial else []
        steps += [1e-3 * min(packed.grid.dx, packed.grid.dy)] if packed.grid else []
        return self._by_slopes(min(steps)) if steps else 2.0 * sum(packed.even[:1])

    def _by_slopes(self, step: float) -> float:
        """Return `added_curvature` by differences of slopes."""
        ends = np.array([step, -step])
        with np.errstate(over="ignore", invalid="ignore"):  # infinite curvatures are told where they matter
            _, along_x, _ = self.over_conic(ends, np.zeros(2))
            _, _, along_y = self.over_conic(np.zeros(2), ends)
            return float(along_x[0] - along_x[1] + along_y[0] - along_y[1]) / (4.0 * step)

    def words(self) -> str:
        """Return what `info` calls the shape; nothing for a conic."""
        return type(self).__name__

    @classmethod
    def from_keys(cls, keys: Any, radius: float, conic: float, norm: float) -> Self:
        """Return the shape that the keys of a study file, an instance of ``keys``, describe.

        ``norm`` is the normalization radius or the semi-diameter, NaN without either.
        """
        raise NotImplementedError

    @classmethod
    def from_zemax(cls, row: "Row", scale: float, radius: float, conic: float) -> Self:
        """Return the shape of a row of a lens file, whose unit is `scale` mm."""
        raise NotImplementedError

    def zemax_lines(self, where: str) -> list[str]:
        """Return the lines of a lens file beside TYPE, CURV and CONI; `where` names the surface."""
        raise NotImplementedError


Kind = TypeVar("Kind", bound=Shape)
SHAPES: Registry[type[Shape]] = Registry(
    "shape", "wavequake.optics.shapes.forms", "wavequake.shapes", lambda shape: shape.__name__
)


def register(shape: type[Kind]) -> type[Kind]:
    """Make a shape known to study files and lens files; a decorator of its class.

    Raises
    ------
    UserError
        If another shape has its name, one of its keys or its surface type, or it has keys or a surface type
        and does not say what they mean.
    """
    for name, other in SHAPES.known().items():
        if name == shape.__name__:
            continue
        common = [key for key in keys_of(shape) if key in keys_of(other)]
        if common or (shape.zemax and shape.zemax == other.zemax):
            what = f"key {common[0]!r}" if common else f"surface type {shape.zemax!r}"
            raise UserError(f"the shapes {name} and {shape.__name__} have the same {what}")
    needed = ["from_keys"] * (shape.keys is not None) + ["from_zemax", "zemax_lines"] * bool(shape.zemax)
    own = shape.__mro__[: shape.__mro__.index(Shape)]
    if unwritten := [name for name in needed if not any(name in vars(one) for one in own)]:
        missing = " and no ".join(unwritten)
        raise UserError(f"the shape {shape.__name__} has no {missing} of its own; write what Shape describes")
    SHAPES.add(shape)
    return shape


def keys_of(shape: type[Shape]) -> tuple[str, ...]:
    """Return the keys of a study file by which a shape is told."""
    return tuple(shape.keys.model_fields) if shape.keys is not None else ()


def shape_of_keys(given: Mapping[str, Any]) -> tuple[type[Shape], dict[str, Any]] | None:
    """Return the registered shape to which keys of a surface belong, and these; None if there is none.

    Raises
    ------
    ValueError
        If they belong to several shapes.
    """
    found = {
        name: own
        for name, shape in SHAPES.entries().items()
        if (own := {key: given[key] for key in keys_of(shape) if key in given})
    }
    if len(found) > 1:
        (one, first), (other, second), *_ = found.items()
        raise ValueError(f"{next(iter(first))} makes it a {one}, {next(iter(second))} a {other}; choose one")
    return next(((SHAPES.entries()[name], own) for name, own in found.items()), None)


def shape_of_type(zemax: str) -> type[Shape] | None:
    """Return the registered shape of a surface type of lens files."""
    return next((shape for shape in SHAPES.entries().values() if zemax and shape.zemax == zemax), None)


def zemax_types() -> tuple[str, ...]:
    """Return the surface types of lens files that registered shapes have."""
    return tuple(shape.zemax for shape in SHAPES.entries().values() if shape.zemax)
