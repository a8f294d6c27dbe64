"""Exponentials of stacks of small matrices: `scipy.linalg.expm` takes them one by one, in Python."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Matrices = NDArray[np.inexact[Any]]

# The Padé approximant of order 13 (Higham 2005, The scaling and squaring method for the matrix exponential
# revisited), which is exact up to norms of 5.4; beyond one, digits of it cancel.
_PADE = (
    64764752532480000.0,
    32382376266240000.0,
    7771770303897600.0,
    1187353796428800.0,
    129060195264000.0,
    10559470521600.0,
    670442572800.0,
    33522128640.0,
    1323241920.0,
    40840800.0,
    960960.0,
    16380.0,
    182.0,
    1.0,
)
_LARGEST = 1.0


def exponentials(matrices: Matrices) -> Matrices:
    """Return exp of matrices (g, n, n), real or complex, each scaled and squared as its own norm asks for.

    What is not finite gives NaN.
    """
    norms = np.abs(matrices).sum(axis=1).max(axis=1, initial=0.0)
    known = np.isfinite(norms)
    _, powers = np.frexp(np.where(known, norms, 0.0) / _LARGEST)
    squarings = np.maximum(powers, 0)
    scaled = np.where(known[:, None, None], matrices, 0.0) * np.ldexp(1.0, -squarings)[:, None, None]
    unit = np.eye(matrices.shape[1])
    two = scaled @ scaled
    four = two @ two
    six = four @ two
    odd, even = (
        six @ (_PADE[first + 6] * six + _PADE[first + 4] * four + _PADE[first + 2] * two) + rest
        for first, rest in (
            (7, _PADE[7] * six + _PADE[5] * four + _PADE[3] * two + _PADE[1] * unit),
            (6, _PADE[6] * six + _PADE[4] * four + _PADE[2] * two + _PADE[0] * unit),
        )
    )
    odd = scaled @ odd
    found: Matrices = np.linalg.solve(even - odd, even + odd)
    for done in range(int(squarings.max(initial=0))):
        some = squarings > done
        found[some] = found[some] @ found[some]
    found[~known] = np.nan
    return found
