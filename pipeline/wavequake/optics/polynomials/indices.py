"""Single indices of Zernike polynomials: Noll's, ANSI/OSA's and Fringe's, and what converts between them.

All three count the same functions, R_n^m(rho) cos(m theta) and, here with m < 0, R_n^|m|(rho) sin(|m| theta),
but in different orders and of different sizes:

========  ===========  ======================================================================  =========
scheme    first index  order                                                                   size
========  ===========  ======================================================================  =========
Noll      1            by degree n, then by |m|; the even index is the cosine                  unit rms
ANSI      0            by degree n, then by m                                                  unit rms
Fringe    1            by (n + |m|) / 2, then by falling |m|; the cosine before the sine       unit peak
========  ===========  ======================================================================  =========

Sources: Noll 1976, "Zernike polynomials and atmospheric turbulence"; ANSI Z80.28, the OSA's standard; for
Fringe (University of Arizona) Wyant and Creath 1992, "Basic wavefront aberration theory for optical
metrology".
"""

from collections.abc import Callable
from math import isqrt, sqrt
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavequake.errors import UserError
from wavequake.optics.checks import array, whole
from wavequake.optics.polynomials.zernike import noll_to_nm

Scheme = Literal["noll", "ansi", "fringe"]

_ARIZONA = 37  # the last term of the University of Arizona's set, out of order: (12, 0)
_TWELFTH_ORDER = (12, 0)


def nm_to_noll(n: int, m: int) -> int:
    """Return the Noll index of degree n and frequency m; m < 0 is the sine.

    Raises
    ------
    UserError
        If there is no such polynomial.
    """
    _require_nm(n, m)
    first = n * (n + 1) // 2
    if m == 0:
        return first + 1
    j = first + abs(m)  # the pair of |m| takes the indices j and j + 1
    return j + (j % 2 == 0) if m < 0 else j + j % 2


def ansi_to_nm(j: int) -> tuple[int, int]:
    """Return degree and frequency of an ANSI/OSA index, which starts at 0.

    Raises
    ------
    UserError
        If the index is negative or not whole.
    """
    j = whole(j, "the ANSI index")
    if j < 0:
        raise UserError(f"the ANSI index {j} does not exist, the first one is 0 (piston)")
    n = (isqrt(8 * j + 1) - 1) // 2
    return n, 2 * j - n * (n + 2)


def nm_to_ansi(n: int, m: int) -> int:
    """Return the ANSI/OSA index of degree n and frequency m.

    Raises
    ------
    UserError
        If there is no such polynomial.
    """
    _require_nm(n, m)
    return (n * (n + 2) + m) // 2


def fringe_to_nm(j: int, arizona: bool = False) -> tuple[int, int]:
    """Return degree and frequency of a Fringe index.

    Parameters
    ----------
    j : int
        From 1 on.
    arizona : bool
        True for the University of Arizona's set of 37 terms, whose last one is not (6, 6), which follows in
        order, but (12, 0), the extended set's term 49.

    Raises
    ------
    UserError
        If the index is less than 1 or not whole, or more than 37 in the set of 37.
    """
    j = whole(j, "the Fringe index")
    if j < 1:
        raise UserError(f"the Fringe index {j} does not exist, the first one is 1 (piston)")
    if arizona and j > _ARIZONA:
        raise UserError(f"the Fringe index {j} does not exist in the set of {_ARIZONA} terms")
    if arizona and j == _ARIZONA:
        return _TWELFTH_ORDER
    half = isqrt(j - 1)  # (n + |m|) / 2, of which 2 half + 1 terms end at (half + 1)^2
    left = (half + 1) ** 2 - j
    m = (left + 1) // 2
    return 2 * half - m, -m if left % 2 else m


def nm_to_fringe(n: int, m: int, arizona: bool = False) -> int:
    """Return the Fringe index of degree n and frequency m; see `fringe_to_nm` for `arizona`.

    Raises
    ------
    UserError
        If there is no such polynomial, or it is not among the 37.
    """
    _require_nm(n, m)
    if arizona and (n, m) == _TWELFTH_ORDER:
        return _ARIZONA
    j = ((n + abs(m)) // 2 + 1) ** 2 - 2 * abs(m) + (1 if m < 0 else 0)
    if arizona and j >= _ARIZONA:
        raise UserError(f"the polynomial (n, m) = ({n}, {m}) is not in the set of {_ARIZONA} Fringe terms")
    return j


def peak_amplitude(n: int, m: int) -> float:
    """Return the value at the rim of the unit-rms polynomial (n, m) along its crest (Störkle 2018, Eq. 3.44).

    A Fringe polynomial is the unit-rms one divided by it, so a Fringe coefficient is the Noll or ANSI one
    times it.

    Raises
    ------
    UserError
        If there is no such polynomial.
    """
    _require_nm(n, m)
    return sqrt((n + 1) * (2 if m else 1))


def convert_coefficients(coefficients: ArrayLike, source: Scheme, target: Scheme) -> NDArray[np.float64]:
    """Return the same sum of circular Zernike polynomials by the indices and sizes of another scheme.

    Parameters
    ----------
    coefficients : array_like, shape (..., J)
        By the source's index, from its first one on.
    source, target : {"noll", "ansi", "fringe"}
        Fringe is the set without end; of the 37 terms of the University of Arizona move the last to the place
        of term 49 first.

    Returns
    -------
    ndarray, shape (..., K)
        By the target's index. K just holds the J source terms; a polynomial among the K that the source does
        not have is zero.

    Raises
    ------
    UserError
        If a scheme is unknown, or the coefficients are no array of numbers.
    """
    coefficients = array(coefficients, "the coefficients")
    if coefficients.ndim == 0:
        raise UserError(f"the coefficients are the number {coefficients}; give a list, by the source's index")
    for scheme in (source, target):
        if not isinstance(scheme, str) or scheme not in _SCHEMES:
            raise UserError(f"the Zernike scheme {scheme!r} is unknown, choose one of {', '.join(_SCHEMES)}")
    first, to_nm, _ = _SCHEMES[source]
    start, _, from_nm = _SCHEMES[target]
    orders = [to_nm(first + i) for i in range(coefficients.shape[-1])]
    place = np.array([from_nm(n, m) - start for n, m in orders], dtype=np.int64)
    peaks = np.array([peak_amplitude(n, m) for n, m in orders])
    power = (target == "fringe") - (source == "fringe")
    converted = np.zeros((*coefficients.shape[:-1], place.max(initial=-1) + 1))
    converted[..., place] = coefficients * peaks**power
    return converted


def _require_nm(n: int, m: int) -> None:
    whole(n, "the degree of a Zernike polynomial"), whole(m, "the frequency of a Zernike polynomial")
    if n < 0 or abs(m) > n or (n - m) % 2:
        raise UserError(
            f"there is no Zernike polynomial (n, m) = ({n}, {m}); it needs |m| <= n and n - m even"
        )


_SCHEMES: dict[str, tuple[int, Callable[[int], tuple[int, int]], Callable[[int, int], int]]] = {
    "noll": (1, noll_to_nm, nm_to_noll),
    "ansi": (0, ansi_to_nm, nm_to_ansi),
    "fringe": (1, fringe_to_nm, nm_to_fringe),
}
