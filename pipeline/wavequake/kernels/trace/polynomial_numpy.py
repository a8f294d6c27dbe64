"""Polynomials in x and y and their slopes, in NumPy: monomials by Horner's rule, others by recurrences."""

import numpy as np
from numpy.typing import NDArray

from wavequake.kernels.trace.ring import ring_polynomial
from wavequake.kernels.trace.sequence import Basis

Array = NDArray[np.float64]


def polynomial(
    degree: int, radius: float, basis: Basis, coefficients: Array, x: Array, y: Array
) -> tuple[Array, Array, Array]:
    """Return a polynomial of total degree `degree` in x / radius and y / radius, and its slopes.

    Parameters
    ----------
    degree : int
        Highest total degree.
    radius : float
        What x and y are divided by, mm.
    basis : str or Ring
        "monomial", or the ring of Zernike polynomials.
    coefficients : ndarray, shape (terms,) or (T, terms)
        In the order of `wavequake.kernels.trace.sequence.Polynomial`, mm.
    x, y : ndarray
        Position in mm; for coefficients per instant their first axis is the instant.

    Returns
    -------
    tuple of ndarray
        Height in mm and its derivatives along x and y.
    """
    u, v = x / radius, y / radius
    terms = np.moveaxis(coefficients, -1, 0)
    terms = terms.reshape(*terms.shape, *(1,) * (u.ndim - terms.ndim + 1))
    if basis != "monomial":
        value, slope_u, slope_v = ring_polynomial(degree, basis.inner, terms, u, v)
        return value, slope_u / radius, slope_v / radius
    rows = [[terms[(i + j) * (i + j + 1) // 2 + j] for j in range(degree - i + 1)] for i in range(degree + 1)]
    inner = [_horner(row, v) for row in rows]
    value, slope_u = _horner([value for value, _ in inner], u)
    slope_v, _ = _horner([slope for _, slope in inner], u)
    return value, slope_u / radius, slope_v / radius


def _horner(coefficients: list[Array], t: Array) -> tuple[Array, Array]:
    """Return the sum of c_k t^k and its derivative."""
    value, derivative = np.zeros_like(t), np.zeros_like(t)
    for coefficient in reversed(coefficients):
        derivative = derivative * t + value
        value = value * t + coefficient
    return value, derivative
