"""Heights by Zernike polynomials and on grids, of shapes as of deformations, and what makes them sound.

They are evaluated in the form in which they are given (polynomials by their recurrence, grids by an
interpolating spline), so they check what the trace evaluates.
"""

from collections.abc import Sequence

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.trace.sequence import Grid
from wavequake.optics.polynomials.zernike import annular_zernike_gradient

Array = NDArray[np.float64]


def zernike_heights(
    coefficients: Array, radius: float, obscuration: float, x: Array, y: Array
) -> tuple[Array, Array, Array]:
    """Return the sum of Noll Zernike polynomials, j = 1.., over a pupil and its slopes."""
    if coefficients.size == 0:
        return np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    bases = annular_zernike_gradient(x.ravel() / radius, y.ravel() / radius, coefficients.size, obscuration)
    value, slope_x, slope_y = ((basis @ coefficients).reshape(x.shape) for basis in bases)
    return value, slope_x / radius, slope_y / radius


def grid_heights(heights: Array, dx: float, dy: float, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return the bicubic spline through heights (rows, columns) about the origin, and its slopes.

    Beyond its edge a grid goes on with the heights of the edge.

    Raises
    ------
    UserError
        As `require_grid`.
    """
    require_grid(heights, dx, dy)
    rows, columns = heights.shape
    half_x, half_y = dx * (columns - 1) / 2.0, dy * (rows - 1) / 2.0
    nodes_y, nodes_x = np.linspace(-half_y, half_y, rows), np.linspace(-half_x, half_x, columns)
    spline = scipy.interpolate.RectBivariateSpline(nodes_y, nodes_x, heights)
    at_x, at_y = np.clip(x, -half_x, half_x), np.clip(y, -half_y, half_y)
    slope_x = np.where(at_x == x, spline.ev(at_y, at_x, dy=1), 0.0)
    slope_y = np.where(at_y == y, spline.ev(at_y, at_x, dx=1), 0.0)
    return spline.ev(at_y, at_x), slope_x, slope_y


def centered_grid(rows: int, columns: int, dx: float, dy: float, coefficients: Array) -> Grid:
    """Return the grid of spline coefficients, which has one ring more than that of the heights."""
    return Grid(-dx * (columns + 1) / 2.0, -dy * (rows + 1) / 2.0, dx, dy, coefficients)


def require_grid(heights: Array, dx: float, dy: float) -> None:
    """Raise UserError unless heights (..., rows, columns) on a grid make a smooth surface."""
    if heights.ndim < 2 or min(heights.shape[-2:]) < 4:
        raise UserError(f"a grid of heights has the shape {heights.shape}; it needs 4 rows and 4 columns")
    if not np.isfinite(heights).all():
        raise UserError("a grid of heights holds numbers that are not finite; fill its holes first")
    if not (dx > 0.0 and dy > 0.0 and np.isfinite(dx) and np.isfinite(dy)):
        raise UserError(f"the spacings of a grid are {dx} and {dy} mm; they must be positive")


def require_finite(shape: object, coefficients: Sequence[float]) -> None:
    """Raise UserError unless the coefficients of a shape are finite."""
    numbers = np.asarray(coefficients, dtype=np.float64)
    if not np.isfinite(numbers).all():
        bad = int(np.flatnonzero(~np.isfinite(numbers))[0])
        raise UserError(
            f"coefficient {bad} of a {type(shape).__name__} is {numbers[bad]}; it must be a finite number"
        )
