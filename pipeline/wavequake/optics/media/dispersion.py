"""Dispersion formulas: the refractive index as a function of the wavelength w in um.

Their names and the order of their coefficients are those of the makers' catalogues in AGF files, as the
OpticStudio manual lists them (formulas 1 to 13).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

_Squared = Callable[[Sequence[float], float], float]


@dataclass(frozen=True)
class Formula:
    """A formula: how many coefficients it takes (one of ``counts``) and n^2 from them and w^2.

    ``rule`` is the formula in words, with w in um.
    """

    counts: tuple[int, ...]
    squared: _Squared
    rule: str


def _sellmeier(k: Sequence[float], w2: float) -> float:
    terms = zip(k[::2], k[1::2], strict=True)
    return 1 + sum(b * w2 / (w2 - c) if w2 != c else math.inf for b, c in terms)


def _herzberger(k: Sequence[float], w2: float) -> float:
    pole = _over(1.0, w2, 0.028)
    return _square(k[0] + k[1] * pole + k[2] * pole**2 + k[3] * w2 + k[4] * w2**2 + k[5] * w2**3)


def _conrady(k: Sequence[float], w2: float) -> float:
    return _square(k[0] + k[1] * w2**-0.5 + k[2] * w2**-1.75)


def _powers(*exponents: int) -> _Squared:
    """Return the sum of the coefficients times these powers of w^2."""

    def squared(k: Sequence[float], w2: float) -> float:
        return k[0] + sum(a * w2**power for a, power in zip(k[1:], exponents, strict=True))

    return squared


def _schott(k: Sequence[float], w2: float) -> float:
    return k[0] + k[1] * w2 + sum(a * w2**-power for power, a in enumerate(k[2:], 1))


def _over(numerator: float, w2: float, pole: float) -> float:
    return numerator / (w2 - pole) if w2 != pole else math.inf


def _square(index: float) -> float:
    """Return n^2; an index that is not positive stays so, and is refused as such."""
    return math.copysign(index**2, index)


FORMULAS: dict[str, Formula] = {
    "constant": Formula((1,), lambda k, w2: _square(k[0]), "n = k0"),
    "schott": Formula((6,), _schott, "n^2 = k0 + k1 w^2 + k2 w^-2 + k3 w^-4 + k4 w^-6 + k5 w^-8"),
    "sellmeier": Formula((6, 8, 10), _sellmeier, "n^2 = 1 + sum B w^2 / (w^2 - C), k = B1, C1, B2, C2, ..."),
    "herzberger": Formula(
        (6,), _herzberger, "n = k0 + k1 L + k2 L^2 + k3 w^2 + k4 w^4 + k5 w^6 with L = 1 / (w^2 - 0.028)"
    ),
    "sellmeier2": Formula(
        (5,),
        lambda k, w2: 1 + k[0] + _over(k[1] * w2, w2, k[2] ** 2) + _over(k[3], w2, k[4] ** 2),
        "n^2 = 1 + k0 + k1 w^2 / (w^2 - k2^2) + k3 / (w^2 - k4^2)",
    ),
    "conrady": Formula((3,), _conrady, "n = k0 + k1 / w + k2 / w^3.5"),
    "handbook1": Formula(
        (4,),
        lambda k, w2: k[0] + _over(k[1], w2, k[2]) - k[3] * w2,
        "n^2 = k0 + k1 / (w^2 - k2) - k3 w^2",
    ),
    "handbook2": Formula(
        (4,),
        lambda k, w2: k[0] + _over(k[1] * w2, w2, k[2]) - k[3] * w2,
        "n^2 = k0 + k1 w^2 / (w^2 - k2) - k3 w^2",
    ),
    "sellmeier4": Formula(
        (5,),
        lambda k, w2: k[0] + _over(k[1] * w2, w2, k[2]) + _over(k[3] * w2, w2, k[4]),
        "n^2 = k0 + k1 w^2 / (w^2 - k2) + k3 w^2 / (w^2 - k4)",
    ),
    "extended": Formula(
        (8,), _powers(1, -1, -2, -3, -4, -5, -6), "n^2 = k0 + k1 w^2 + k2 w^-2 + k3 w^-4 + ... + k7 w^-12"
    ),
    "extended2": Formula(
        (8,),
        _powers(1, -1, -2, -3, -4, 2, 3),
        "n^2 = k0 + k1 w^2 + k2 w^-2 + k3 w^-4 + k4 w^-6 + k5 w^-8 + k6 w^4 + k7 w^6",
    ),
    "extended3": Formula(
        (9,),
        _powers(1, 2, -1, -2, -3, -4, -5, -6),
        "n^2 = k0 + k1 w^2 + k2 w^4 + k3 w^-2 + k4 w^-4 + ... + k8 w^-12",
    ),
    "selfoc": Formula(
        (5,),
        lambda k, w2: _square(k[0] + k[1] / w2),
        "n = k0 + k1 / w^2 on the axis of a rod, where GRINSUR9 takes k2 to k4 for the gradient",
    ),
}
"""Formulas by name."""

AGF_FORMULAS: dict[int, tuple[str, int]] = {
    1: ("schott", 6),
    2: ("sellmeier", 6),
    3: ("herzberger", 6),
    4: ("sellmeier2", 5),
    5: ("conrady", 3),
    6: ("sellmeier", 8),
    7: ("handbook1", 4),
    8: ("handbook2", 4),
    9: ("sellmeier4", 5),
    10: ("extended", 8),
    11: ("sellmeier", 10),
    12: ("extended2", 8),
    13: ("extended3", 9),
}
"""Name and number of coefficients of the formulas by their number in AGF files."""
