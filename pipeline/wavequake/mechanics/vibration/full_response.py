"""The transfer matrix of a finite-element model at a complex frequency: a sparse factorization, no modes."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from wavequake.mechanics.model import Array, FiniteElementModel
from wavequake.mechanics.vibration.factors import factorize

Complex = NDArray[np.complex128]


def dynamic_response(
    model: FiniteElementModel, s: complex, inputs: Array, rows: Array
) -> tuple[Complex, Complex]:
    """Return rows (K + s D + s^2 M)^-1 inputs and its derivative by s.

    Parameters
    ----------
    model : FiniteElementModel
    s : complex
        1/s, no pole of the model.
    inputs : ndarray, shape (n, p)
        Forces, N per unit input.
    rows : ndarray, shape (m, n)
        Outputs.

    Returns
    -------
    response, slope : ndarray of complex, shape (m, p)
    """
    alpha, beta = model.damping.mass, model.damping.stiffness
    dynamic = csc_array((1 + beta * s) * model.stiffness + (alpha * s + s * s) * model.mass)
    solved = factorize(dynamic).solve(np.hstack([inputs, rows.T]).astype(np.complex128))
    moved, back = solved[:, : inputs.shape[1]], solved[:, inputs.shape[1] :]
    slope = beta * (model.stiffness @ moved) + (alpha + 2 * s) * (model.mass @ moved)
    return np.asarray(rows @ moved), np.asarray(-back.T @ slope)
