"""Bicubic B-splines on a regular grid and their slopes, in NumPy."""

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.trace.sequence import Grid

Array = NDArray[np.float64]


def spline_grid(grid: Grid, coefficients: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return a bicubic B-spline and its slopes.

    Parameters
    ----------
    grid : Grid
        Where the nodes are; its own coefficients are ignored.
    coefficients : ndarray, shape (rows, columns) or (T, rows, columns)
        In mm; at least 4 rows and columns. Beyond the pieces that four nodes support in each direction,
        which end at the last nodes but one, the value is continued with zero slope.
    x, y : ndarray
        Position in mm; for coefficients per instant their first axis is the instant.

    Returns
    -------
    tuple of ndarray
        Height in mm and its derivatives along x and y.
    """
    rows, columns = coefficients.shape[-2:]
    column, weights_x, slopes_x = _weights((x - grid.x0) / grid.dx, columns)
    row, weights_y, slopes_y = _weights((y - grid.y0) / grid.dy, rows)
    instant = np.arange(len(coefficients)).reshape(-1, *(1,) * (x.ndim - 1))
    nodes = coefficients if coefficients.ndim == 3 else coefficients[None]
    instant = instant if coefficients.ndim == 3 else np.zeros((1,) * x.ndim, dtype=np.intp)
    value, slope_x, slope_y = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    for j in range(4):
        along, sloping = np.zeros_like(x), np.zeros_like(x)
        for i in range(4):
            node = nodes[instant, row + j, column + i]
            along = along + node * weights_x[i]
            sloping = sloping + node * slopes_x[i]
        value = value + weights_y[j] * along
        slope_x = slope_x + weights_y[j] * sloping
        slope_y = slope_y + slopes_y[j] * along
    return value, slope_x / grid.dx, slope_y / grid.dy


def _weights(place: Array, nodes: int) -> tuple[NDArray[np.intp], list[Array], list[Array]]:
    """Return the first of four nodes about `place` (in node spacings), their weights and slopes."""
    within = np.clip(place, 1.0, nodes - 2.0)
    # A lost ray may ask for any piece: its weights are NaN.
    first = np.where(np.isfinite(place), np.minimum(np.floor(within), nodes - 3.0), 1.0)
    t = within - first
    s = 1.0 - t
    weights = [
        s * s * s / 6.0,
        (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0,
        (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0,
        t * t * t / 6.0,
    ]
    inside = np.where(within == place, 1.0, 0.0)
    slopes = [-0.5 * s * s, (1.5 * t - 2.0) * t, (2.0 - 1.5 * s) * s, 0.5 * t * t]
    return first.astype(np.intp) - 1, weights, [inside * slope for slope in slopes]
