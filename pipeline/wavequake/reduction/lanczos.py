"""The lowest modes of large models: block Lanczos on the flexibility.

Grimes, Lewis and Simon, SIAM J. Matrix Anal. Appl. 15 (1994) 228-272, with one shift and without restarts.
Blocks make of triangular solutions and orthogonalizations products of matrices, several times as fast as
those of single vectors.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

Array = NDArray[np.float64]

ACCURACY = 1e-13
"""Largest residual of a mode, as a share of its flexibility."""
# Coordinates per mode: where convergence is looked at first, by what they grow then, how many are too many
# (for few modes, so many blocks more).
_FIRST, _MORE, _MOST, _BLOCKS = 2.5, 1.15, 5.0, 20


def lowest_modes(solve: Callable[[Array], Array], mass: Any, count: int) -> tuple[Array, Array] | None:
    """Return the lowest `count` modes of K x = w^2 M x.

    Parameters
    ----------
    solve : callable
        Maps loads (n, k) to static displacements (n, k).
    mass : sparse array, shape (n, n)
        Symmetric; may be singular.
    count : int

    Returns
    -------
    squared : ndarray, shape (count,)
        Squared angular frequencies, ascending.
    shapes : ndarray, shape (n, count)
        Mass-orthonormal.

    None instead if so few motions have a mass that they are used up before, if modes do not converge, or if
    more modes than a block has vectors are equal and some of them are missing.
    """
    order, block = mass.shape[0], 16 if count > 200 else 8
    basis = np.empty((order, (int(_MOST * count) // block + _BLOCKS) * block), order="F")
    band = np.zeros((basis.shape[1],) * 2)
    size, look = 0, _FIRST * count
    try:
        found = solve(mass @ np.random.default_rng(0).standard_normal((order, block)))
        new, _ = _orthonormal(mass, found)
        while size + block <= basis.shape[1]:
            basis[:, size : size + block] = new
            near, size = max(0, size - block), size + block
            found = solve(mass @ new)
            shares = basis[:, near:size].T @ (mass @ found)
            found -= basis[:, near:size] @ shares
            found -= basis[:, :size] @ (basis[:, :size].T @ (mass @ found))
            band[size - block : size, size - block : size] = (shares[-block:] + shares[-block:].T) / 2
            new, rest = _orthonormal(mass, found)
            if size >= look:
                flexibility, parts = scipy.linalg.eigh(
                    band[:size, :size], subset_by_index=[size - count, size - 1]
                )
                residuals = np.linalg.norm(rest @ parts[-block:], axis=0)
                if (residuals <= ACCURACY * flexibility).all():
                    shapes = basis[:, :size] @ parts[:, ::-1]
                    missing = _most_flexible(solve, mass, shapes, block) > 1.000001 * flexibility[0]
                    return None if missing else (1 / flexibility[::-1], shapes)
                look *= _MORE
            if size + block <= basis.shape[1]:
                band[size : size + block, size - block : size] = rest
                band[size - block : size, size : size + block] = rest.T
    except scipy.linalg.LinAlgError:
        pass
    return None


def _most_flexible(solve: Callable[[Array], Array], mass: Any, shapes: Array, block: int) -> float:
    """Return about the largest flexibility of what is orthogonal to `shapes`: too small, if anything."""
    motion = solve(mass @ np.random.default_rng(1).standard_normal((len(shapes), block)))
    for _ in range(3):
        motion -= shapes @ (shapes.T @ (mass @ motion))
        motion, _ = _orthonormal(mass, motion)
        before, motion = motion, solve(mass @ motion)
    return float(scipy.linalg.eigvalsh(before.T @ (mass @ motion))[-1])


def _orthonormal(mass: Any, block: Array) -> tuple[Array, Array]:
    """Return mass-orthonormal vectors and the triangle that makes the given ones of them."""
    whole = np.eye(block.shape[1])
    for _ in range(2):  # once leaves errors as large as the square of the block's condition
        triangle = scipy.linalg.cholesky(block.T @ (mass @ block))
        block = scipy.linalg.solve_triangular(triangle, block.T, trans=1).T
        whole = triangle @ whole
    return block, whole
