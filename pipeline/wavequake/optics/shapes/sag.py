"""Sag and slopes of every shape and deformation, point by point. Lengths in mm."""

import numpy as np
from numpy.typing import ArrayLike

from wavequake.errors import UserError
from wavequake.optics.checks import array
from wavequake.optics.shapes.heights import grid_heights, zernike_heights
from wavequake.optics.shapes.shape import SMALLEST_RADIUS, Array, SagAndSlopes, Shape
from wavequake.optics.shapes.shapes import Deformation, ZernikeDeformation


def shape_sag(shape: Shape, x: ArrayLike, y: ArrayLike) -> SagAndSlopes:
    """Return the sag of a shape and its slopes (Störkle 2018, Eq. 3.18-3.23).

    Parameters
    ----------
    shape : Shape
    x, y : array_like
        Lateral position in the surface's frame, mm.

    Returns
    -------
    z, slope_x, slope_y : ndarray
        mm and 1; NaN where the conic does not reach out so far. Beyond its edge a grid goes on with the
        heights of the edge.

    Raises
    ------
    UserError
        If a number of the shape is not finite, or a grid has fewer than 4 rows or columns.
    """
    if not isinstance(shape, Shape):
        raise UserError(f"the shape is {shape!r}; it must be that of a surface, such as Conic(100.0)")
    require_shape(shape)
    x, y = (array(one, "the position") for one in (x, y))
    try:
        x, y = np.broadcast_arrays(x, y)
    except ValueError:
        raise UserError(f"the positions have the shapes {x.shape} and {y.shape}, which do not fit") from None
    return shape.sag(x, y)


def deformation_sag(
    deformation: Deformation, coefficients: Array, x: ArrayLike, y: ArrayLike
) -> SagAndSlopes:
    """Return the height of a deformation at one instant and its slopes (Störkle 2018, Eq. 4.8).

    Parameters
    ----------
    deformation : Deformation
    coefficients : ndarray, shape (terms,) or (rows, columns)
        Noll coefficients (and the heights of their residual grid, by rows) or grid heights, mm.
    x, y : array_like
        mm.

    Raises
    ------
    UserError
        If the coefficients do not fit the deformation.
    """
    x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
    if isinstance(deformation, ZernikeDeformation):
        rest = deformation.residual
        if coefficients.shape != (deformation.size,):
            raise UserError(
                f"a deformation by {deformation.terms} Zernike terms takes {deformation.size} coefficients, "
                f"not {coefficients.shape}"
            )
        figure, left = np.split(coefficients, [deformation.terms])
        smooth = zernike_heights(figure, deformation.pupil_radius, deformation.obscuration, x, y)
        if rest is None:
            return smooth
        rough = grid_heights(left.reshape(rest.rows, rest.columns), rest.dx, rest.dy, x, y)
        return smooth[0] + rough[0], smooth[1] + rough[1], smooth[2] + rough[2]
    if coefficients.shape != (deformation.rows, deformation.columns):
        raise UserError(
            f"a deformation on a grid of {deformation.rows} rows and {deformation.columns} columns has "
            f"heights of the shape {coefficients.shape}"
        )
    return grid_heights(coefficients, deformation.dx, deformation.dy, x, y)


def vertex_curvature(shape: Shape) -> float:
    """Return the mean curvature at the vertex, 1/mm: what a paraxial ray sees.

    Raises
    ------
    UserError
        As `shape_sag`.
    """
    require_shape(shape)
    return 1.0 / shape.radius + shape.added_curvature()


def require_shape(shape: Shape) -> None:
    """Raise UserError unless the numbers of a shape make a surface."""
    what = type(shape).__name__
    if not abs(shape.radius) >= SMALLEST_RADIUS:
        raise UserError(
            f"the radius of a {what} is {shape.radius} mm; its size must be {SMALLEST_RADIUS:g} mm at least "
            "(a plane: infinite)"
        )
    if not np.isfinite(shape.conic):
        raise UserError(f"the conic constant of a {what} is {shape.conic}; it must be a finite number")
    shape.require()
