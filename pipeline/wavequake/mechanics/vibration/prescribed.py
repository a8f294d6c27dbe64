"""Prescribed interface motion: what remains free to move, and the static shape that carries the motion."""

import numpy as np
import scipy  # its parts load when first used

from wavequake.errors import UserError
from wavequake.mechanics.model import Array

_DEPENDENT = 1e-9
_MECHANISM = 1e-12


def static_lift(stiffness: Array, rows: Array, name: str) -> tuple[Array, Array]:
    """Eliminate the constraints rows @ q = w: every q that meets them is motions @ z + lift @ w.

    The nine constraints of Störkle 2018, §4.3.2, are three nodes in three directions. Instead of declaring
    dependent coordinates, the null space of the constraints is used, and as particular solution the static
    deformation under w; the two are orthogonal in K.

    Parameters
    ----------
    stiffness : ndarray, shape (n, n)
        Symmetric, in coordinates whose mass matrix is the identity.
    rows : ndarray, shape (c, n)
        Displacements of the prescribed directions.
    name : str
        Of the model, for messages.

    Returns
    -------
    motions : ndarray, shape (n, n - c)
        Orthonormal basis of the null space of `rows`.
    lift : ndarray, shape (n, c)

    Raises
    ------
    UserError
        If the directions are dependent in this model, or leave a motion without stiffness.
    """
    count, size = rows.shape
    if not count:
        return np.eye(size), np.zeros((size, 0))
    if count > size:
        raise UserError(
            f"the model {name} has {size} coordinates, too few to prescribe {count} interface directions"
        )
    orthogonal, triangle = scipy.linalg.qr(rows.T)
    triangle = triangle[:count]
    singular = scipy.linalg.svdvals(triangle)
    if singular[-1] <= _DEPENDENT * singular[0]:
        raise UserError(
            f"the prescribed interface directions are dependent in the model {name}: it cannot move them one "
            "by one; prescribe fewer, or reduce by a method that keeps the interfaces (e.g. craigb36)"
        )
    motions = orthogonal[:, count:]
    particular = orthogonal[:, :count] @ scipy.linalg.solve_triangular(triangle.T, np.eye(count), lower=True)
    remaining = motions.T @ stiffness @ motions
    values, vectors = scipy.linalg.eigh(0.5 * (remaining + remaining.T))
    scale = float(np.abs(stiffness).max())
    if len(values) and values[0] <= _MECHANISM * scale:
        raise UserError(
            f"the prescribed interface directions leave the model {name} "
            f"{int(np.sum(values <= _MECHANISM * scale))} motion(s) without stiffness; prescribe or hold "
            "further directions until no mechanism remains (three nodes in x, y, z always do)"
        )
    static = vectors @ ((vectors.T @ (motions.T @ stiffness @ particular)) / values[:, None])
    return motions, particular - motions @ static
