"""Linear systems with gyroscopic and circulatory forces. SI units.

    M q'' + (D + G) q' + (K + N) q = B u,                    (Störkle 2018, Eq. 2.4, 2.5)

M, D and K are symmetric and those of a model; G and N are skew-symmetric. Gyroscopic forces do no work,
circulatory ones (internal damping of a rotor, bearings, followers) can feed vibration until it is unstable.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, Model
from wavequake.mechanics.vibration.modal import LARGEST, dense
from wavequake.mechanics.vibration.state_space import StateSpace

_ROUNDING = 1e-9


@dataclass(frozen=True)
class LinearSystem:
    """A model and the skew-symmetric forces beside it; made by `linear_system`.

    Attributes
    ----------
    model : FiniteElementModel or ReducedModel
        M, D, K, inputs, nodes and surface, in n coordinates.
    gyroscopic : ndarray, shape (n, n)
        G, N s/m per unit of the coordinates.
    circulatory : ndarray, shape (n, n)
        N, N/m per unit of the coordinates.
    """

    model: Model
    gyroscopic: Array
    circulatory: Array

    @property
    def order(self) -> int:
        """Number n of coordinates."""
        return self.model.order


def linear_system(model: Model, gyroscopic: Any = None, circulatory: Any = None) -> LinearSystem:
    """Return a model with skew-symmetric forces.

    Parameters
    ----------
    model : FiniteElementModel or ReducedModel
        Of at most 3000 coordinates.
    gyroscopic, circulatory : ndarray or sparse array, shape (n, n), optional
        G and N; none if left out.

    Raises
    ------
    UserError
        If the model is too large, or a matrix does not fit, is not finite or not skew-symmetric.
    """
    if model.order > LARGEST:
        raise UserError(
            f"the model {model.name} has {model.order} degrees of freedom; a linear system takes at most "
            f"{LARGEST}: reduce the model first (e.g. craigb108)"
        )
    parts = [
        skew_part(model.name, label, matrix, model.order)
        for label, matrix in (("gyroscopic", gyroscopic), ("circulatory", circulatory))
    ]
    return LinearSystem(model, *parts)


def skew_part(name: str, label: str, matrix: Any, order: int) -> Array:
    """Return a matrix made exactly skew-symmetric, zero for None.

    Raises
    ------
    UserError
        If it does not fit, is not finite, or is not skew-symmetric up to rounding.
    """
    if matrix is None:
        return np.zeros((order, order))
    if np.iscomplexobj(matrix):
        raise UserError(f"the {label} matrix of {name} is complex; it has to be real")
    given = dense(matrix)
    if given.shape != (order, order) or not np.isfinite(given).all():
        raise UserError(
            f"the {label} matrix of {name} must be finite and of shape {(order, order)}; its shape is "
            f"{given.shape}"
        )
    odd = float(np.abs(given + given.T).max(initial=0.0))
    if odd > _ROUNDING * np.abs(given).max(initial=0.0):
        letter, symmetric = ("G", "damping") if label == "gyroscopic" else ("N", "stiffness")
        raise UserError(
            f"the {label} matrix of {name} is not skew-symmetric ({letter} + {letter}^T reaches {odd:.3g}); "
            f"split it by `symmetric_and_skew` and add the symmetric part to the {symmetric}"
        )
    result: Array = 0.5 * (given - given.T)
    return result


def symmetric_and_skew(matrix: Array) -> tuple[Array, Array]:
    """Split velocity- or position-dependent forces into D and G, or K and N (Störkle 2018, Eq. 2.5)."""
    return 0.5 * (matrix + matrix.T), 0.5 * (matrix - matrix.T)


def first_order(system: LinearSystem, rows: Any) -> StateSpace:
    """Return the state space (Störkle 2018, Eq. 2.13) from the inputs of a system to chosen displacements.

    States are the coordinates and their rates.

    Parameters
    ----------
    rows : ndarray or sparse array, shape (m, n)
        Outputs in the coordinates of the model, for example ``system.model.surface``.

    Raises
    ------
    UserError
        If the rows do not fit, a matrix is not finite and symmetric, the mass is singular, or the damping is
        negative.
    """
    count = system.order
    outputs = dense(rows)
    if outputs.ndim != 2 or outputs.shape[1] != count:
        raise UserError(
            f"output rows of shape {outputs.shape} do not fit the {count} coordinates of the model "
            f"{system.model.name}"
        )
    basis, rates, forces = _mass_orthonormal(system)
    inputs = basis @ (basis.T @ dense(system.model.inputs))
    inverse = basis @ basis.T
    a = np.block([[np.zeros((count, count)), np.eye(count)], [-inverse @ forces, -inverse @ rates]])
    b = np.vstack([np.zeros_like(inputs), inputs])
    return StateSpace(
        a, b, np.hstack([outputs, np.zeros_like(outputs)]), np.zeros((len(outputs), b.shape[1]))
    )


def poles(system: LinearSystem) -> NDArray[np.complex128]:
    """Return the 2 n eigenvalues in rad/s, by rising imaginary part; unstable where a real part is positive.

    Raises
    ------
    UserError
        As `first_order`.
    """
    count = system.order
    basis, rates, forces = _mass_orthonormal(system)
    rates, forces = basis.T @ rates @ basis, basis.T @ forces @ basis
    # In units of the highest frequency the matrix is well scaled.
    unit = float(np.sqrt(np.abs(forces).max(initial=0.0))) or float(np.abs(rates).max(initial=0.0)) or 1.0
    companion = np.block([[np.zeros((count, count)), np.eye(count)], [-forces / unit**2, -rates / unit]])
    found: NDArray[np.complex128] = np.asarray(unit * np.linalg.eigvals(companion), dtype=np.complex128)
    return found[np.lexsort((found.real, found.imag))]


def _mass_orthonormal(system: LinearSystem) -> tuple[Array, Array, Array]:
    """Basis T with T^T M T = I, and the forces of velocities D + G and of positions K + N."""
    model = system.model
    matrices = {}
    for label, attribute in (("mass", "mass"), ("damping", "damping_matrix"), ("stiffness", "stiffness")):
        matrix = dense(getattr(model, attribute))
        if not np.isfinite(matrix).all():
            raise UserError(f"the {label} matrix of the model {model.name} has entries that are not finite")
        if np.abs(matrix - matrix.T).max(initial=0.0) > 1e-8 * np.abs(matrix).max(initial=0.0):
            raise UserError(f"the {label} matrix of the model {model.name} is not symmetric")
        matrices[label] = 0.5 * (matrix + matrix.T)
    values = scipy.linalg.eigvalsh(matrices["damping"])
    if len(values) and values[0] < -_ROUNDING * np.abs(values).max():
        raise UserError(
            f"the damping of the model {model.name} is negative in some direction; the damping matrix has to "
            "be positive semi-definite"
        )
    try:
        factor = scipy.linalg.cholesky(matrices["mass"])
    except scipy.linalg.LinAlgError:
        raise UserError(
            f"the mass matrix of the model {model.name} is not positive definite; give every coordinate "
            "a mass"
        ) from None
    basis = scipy.linalg.solve_triangular(factor, np.eye(len(factor)))
    return basis, matrices["damping"] + system.gyroscopic, matrices["stiffness"] + system.circulatory
