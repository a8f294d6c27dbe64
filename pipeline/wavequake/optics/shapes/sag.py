"""Sag and slopes of every shape and deformation, point by point. Lengths in mm.

They are evaluated in the form in which a shape is given (Zernike polynomials by their recurrence, grids by an
interpolating spline), so they check what `packing` makes of shapes for the trace.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RectBivariateSpline

from wavequake.errors import UserError
from wavequake.kernels.trace.surfaces import conic_sag, conic_slopes
from wavequake.optics.checks import array
from wavequake.optics.polynomials.zernike import annular_zernike_gradient
from wavequake.optics.shapes.shapes import (
    Conic,
    Deformation,
    EvenAsphere,
    ExtendedPolynomial,
    GridSag,
    Shape,
    ZernikeDeformation,
    ZernikeSag,
)

Array = NDArray[np.float64]
SagAndSlopes = tuple[Array, Array, Array]

_SMALLEST_RADIUS = 1e-9  # mm; a far smaller one overflows


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
    curvature = 1.0 / shape.radius
    base = conic_sag(x, y, curvature, shape.conic)
    slopes = conic_slopes(x, y, curvature, shape.conic)
    extra = _extra(shape, x, y)
    return base + extra[0], slopes[0] + extra[1], slopes[1] + extra[2]


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
        smooth = _zernike(figure, deformation.pupil_radius, deformation.obscuration, x, y)
        if rest is None:
            return smooth
        rough = _grid(left.reshape(rest.rows, rest.columns), rest.dx, rest.dy, x, y)
        return smooth[0] + rough[0], smooth[1] + rough[1], smooth[2] + rough[2]
    if coefficients.shape != (deformation.rows, deformation.columns):
        raise UserError(
            f"a deformation on a grid of {deformation.rows} rows and {deformation.columns} columns has "
            f"heights of the shape {coefficients.shape}"
        )
    return _grid(coefficients, deformation.dx, deformation.dy, x, y)


def vertex_curvature(shape: Shape) -> float:
    """Return the mean curvature at the vertex, 1/mm: what a paraxial ray sees.

    Raises
    ------
    UserError
        As `shape_sag`.
    """
    require_shape(shape)
    curvature = 1.0 / shape.radius
    if isinstance(shape, Conic):
        return curvature
    if isinstance(shape, EvenAsphere):
        return curvature + (2.0 * shape.coefficients[0] if shape.coefficients else 0.0)
    if isinstance(shape, ExtendedPolynomial):
        square = [*shape.coefficients, 0.0, 0.0, 0.0, 0.0, 0.0]
        return curvature + (square[2] + square[4]) / shape.normalization_radius**2
    step = 1e-4 * shape.pupil_radius if isinstance(shape, ZernikeSag) else 1e-3 * min(shape.dx, shape.dy)
    ends = np.array([step, -step])
    with np.errstate(over="ignore", invalid="ignore"):  # infinite curvatures are told where they matter
        _, along_x, _ = _extra(shape, ends, np.zeros(2))
        _, _, along_y = _extra(shape, np.zeros(2), ends)
        return curvature + float(along_x[0] - along_x[1] + along_y[0] - along_y[1]) / (4.0 * step)


def require_shape(shape: Shape) -> None:
    """Raise UserError unless the numbers of a shape make a surface."""
    what = type(shape).__name__
    if not abs(shape.radius) >= _SMALLEST_RADIUS:
        raise UserError(
            f"the radius of a {what} is {shape.radius} mm; its size must be {_SMALLEST_RADIUS:g} mm at least "
            "(a plane: infinite)"
        )
    if not np.isfinite(shape.conic):
        raise UserError(f"the conic constant of a {what} is {shape.conic}; it must be a finite number")
    if isinstance(shape, EvenAsphere | ExtendedPolynomial | ZernikeSag):
        numbers = np.asarray(shape.coefficients, dtype=np.float64)
        if not np.isfinite(numbers).all():
            bad = int(np.flatnonzero(~np.isfinite(numbers))[0])
            raise UserError(f"coefficient {bad} of a {what} is {numbers[bad]}; it must be a finite number")
    if isinstance(shape, ZernikeSag) and not _SMALLEST_RADIUS <= shape.pupil_radius < np.inf:
        raise UserError(
            f"the pupil radius of a {what} is {shape.pupil_radius}; it must be {_SMALLEST_RADIUS:g} "
            "mm at least"
        )
    if isinstance(shape, ExtendedPolynomial) and not shape.normalization_radius >= _SMALLEST_RADIUS:
        raise UserError(
            f"the normalization radius of a {what} is {shape.normalization_radius}; it must be positive, "
            f"{_SMALLEST_RADIUS:g} mm at least"
        )
    if isinstance(shape, GridSag):
        require_grid(shape.heights, shape.dx, shape.dy)


def require_grid(heights: Array, dx: float, dy: float) -> None:
    """Raise UserError unless heights (..., rows, columns) on a grid make a smooth surface."""
    if heights.ndim < 2 or min(heights.shape[-2:]) < 4:
        raise UserError(f"a grid of heights has the shape {heights.shape}; it needs 4 rows and 4 columns")
    if not np.isfinite(heights).all():
        raise UserError("a grid of heights holds numbers that are not finite; fill its holes first")
    if not (dx > 0.0 and dy > 0.0 and np.isfinite(dx) and np.isfinite(dy)):
        raise UserError(f"the spacings of a grid are {dx} and {dy} mm; they must be positive")


def _extra(shape: Shape, x: Array, y: Array) -> SagAndSlopes:
    """Return what a shape adds to its conic."""
    if isinstance(shape, EvenAsphere):
        return _even(shape, x, y)
    if isinstance(shape, ExtendedPolynomial):
        return _extended(shape, x, y)
    if isinstance(shape, ZernikeSag):
        return _zernike(np.asarray(shape.coefficients), shape.pupil_radius, shape.obscuration, x, y)
    if isinstance(shape, GridSag):
        return _grid(shape.heights, shape.dx, shape.dy, x, y)
    return np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)


def _even(shape: EvenAsphere, x: Array, y: Array) -> SagAndSlopes:
    polynomial = np.polynomial.Polynomial([0.0, *shape.coefficients])
    square = x**2 + y**2
    slope = 2.0 * polynomial.deriv()(square)
    return polynomial(square), slope * x, slope * y


def _extended(shape: ExtendedPolynomial, x: Array, y: Array) -> SagAndSlopes:
    radius = shape.normalization_radius
    u, v = x / radius, y / radius
    value, slope_x, slope_y = np.zeros_like(u), np.zeros_like(u), np.zeros_like(u)
    for (i, j), coefficient in zip(extended_powers(len(shape.coefficients)), shape.coefficients, strict=True):
        value += coefficient * u**i * v**j
        slope_x += coefficient * i * u ** max(i - 1, 0) * v**j / radius
        slope_y += coefficient * j * u**i * v ** max(j - 1, 0) / radius
    return value, slope_x, slope_y


def extended_powers(count: int) -> list[tuple[int, int]]:
    """Return the powers of x and y of an extended polynomial's terms (Störkle 2018, Table 3.1)."""
    powers: list[tuple[int, int]] = []
    degree = 1
    while len(powers) < count:
        powers += [(degree - j, j) for j in range(degree + 1)]
        degree += 1
    return powers[:count]


def _zernike(coefficients: Array, radius: float, obscuration: float, x: Array, y: Array) -> SagAndSlopes:
    if coefficients.size == 0:
        return np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    bases = annular_zernike_gradient(x.ravel() / radius, y.ravel() / radius, coefficients.size, obscuration)
    value, slope_x, slope_y = ((basis @ coefficients).reshape(x.shape) for basis in bases)
    return value, slope_x / radius, slope_y / radius


def _grid(heights: Array, dx: float, dy: float, x: Array, y: Array) -> SagAndSlopes:
    require_grid(heights, dx, dy)
    rows, columns = heights.shape
    half_x, half_y = dx * (columns - 1) / 2.0, dy * (rows - 1) / 2.0
    nodes_y, nodes_x = np.linspace(-half_y, half_y, rows), np.linspace(-half_x, half_x, columns)
    spline = RectBivariateSpline(nodes_y, nodes_x, heights)
    at_x, at_y = np.clip(x, -half_x, half_x), np.clip(y, -half_y, half_y)
    slope_x = np.where(at_x == x, spline.ev(at_y, at_x, dy=1), 0.0)
    slope_y = np.where(at_y == y, spline.ev(at_y, at_x, dx=1), 0.0)
    return spline.ev(at_y, at_x), slope_x, slope_y
