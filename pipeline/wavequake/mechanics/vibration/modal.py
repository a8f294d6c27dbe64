"""Modal form of a linear model: oscillators, free modes and the static part. SI units.

With u the inputs, forces or prescribed displacements, the displacements are q = Phi x + L u, where

    x'' + D x' + Omega^2 x = G0 u + G1 u'.

The inertia of prescribed motion is absorbed into x, so no second derivative of it occurs: an abrupt start
needs no infinite acceleration, and a sampled motion no numerical differentiation.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, Model
from wavequake.mechanics.vibration.prescribed import static_lift

Flags = NDArray[np.bool_]

LARGEST = 3000
_ROUNDING = 1e-12


@dataclass(frozen=True)
class ModalModel:
    """Oscillators of a model whose p inputs are forces or prescribed displacements.

    Attributes
    ----------
    name : str
    squared : ndarray, shape (r,)
        Squares of the undamped angular frequencies, rad^2/s^2, increasing; exactly 0 for free modes.
    damping : ndarray, shape (r, r)
        D in modal coordinates, 1/s; diagonal where the damping is proportional.
    inputs, input_rates : ndarray, shape (r, p)
        G0 and G1.
    modes : ndarray, shape (n, r)
        Phi in the coordinates of the model, normalized to unit modal mass.
    lift : ndarray, shape (n, p)
        L; zero in the columns of forces.
    prescribed : ndarray of bool, shape (p,)
        Which inputs are displacements in m; the others are forces in N.
    """

    name: str
    squared: Array
    damping: Array
    inputs: Array
    input_rates: Array
    modes: Array
    lift: Array
    prescribed: Flags

    @property
    def free(self) -> Flags:
        """Which modes have no stiffness, shape (r,)."""
        flags: Flags = self.squared == 0.0
        return flags


def dense(matrix: Any) -> Array:
    """Return a dense copy of a matrix, dense or sparse."""
    return np.array(matrix.toarray() if hasattr(matrix, "toarray") else matrix, dtype=np.float64)


def modal_model(model: Model, prescribed: Flags | None = None) -> ModalModel:
    """Transform a model to coordinates in which its time response is a set of small recurrences.

    Parameters
    ----------
    model : FiniteElementModel or ReducedModel
        Of at most 3000 coordinates.
    prescribed : ndarray of bool, shape (3 k,), optional
        Interface directions whose displacement is given (Störkle 2018, §4.3.2: all nine of three nodes).
        The others carry forces. None: forces only.

    Raises
    ------
    UserError
        If the model is too large, its matrices are not finite and symmetric, its mass is not positive
        definite, its stiffness or damping is negative, or the prescribed directions are dependent or leave a
        mechanism.
    """
    if not isinstance(model, Model):
        raise UserError(
            f"oscillators are made of a symmetric model, not of a {type(model).__name__}; gyroscopic and "
            "circulatory forces go through the state space of `first_order`"
        )
    count = model.inputs.shape[1]
    chosen = np.zeros(count, dtype=bool) if prescribed is None else np.asarray(prescribed)
    if chosen.shape != (count,) or chosen.dtype != bool:
        raise UserError(f"the model {model.name} needs one flag for each of its {count} interface directions")
    mass, damping, stiffness, inputs = _matrices(model)
    # In mass-orthonormal coordinates all that follows is a matter of orthogonal matrices.
    basis = _mass_orthonormal(mass, model.name)
    stiffness, damping, inputs = basis.T @ stiffness @ basis, basis.T @ damping @ basis, basis.T @ inputs
    motions, static = static_lift(stiffness, inputs[:, chosen].T, model.name)
    squared, turn = _eigen(motions.T @ stiffness @ motions, float(np.abs(stiffness).max()), model.name)
    modes = motions @ turn
    rates = modes.T @ damping @ modes
    _check_damping(rates, model.name)
    lift = np.zeros((len(basis), count))
    lift[:, chosen] = static
    carried = modes.T @ lift
    return ModalModel(
        model.name,
        squared,
        rates,
        np.where(chosen, 0.0, modes.T @ inputs) + squared[:, None] * carried,
        rates @ carried - modes.T @ damping @ lift,
        basis @ modes,
        basis @ (lift - modes @ carried),
        chosen,
    )


def _matrices(model: Model) -> tuple[Array, Array, Array, Array]:
    """Dense copies of mass, damping, stiffness (made exactly symmetric) and inputs, after checks."""
    if model.mass.shape[0] > LARGEST:
        raise UserError(
            f"the model {model.name} has {model.mass.shape[0]} degrees of freedom; a time response needs all "
            f"of its modes and takes at most {LARGEST}: reduce the model first (e.g. craigb108)"
        )
    symmetric = []
    for label in ("mass", "damping_matrix", "stiffness"):
        matrix = dense(getattr(model, label))
        if not np.isfinite(matrix).all():
            raise UserError(f"the {label} of the model {model.name} has entries that are not finite")
        if np.abs(matrix - matrix.T).max() > 1e-8 * np.abs(matrix).max():
            raise UserError(f"the {label} of the model {model.name} is not symmetric")
        symmetric.append(0.5 * (matrix + matrix.T))
    return symmetric[0], symmetric[1], symmetric[2], dense(model.inputs)


def _mass_orthonormal(mass: Array, name: str) -> Array:
    """Basis T with T^T M T = I."""
    try:
        factor = scipy.linalg.cholesky(mass)
    except scipy.linalg.LinAlgError:
        raise UserError(
            f"the mass matrix of the model {name} is not positive definite; give every coordinate a mass"
        ) from None
    inverse: Array = scipy.linalg.solve_triangular(factor, np.eye(len(factor)))
    return inverse


def _eigen(stiffness: Array, scale: float, name: str) -> tuple[Array, Array]:
    squared, vectors = scipy.linalg.eigh(0.5 * (stiffness + stiffness.T))
    if len(squared) and squared[0] < -1e3 * _ROUNDING * scale:
        raise UserError(
            f"the stiffness of the model {name} is negative in some direction, so the model is unstable; "
            "it has to be positive semi-definite"
        )
    squared[squared < _ROUNDING * scale] = 0.0
    return squared, vectors


def _check_damping(rates: Array, name: str) -> None:
    values = scipy.linalg.eigvalsh(rates) if rates.size else np.zeros(1)
    if values[0] < -1e-9 * np.abs(values).max():
        raise UserError(
            f"the damping of the model {name} is negative in some direction, so its vibration would grow; "
            "the damping matrix has to be positive semi-definite"
        )
