"""From coefficients over one annulus to those over another (Störkle 2018, Eq. 3.53), and from powers."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.optics.checks import array, number, whole
from wavequake.optics.polynomials.indices import nm_to_noll
from wavequake.optics.polynomials.zernike import MOST_TERMS, annular_zernike, noll_to_nm

Array = NDArray[np.float64]


def expansion_matrix(terms: int, source: float, target: float) -> Array:
    """Return M: the polynomials of obscuration `source` as sums of those of obscuration `target`.

    ``Z_source = M Z_target`` holds exactly and everywhere, as both are polynomials. So the same wavefront
    has the coefficients ``c_target = M^T c_source``; with ``target = 0`` that is Störkle 2018, Eq. 3.53, and
    the matrix with source and target exchanged is the inverse, computed without inverting. Only terms of
    equal frequency mix, and M is lower triangular, so it is exact however many terms are kept.

    From a wide hole to a narrow one the coefficients grow, since annular polynomials are large where their
    pupil has no glass: that is the problem's condition, and why the circular coefficients of an annular
    wavefront have no physical meaning.

    Parameters
    ----------
    terms : int
        Number J of Noll polynomials.
    source, target : float
        Inner over outer radius, 0 (a circle) <= obscuration < 1.

    Returns
    -------
    ndarray, shape (J, J)

    Raises
    ------
    UserError
        If there is no term or more than 2016, or an obscuration is not in [0, 1).
    """
    source, target = (number(one, "the obscuration") for one in (source, target))
    if not 0.0 <= target < 1.0:
        raise UserError(f"the ratio of inner to outer pupil radius is {target}, it must lie in [0, 1)")
    if not 1 <= whole(terms, "the number of Zernike terms") <= MOST_TERMS:
        raise UserError(f"the number of Zernike terms is {terms}; it must be from 1 to {MOST_TERMS}")
    n, m = np.array([noll_to_nm(j) for j in range(1, terms + 1)]).T
    # Gauss-Legendre in rho^2 along the x axis, where every cosine has its crest, integrates the products of
    # two radial polynomials of equal frequency exactly. The sine has its cosine's radial polynomial.
    nodes, weights = np.polynomial.legendre.leggauss(int(n[-1]) + 1)
    rho = np.sqrt(target**2 + (1.0 - target**2) * (nodes + 1.0) / 2.0)
    cosines = [
        nm_to_noll(degree, abs(frequency)) for degree, frequency in zip(n.tolist(), m.tolist(), strict=True)
    ]
    of, into = (
        annular_zernike(rho, np.zeros_like(rho), max(cosines), eps)[:, np.array(cosines) - 1]
        for eps in (source, target)
    )
    products = (weights / 2.0 * of.T) @ into
    return np.tril(np.where(np.equal.outer(m, m), products / np.where(m == 0, 1.0, 2.0), 0.0))


def transform_coefficients(coefficients: Array, source: float, target: float) -> Array:
    """Return the coefficients over the annulus `target` for the wavefront of those over `source`.

    Parameters
    ----------
    coefficients : ndarray, shape (..., J)
        Noll, j = 1..J.
    source, target : float
        Obscurations, as in `expansion_matrix`.

    Returns
    -------
    ndarray, shape (..., J)

    Raises
    ------
    UserError
        As `expansion_matrix`.
    """
    coefficients = np.atleast_1d(array(coefficients, "the coefficients"))
    transformed: Array = coefficients @ expansion_matrix(coefficients.shape[-1], source, target)
    return transformed


def known_transformed(coefficients: Array, source: float, target: float) -> Array:
    """Return `transform_coefficients` where a coefficient may be unknown (NaN), such as a piston from slopes.

    It stays unknown, and the others take it as zero.
    """
    known = np.nan_to_num(coefficients, posinf=np.inf, neginf=-np.inf)
    return np.where(np.isnan(coefficients), np.nan, transform_coefficients(known, source, target))


def powers_as_zernike(powers: Sequence[float], norm: float) -> tuple[float, ...]:
    """Return the Noll coefficients of powers rho^2, rho^4, ... (mm), exactly: they are even polynomials.

    The radial polynomial of degree 2 k without azimuth is Legendre's of degree k in 2 rho^2 - 1, its Noll
    number (2 k)(2 k + 1) / 2 + 1 and its norm sqrt(2 k + 1).
    """
    while not powers[-1]:
        powers = powers[:-1]
    total = np.polynomial.Polynomial([0.0])
    square = np.polynomial.Polynomial([0.5, 0.5])  # rho^2 by 2 rho^2 - 1
    for k, power in enumerate(powers, start=1):
        total = total + power * norm ** (2 * k) * square**k
    legendre = np.polynomial.legendre.poly2leg(total.coef)
    found = np.zeros(len(powers) * (2 * len(powers) + 1) + 1)
    for k, value in enumerate(legendre):
        found[k * (2 * k + 1)] = value / math.sqrt(2 * k + 1)
    return tuple(float(value) for value in found)
