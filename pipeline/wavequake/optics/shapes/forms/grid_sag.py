"""Heights on a grid over a conic."""

from dataclasses import dataclass

from wavequake.optics.shapes.basis import spline_coefficients
from wavequake.optics.shapes.heights import centered_grid, grid_heights, require_grid
from wavequake.optics.shapes.shape import Array, Packed, SagAndSlopes, Shape, register


@register
@dataclass(frozen=True)
class GridSag(Shape):
    """A conic plus heights (rows, columns) on a regular grid, centered about the vertex; C2-continuous."""

    radius: float
    conic: float
    heights: Array
    dx: float
    dy: float

    def over_conic(self, x: Array, y: Array) -> SagAndSlopes:
        """Return the heights of an interpolating spline; beyond the grid, those of its edge."""
        return grid_heights(self.heights, self.dx, self.dy, x, y)

    def packed(self) -> Packed:
        """Return the spline's coefficients."""
        rows, columns = self.heights.shape
        return Packed(grid=centered_grid(rows, columns, self.dx, self.dy, spline_coefficients(self.heights)))

    def require(self) -> None:
        """Raise UserError unless the heights are finite and there are enough of them."""
        require_grid(self.heights, self.dx, self.dy)

    def added_curvature(self) -> float:
        """Return it from slopes close to the vertex."""
        return self._by_slopes(1e-3 * min(self.dx, self.dy))
