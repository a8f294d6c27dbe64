"""Second-order balanced truncation on elastic modal coordinates.

Outputs are displacements where the inputs act (C = B^T), so that the position Gramian of controllability is
the velocity Gramian of observability too, and balancing is the eigenvalue problem of one matrix: the basis is
orthonormal, and the reduced model stays symmetric and stable. The Gramian of a frequency band,

    P = (1 / 2 pi) integral of G(i w) B B^T G(i w)^H over the band and its mirror image,  (Gawronski 1990)

is closed in modal coordinates. Rigid motions have no Gramian; they are split off and kept.
"""

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.model import Array
from wavequake.reduction.directions import turn_equal
from wavequake.reduction.method import Method, Variant, register
from wavequake.reduction.structure import Size, Structure, elastic_modes

Bands = tuple[tuple[float, float, float], ...]


def balanced(body: Structure, count: int, bands: Bands) -> Array:
    """Return the basis of the largest eigenvalues of the position Gramian, shape (n, count).

    Parameters
    ----------
    body : Structure
        Dense.
    count : int
    bands : tuple of (float, float, float)
        Lower and upper frequency in Hz, and weight; empty for all frequencies.
    """
    _, shapes = elastic_modes(body, body.order - body.rigid.shape[1])
    key = ("balanced", bands)
    if key not in body.cache:
        squared, dampings, inputs = oscillators(body)
        energies, turn = np.linalg.eigh(position_gramian(squared, dampings, inputs, bands))
        body.cache[key] = turn_equal(energies[::-1], turn[:, ::-1], inputs.T @ turn[:, ::-1])
    directions: Array = body.cache[key]
    if count > directions.shape[1]:
        raise UserError(f"The model {body.name} has only {directions.shape[1]} elastic coordinates.")
    return shapes @ directions[:, :count]


def oscillators(body: Structure) -> tuple[Array, Array, Array]:
    """Return squared angular frequencies, dampings in 1/s and inputs (m, 3 k) of all elastic modes.

    Raises
    ------
    UserError
        If a mode is not damped: its Gramian is infinite.
    """
    squared, shapes = elastic_modes(body, body.order - body.rigid.shape[1])
    dampings = body.damping.mass + body.damping.stiffness * squared
    if not (dampings > 0).all():
        raise UserError(
            f"Balanced truncation, IRKA and POD need positive damping of every elastic mode, and the model "
            f"{body.name} has none at some; set its Rayleigh damping, or choose craigb, rubin or krylov."
        )
    return squared, dampings, shapes[body.interface].T


def position_gramian(squared: Array, dampings: Array, inputs: Array, bands: Bands) -> Array:
    """Return the position Gramian of oscillators q'' + d q' + w^2 q = b u, shape (m, m).

    Parameters
    ----------
    squared, dampings : ndarray, shape (m,)
        w^2 in rad^2/s^2 and d in 1/s.
    inputs : ndarray, shape (m, p)
    bands : tuple of (float, float, float)
        Lower and upper frequency in Hz, and weight; empty for the integral over all frequencies.
    """
    if not bands:
        total = dampings[:, None] + dampings
        cross = dampings[:, None] * squared + dampings * squared[:, None]
        overlap = total / ((squared[:, None] - squared) ** 2 + total * cross)
    else:
        overlap = np.sum([weight * _overlap(squared, dampings, low, high) for low, high, weight in bands], 0)
    gramian: Array = overlap * (inputs @ inputs.T)
    return gramian


def _overlap(squared: Array, dampings: Array, low: float, high: float) -> Array:
    """(1 / pi) times the real part of the integral of G_i conj(G_j) over a band, by partial fractions."""
    half = dampings / 2
    swing = np.sqrt((squared - half**2).astype(complex))
    # Critical damping is a double pole: step aside so far that it costs 1e-8, by square and by rounding.
    swing = np.where(np.abs(swing) < 1e-4 * half, 1e-4 * half, swing)
    poles = np.stack([-half + 1j * swing, -half - 1j * swing])
    residues = np.stack([1 / (2j * swing), -1 / (2j * swing)])
    logs = -1j * (np.log(2j * np.pi * high - poles) - np.log(2j * np.pi * low - poles))
    result = np.zeros((len(squared), len(squared)))
    for first in range(2):
        for second in range(2):
            a, c = poles[first][:, None], poles[second].conj()
            weights: NDArray[np.complex128] = residues[first][:, None] * residues[second].conj()
            result -= (weights * (logs[first][:, None] + logs[second].conj()) / (a + c)).real
    return result / np.pi


def check_damping(size: Size, variant: Variant) -> None:
    """Refuse a model without damping: energies of its responses are infinite."""
    if size.damping.mass == 0 == size.damping.stiffness:
        raise UserError(
            f"{variant}: balanced truncation, IRKA and POD need positive damping of every elastic mode, and "
            f"the model {size.name} has none; set its Rayleigh damping, or choose craigb, rubin or krylov."
        )


def _basis(body: Structure, variant: Variant, count: int) -> Array:
    return balanced(body, count, variant.bands)


register(Method("bt", _basis, dense=True, check=check_damping))
register(Method("flbt", _basis, arguments="bands", dense=True, check=check_damping))
register(Method("fwbt", _basis, arguments="bands", dense=True, check=check_damping))
