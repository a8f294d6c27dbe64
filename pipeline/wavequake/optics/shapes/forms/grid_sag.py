"""Heights on a grid over a conic, an even asphere, Zernike polynomials."""

from dataclasses import dataclass

from wavequake.optics.shapes.basis import spline_coefficients
from wavequake.optics.shapes.forms.even_asphere import EvenAsphere
from wavequake.optics.shapes.forms.zernike_sag import ZernikeSag
from wavequake.optics.shapes.heights import centered_grid, grid_heights, require_grid
from wavequake.optics.shapes.shape import Array, Packed, SagAndSlopes, Shape, register


@register
@dataclass(frozen=True)
class GridSag(Shape):
    """A conic plus heights (rows, columns) on a regular grid, centered about the vertex; C2-continuous.

    ``even`` are powers of an even asphere below it, ``zernike`` Noll coefficients (mm) over a circle of
    ``pupil_radius``: what Zemax's Grid Sag has, too.
    """

    radius: float
    conic: float
    heights: Array
    dx: float
    dy: float
    even: tuple[float, ...] = ()
    zernike: tuple[float, ...] = ()
    pupil_radius: float = 1.0

    def over_conic(self, x: Array, y: Array) -> SagAndSlopes:
        """Return the heights of an interpolating spline; beyond the grid, those of its edge."""
        grid = grid_heights(self.heights, self.dx, self.dy, x, y)
        z, slope_x, slope_y = (
            sum(parts, start=rough)
            for rough, *parts in zip(grid, *(one.over_conic(x, y) for one in self._below()), strict=True)
        )
        return z, slope_x, slope_y

    def packed(self) -> Packed:
        """Return the spline's coefficients, and those of what is below."""
        rows, columns = self.heights.shape
        grid = centered_grid(rows, columns, self.dx, self.dy, spline_coefficients(self.heights))
        return Packed(even=self.even, polynomial=self._below()[1].packed().polynomial, grid=grid)

    def require(self) -> None:
        """Raise UserError unless the heights are finite and there are enough of them."""
        require_grid(self.heights, self.dx, self.dy)
        for one in self._below():
            one.require()

    def added_curvature(self) -> float:
        """Return it from slopes close to the vertex."""
        return self._by_slopes(1e-3 * min(self.dx, self.dy))

    def _below(self) -> tuple[EvenAsphere, ZernikeSag]:
        return (
            EvenAsphere(self.radius, self.conic, self.even),
            ZernikeSag(self.radius, self.conic, self.zernike, self.pupil_radius),
        )
