"""Zernike polynomials in Noll's order, over a circle or an annulus.

Noll index j = 1, 2, ..., unit rms over the pupil, even j is the cosine (Störkle 2018, Eq. 3.43-3.52;
Noll 1976, "Zernike polynomials and atmospheric turbulence"; Mahajan 1981, "Zernike annular polynomials for
imaging systems with annular pupils"). Polar angles are those of arctan2: the arctan printed in Eq. 3.43 holds
in two quadrants only.
"""

from math import comb, factorial, sqrt

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.kernels.trace.ring import Recurrence, ring_recurrence
from wavequake.optics.checks import alike, number, whole

Array = NDArray[np.float64]

MOST_TERMS = 2016  # degree 62: of figures, deformations and the fits of wavefronts


def noll_to_nm(j: int) -> tuple[int, int]:
    """Return the radial degree n and the azimuthal frequency m of a Noll index; m < 0 is the sine.

    Parameters
    ----------
    j : int
        Noll index, 1 for piston.

    Raises
    ------
    UserError
        If `j` is less than 1.
    """
    j = whole(j, "the Noll index")
    if j < 1:
        raise UserError(f"the Noll index {j} does not exist, the first one is 1 (piston)")
    n = 0
    while (n + 1) * (n + 2) // 2 < j:
        n += 1
    rank = j - n * (n + 1) // 2  # 1 .. n + 1 within the degree, frequencies ascending
    m = 2 * (rank // 2) if n % 2 == 0 else 2 * ((rank + 1) // 2) - 1
    return n, m if j % 2 == 0 else -m


def annular_zernike(
    x: NDArray[np.float64], y: NDArray[np.float64], terms: int, obscuration: float = 0.0
) -> NDArray[np.float64]:
    """Return the Noll Zernike polynomials j = 1..terms at the points of a pupil.

    The radial part is ``rho^|m| P_k(rho^2)`` with P_k orthogonal over [obscuration^2, 1] for the weight
    t^|m|, evaluated by the three-term recurrence of P_k, which stays accurate where sums of monomials
    cancel. Points outside the annulus are valid: the polynomials continue.

    Parameters
    ----------
    x, y : ndarray, shape (N,)
        Points in units of the outer pupil radius.
    terms : int
        Number J of polynomials.
    obscuration : float
        Inner over outer radius, 0 (a circle) <= obscuration < 1.

    Returns
    -------
    ndarray, shape (N, J)

    Raises
    ------
    UserError
        If there is no term, the obscuration is not in [0, 1), or the points are not arrays of equal length.
    """
    orders, degree = _orders(terms, obscuration)
    x, y = alike("the points of the pupil", x, y)
    t = x**2 + y**2
    radial = {}
    for m in range(degree + 1):
        recurrence = ring_recurrence(m, (degree - m) // 2 + 1, obscuration**2)
        for k, values in enumerate(_orthonormal(t, recurrence)):
            radial[m + 2 * k, m] = values
    azimuthal = _azimuthal(x, y, degree)
    basis = np.empty((len(t), terms))
    for column, (n, m) in enumerate(orders):
        wave = azimuthal[abs(m)]
        basis[:, column] = radial[n, abs(m)] * (wave.imag if m < 0 else wave.real) * (sqrt(2) if m else 1.0)
    return basis


def annular_zernike_gradient(
    x: Array, y: Array, terms: int, obscuration: float = 0.0
) -> tuple[Array, Array, Array]:
    """Return the polynomials of `annular_zernike` and their derivatives in x and y.

    The differentiated recurrence gives the slopes of P_k; nothing divides by the radius, so the center of a
    circle is a point like any other.

    Parameters
    ----------
    x, y, terms, obscuration
        As for `annular_zernike`.

    Returns
    -------
    values, by_x, by_y : ndarray, shape (N, J)
        The derivatives are per outer pupil radius.

    Raises
    ------
    UserError
        If there is no term, the obscuration is not in [0, 1), or the points are not arrays of equal length.
    """
    orders, degree = _orders(terms, obscuration)
    x, y = alike("the points of the pupil", x, y)
    t = x**2 + y**2
    radial = {}
    for m in range(degree + 1):
        recurrence = ring_recurrence(m, (degree - m) // 2 + 1, obscuration**2)
        heights = _orthonormal(t, recurrence)
        slopes = _orthonormal_slopes(t, recurrence, heights)
        for k, pair in enumerate(zip(heights, slopes, strict=True)):
            radial[m + 2 * k, m] = pair
    azimuthal = _azimuthal(x, y, degree)
    values, by_x, by_y = (np.empty((len(t), terms)) for _ in range(3))
    for column, (n, m) in enumerate(orders):
        height, slope = radial[n, abs(m)]
        wave = azimuthal[abs(m)]
        along = abs(m) * azimuthal[max(abs(m) - 1, 0)]  # the wave's derivative in x; i times it: in y
        factor = sqrt(2) if m else 1.0
        if m < 0:
            part, part_x, part_y = wave.imag, along.imag, along.real
        else:
            part, part_x, part_y = wave.real, along.real, -along.imag
        values[:, column] = height * part * factor
        by_x[:, column] = (slope * (2.0 * x) * part + height * part_x) * factor
        by_y[:, column] = (slope * (2.0 * y) * part + height * part_y) * factor
    return values, by_x, by_y


def _orders(terms: int, obscuration: float) -> tuple[list[tuple[int, int]], int]:
    """Return n and m of the Noll indices 1..terms and the highest degree."""
    terms, obscuration = whole(terms, "the number of Zernike terms"), number(obscuration, "the obscuration")
    if terms < 1:
        raise UserError(f"{terms} Zernike terms were asked for, at least 1 is needed")
    if not 0.0 <= obscuration < 1.0:
        raise UserError(f"the ratio of inner to outer pupil radius is {obscuration}, it must lie in [0, 1)")
    orders = [noll_to_nm(j) for j in range(1, terms + 1)]
    return orders, orders[-1][0]


def _azimuthal(x: Array, y: Array, degree: int) -> list[NDArray[np.complex128]]:
    """Return (x + i y)^m = rho^m exp(i m theta) for m = 0..degree."""
    waves = [np.ones(len(x), dtype=np.complex128)]
    for _ in range(degree):
        waves.append(waves[-1] * (x + 1j * y))
    return waves


def _orthonormal(t: Array, recurrence: Recurrence) -> list[Array]:
    """Return P_0, P_1, ... at t."""
    first, steps = recurrence
    values = [np.full_like(t, first)]
    for center, before, norm in steps:
        earlier = values[-2] if len(values) > 1 else np.zeros_like(t)
        values.append(((t - center) * values[-1] - before * earlier) / norm)
    return values


def _orthonormal_slopes(t: Array, recurrence: Recurrence, values: list[Array]) -> list[Array]:
    """Return the derivatives of P_0, P_1, ... at t, where they have the `values`."""
    slopes = [np.zeros_like(t)]
    for k, (center, before, norm) in enumerate(recurrence[1]):
        earlier = slopes[-2] if k else np.zeros_like(t)
        slopes.append((values[k] + (t - center) * slopes[-1] - before * earlier) / norm)
    return slopes


def circular_zernike_xy(degree: int, terms: int) -> NDArray[np.float64]:
    """Return the matrix that turns circular Noll coefficients into coefficients of monomials.

    The monomials are in total-degree order, for n = 0..degree: ``u^n, u^(n-1) v, ..., v^n``, with u, v in
    units of the circle's radius. Every entry is an integer times one square root (Störkle 2018,
    Eq. 3.44, 3.45).

    Parameters
    ----------
    degree : int
        Total degree of the monomials.
    terms : int
        Number of Zernike coefficients, j = 1..terms.

    Returns
    -------
    ndarray, shape ((degree + 1) (degree + 2) / 2, terms)

    Raises
    ------
    UserError
        If a term has a higher degree than `degree`.
    """
    matrix = np.zeros(((degree + 1) * (degree + 2) // 2, terms))
    for column in range(terms):
        n, signed = noll_to_nm(column + 1)
        if n > degree:
            raise UserError(
                f"Zernike term {column + 1} has degree {n}, more than the polynomial's degree {degree}"
            )
        m = abs(signed)
        scale = sqrt((n + 1) * (2 if m else 1))
        for k in range((n - m) // 2 + 1):
            radial = (-1) ** k * factorial(n - k) // factorial(k)
            radial //= factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k)
            rings = (
                n - m
            ) // 2 - k  # rho^(n - 2 k) cos or sin = (u^2 + v^2)^rings times Re or Im (u + i v)^m
            for ring in range(rings + 1):
                for power in range(1 if signed < 0 else 0, m + 1, 2):
                    entry = radial * comb(rings, ring) * comb(m, power) * (-1) ** (power // 2)
                    total, in_v = n - 2 * k, 2 * ring + power
                    matrix[total * (total + 1) // 2 + in_v, column] += scale * entry
    return matrix
