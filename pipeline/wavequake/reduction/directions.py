"""Orthonormal directions in an order that rounding does not choose.

A basis of a given order keeps the first of its directions, so their order must come from the model. Symmetric
bodies have pairs of equal frequency or strength, of which every turned pair is as good for an eigenvalue
solver: such pairs are turned to where the interface sees them, its first coordinates first.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.mechanics.model import Array

# Values nearer than this part of themselves are equal: meshes of threefold symmetry reach 1e-10, modes of
# different shape are rarely nearer than 1e-4.
_EQUAL = 1e-6


def turn_equal(values: Array, vectors: NDArray[Any], seen: NDArray[Any]) -> NDArray[Any]:
    """Return vectors with those of equal value turned: what is seen best comes first.

    Rows of `seen` count 1, 1/2, 1/3, ..., which tells the two of a pair apart that are seen equally well.

    Parameters
    ----------
    values : ndarray, shape (m,)
        Monotonic: squared frequencies, strengths or energies.
    vectors : ndarray, shape (n, m)
    seen : ndarray, shape (p, m)
        What an observer has of every vector, for instance the motion of the interface.
    """
    equal = np.abs(np.diff(values)) <= _EQUAL * np.abs(values[1:])
    result = vectors.copy()
    weights = 1.0 / np.sqrt(np.arange(1.0, len(seen) + 1.0))[:, None]
    for group in np.split(np.arange(len(values)), np.flatnonzero(~equal) + 1):
        if len(group) > 1:
            turn = np.linalg.svd(weights * seen[:, group])[2].conj().T
            result[:, group] = vectors[:, group] @ turn
    return result


def orthonormalize(
    mass: Any, vectors: NDArray[Any], against: NDArray[Any] | None = None, least: float = 1e-8
) -> NDArray[Any]:
    """Return a mass-orthonormal basis of vectors, without what `against` spans already.

    Parameters
    ----------
    mass : csc_array or ndarray, shape (n, n)
    vectors : ndarray, shape (n, m)
    against : ndarray, shape (n, l), optional
        Mass-orthonormal.
    least : float
        Directions weaker than this part of the longest vector are left out, as rounding errors hide them.
    """
    if vectors.shape[1]:
        vectors = vectors / _norms(mass, vectors).max()
    for tolerance in (least**2, 1e-2):
        # Twice is enough: the second pass removes what rounding left in the first.
        if against is not None:
            vectors = vectors - against @ (against.conj().T @ (mass @ vectors))
        weights, turn = np.linalg.eigh(vectors.conj().T @ (mass @ vectors))
        keep = np.flatnonzero(weights > tolerance)[::-1]
        vectors = vectors @ (turn[:, keep] / np.sqrt(weights[keep]))
    return vectors


def _norms(mass: Any, vectors: NDArray[Any]) -> Array:
    norms: Array = np.sqrt(np.einsum("ij,ij->j", vectors.conj(), mass @ vectors).real)
    return norms
