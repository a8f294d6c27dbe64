"""Conic surfaces of revolution: sag, slopes and intersection (NumPy, any shape).

The curvature c = 1/R describes every surface, a plane included (c = 0). A line along the axis may meet a
conic twice; the *sag branch* is the half through the vertex, and the only one that is glass.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def conic_sag(x: ArrayLike, y: ArrayLike, curvature: ArrayLike, conic: ArrayLike) -> Array:
    """Return the sag of a conic (Störkle 2018, Eq. 3.18, written with the curvature).

    Parameters
    ----------
    x, y : array_like
        Lateral position in mm.
    curvature, conic : array_like
        1/R in 1/mm (0 for a plane) and the conic constant; broadcast against x and y.

    Returns
    -------
    ndarray
        z in mm; NaN where the surface does not reach out so far.
    """
    square = np.square(x) + np.square(y)
    with np.errstate(invalid="ignore"):
        root = np.sqrt(1.0 - (1.0 + np.asarray(conic)) * np.square(curvature) * square)
    return np.asarray(curvature * square / (1.0 + root), dtype=np.float64)


def conic_slopes(x: ArrayLike, y: ArrayLike, curvature: ArrayLike, conic: ArrayLike) -> tuple[Array, Array]:
    """Return the slopes dz/dx, dz/dy of a conic; NaN where the surface does not reach or is vertical."""
    square = np.square(x) + np.square(y)
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(1.0 - (1.0 + np.asarray(conic)) * np.square(curvature) * square)
        factor = np.where(root > 0.0, curvature / root, np.nan)
    return np.asarray(factor * x, dtype=np.float64), np.asarray(factor * y, dtype=np.float64)


def conic_sag_and_slopes(
    x: ArrayLike, y: ArrayLike, curvature: ArrayLike, conic: ArrayLike
) -> tuple[Array, Array, Array]:
    """Return what `conic_sag` and `conic_slopes` do, to the bit, from one square root."""
    across, along, c = (np.asarray(one, dtype=np.float64) for one in (x, y, curvature))
    square = np.square(across) + np.square(along)
    with np.errstate(invalid="ignore", divide="ignore"):
        root: Array = np.sqrt(1.0 - (1.0 + np.asarray(conic, dtype=np.float64)) * np.square(c) * square)
        factor: Array = np.where(root > 0.0, c / root, np.nan)
        return c * square / (1.0 + root), factor * across, factor * along


def conic_path(
    position: Array, direction: Array, curvature: ArrayLike, conic: ArrayLike, sense: int = 0
) -> Array:
    """Return the path length from a ray's position to the sag branch of a conic.

    Störkle 2018, Eq. (3.28), with the root chosen by the sign of the direction's z component, and in the form
    that does not cancel. The path is negative where the surface lies behind the ray.

    Parameters
    ----------
    position, direction : ndarray, shape (3, ...)
        Position in mm and unit direction in the surface's frame.
    curvature, conic : array_like
        1/R in 1/mm (0 for a plane) and the conic constant.
    sense : int
        1 or -1 chooses the root that crosses the conic towards +z or -z instead.

    Returns
    -------
    ndarray
        Path length in mm; NaN for a ray that misses: no intersection, or one that is not on the sag branch.
    """
    c, kappa = np.asarray(curvature, dtype=np.float64), np.asarray(conic, dtype=np.float64)
    (x, y, z), (d_x, d_y, d_z) = position, direction
    along = x * d_x + y * d_y + z * d_z
    f = d_z - c * (along + kappa * z * d_z)
    g = c * (x * x + y * y + z * z + kappa * z * z) - 2.0 * z
    h = -c * (1.0 + kappa * d_z * d_z)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        root = np.where((sense or d_z) < 0.0, -1.0, 1.0) * np.sqrt(f * f + h * g)
        path = np.where(f * root < 0.0, (root - f) / h, g / (f + root))
        on_branch = 1.0 - c * (1.0 + kappa) * (z + path * d_z) > 0.0
        return np.where(on_branch & np.isfinite(path), path, np.nan)


def even_sag_and_slopes(
    x: ArrayLike, y: ArrayLike, coefficients: tuple[float, ...]
) -> tuple[Array, Array, Array]:
    """Return C_0 rho^2 + C_1 rho^4 + ... and its slopes (Störkle 2018, Eqs. 3.19 and 3.21 corrected).

    Parameters
    ----------
    x, y : array_like
        Lateral position in mm.
    coefficients : tuple of float
        ``coefficients[k]`` in mm^(-2 k - 1) belongs to (x^2 + y^2)^(k + 1).

    Returns
    -------
    tuple of ndarray
        Height in mm and its derivatives along x and y.
    """
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    square = np.square(x) + np.square(y)
    value, derivative = np.zeros_like(square), np.zeros_like(square)
    for coefficient in reversed((0.0, *coefficients)):
        derivative = derivative * square + value
        value = value * square + coefficient
    return value, 2.0 * derivative * x, 2.0 * derivative * y
