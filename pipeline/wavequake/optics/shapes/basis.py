"""From Zernike coefficients and grid heights to the polynomials and splines that the trace evaluates."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.trace.ring import ring_order
from wavequake.kernels.trace.sequence import Basis, Ring
from wavequake.optics.polynomials.transforms import expansion_matrix
from wavequake.optics.polynomials.zernike import MOST_TERMS, circular_zernike_xy, noll_to_nm
from wavequake.prepared import prepared

Array = NDArray[np.float64]

# Up to here sums of monomials are traced: they take a third of the time of recurrences, lose 1e-8 at most.
_MONOMIAL_TERMS = 231
_MONOMIAL_SUM = 1e11  # of absolute values of one polynomial's coefficients


@dataclass(frozen=True)
class ZernikeBasis:
    """How Zernike polynomials are traced: ``matrix`` turns Noll coefficients into those of ``basis``."""

    degree: int
    matrix: Array
    basis: Basis = "monomial"


def zernike_basis(terms: int, obscuration: float = 0.0) -> ZernikeBasis:
    """Return what turns Noll coefficients j = 1..terms into those that the trace takes.

    Monomials in x and y are the fastest to trace, but cancel near the rim: relative to the largest height,
    random coefficients lose 2e-13 at j = 105, 4e-12 at 153 and 1e-10 at 231, and would lose 1e-9 at 300 and
    2e-7 at 496 (measured against 60 digits). Beyond 231, or where a wide hole makes them lose 1e-8 earlier,
    the polynomials are traced by recurrences of their own, which lose 4e-14 or less. Products of Chebyshev
    polynomials cancel as much as monomials, since Zernike polynomials are huge in the corners of the square.

    Raises
    ------
    UserError
        If there is no term, there are more than 2016, or the obscuration is not in [0, 1).
    """
    if not 1 <= terms <= MOST_TERMS:
        raise UserError(f"a surface has {terms} Zernike terms; it can have 1 to {MOST_TERMS} (use a grid)")
    if not 0.0 <= obscuration < 1.0:
        raise UserError(f"the ratio of inner to outer pupil radius is {obscuration}, it must lie in [0, 1)")
    return _zernike_basis(terms, obscuration)


@prepared(maxsize=32)
def _zernike_basis(terms: int, obscuration: float) -> ZernikeBasis:
    degree = noll_to_nm(terms)[0]
    if terms <= _MONOMIAL_TERMS:
        matrix = circular_zernike_xy(degree, terms)
        if obscuration > 0.0:
            matrix = matrix @ expansion_matrix(terms, obscuration, 0.0).T
        if np.abs(matrix).sum(axis=0).max() <= _MONOMIAL_SUM:
            return ZernikeBasis(degree, matrix)
    column = {noll_to_nm(j): j - 1 for j in range(1, terms + 1)}
    matrix = np.zeros(((degree + 1) * (degree + 2) // 2, terms))
    for row, order in enumerate(ring_order(degree)):
        if order in column:
            matrix[row, column[order]] = 1.0
    return ZernikeBasis(degree, matrix, Ring(obscuration))


def spline_coefficients(heights: Array) -> Array:
    """Return the coefficients of the uniform bicubic B-spline through heights on a grid.

    Its third derivative is continuous at the nodes next to the edge ("not a knot"), so that polynomials of
    degree 3 are kept. One ring of coefficients lies outside of the grid.

    Parameters
    ----------
    heights : ndarray, shape (..., rows, columns)
        At least 4 rows and columns.

    Returns
    -------
    ndarray, shape (..., rows + 2, columns + 2)
    """
    along_y, along_x = (_spline_matrix(count) for count in heights.shape[-2:])
    coefficients: Array = along_y @ heights @ along_x.T
    return coefficients


@prepared(maxsize=32)
def _spline_matrix(count: int) -> Array:
    """Return the matrix (count + 2, count) from values at nodes to coefficients of a cubic B-spline."""
    system = np.zeros((count + 2, count + 2))
    for node in range(count):
        system[node + 1, node : node + 3] = [1 / 6, 4 / 6, 1 / 6]
    fourth_difference = [1.0, -4.0, 6.0, -4.0, 1.0]
    system[0, :5] = system[-1, -5:] = fourth_difference
    return np.asarray(np.linalg.inv(system)[:, 1:-1], dtype=np.float64)
