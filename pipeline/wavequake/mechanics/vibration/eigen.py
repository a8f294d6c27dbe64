"""Undamped eigenmodes of a sparse model: rigid modes exactly, elastic ones by shift-invert; SI units."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, eigh, qr, solve_triangular
from scipy.sparse import csc_array
from scipy.sparse.linalg import LinearOperator, eigsh, norm, splu

from wavequake.errors import UserError
from wavequake.mechanics.model import FiniteElementModel, rigid_modes

Array = NDArray[np.float64]

# Twice the energy of a rigid motion of 1 m of a free body is a sum of rounding errors: 1e-16 of the norm of
# the stiffness matrix, 1e-10 where a file has 10 digits. Springs that are softer in sum count as none.
RIGID = 1e-10
# Below this order all modes are computed densely.
DENSE = 200


def factorize(matrix: csc_array) -> Any:
    """Return the sparse LU factors of a symmetric matrix, ordered for symmetry.

    Three to five times as fast as the defaults of SciPy, which are made for unsymmetric matrices.

    Raises
    ------
    UserError
        If the matrix is singular.
    """
    try:
        return splu(
            matrix.tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.01,
            options={"SymmetricMode": True},
        )
    except RuntimeError as error:
        raise UserError(
            "a stiffness matrix is singular; the model has parts that hang together with nothing, or "
            "constrained degrees of freedom left in it as zero rows"
        ) from error


def mass_normalized_rigid_modes(model: FiniteElementModel) -> Array:
    """Return the rigid motions that strain nothing, shape (n, r) with r from 0 (held) to 6 (free).

    They are orthonormal with respect to the mass matrix: translations along x, y and z first, then rotations.
    """
    spread = model.nodes[model.dof_node]
    center = spread.mean(axis=0)
    length = float(np.abs(spread - center).max()) or 1.0
    rows = 3 * model.dof_node + model.dof_direction
    motions = rigid_modes(model.nodes, center)[rows] / np.array([1.0] * 3 + [length] * 3)
    energies, combinations = np.linalg.eigh(motions.T @ (model.stiffness @ motions))
    free = combinations[:, energies <= RIGID * norm(model.stiffness)]
    if free.shape[1] == 6:
        free = np.eye(6)
    basis = motions @ free
    # A chain that moves along x alone has one translation and no rotation.
    moves = np.abs(basis).max(axis=0, initial=0.0) > 1e-12
    basis = basis[:, moves]
    gram = basis.T @ (model.mass @ basis)
    return np.asarray(solve_triangular(cholesky(gram, lower=True), basis.T, lower=True).T)


def elastic_flexibility(model: FiniteElementModel, rigid: Array) -> Callable[[Array], Array]:
    """Return the function that maps forces (n,) or (n, k) to elastic displacements.

    The forces are balanced by the inertia of the rigid modes (inertia relief), and the displacements are
    orthogonal to these with respect to the mass. The body is held in as many well-spread degrees of freedom
    as it has rigid modes, so nothing is shifted and nothing is lost near 0 Hz.

    Parameters
    ----------
    model : FiniteElementModel
    rigid : ndarray, shape (n, r)
        Orthonormal with respect to the mass.
    """
    held = qr(rigid.T, mode="r", pivoting=True)[1][: rigid.shape[1]]
    free = np.delete(np.arange(model.order), held)
    factors = factorize(model.stiffness[free][:, free])
    momenta = model.mass @ rigid

    def flexibility(forces: Array) -> Array:
        displacements = np.zeros_like(forces)
        displacements[free] = factors.solve((forces - momenta @ (rigid.T @ forces))[free])
        return np.asarray(displacements - rigid @ (momenta.T @ displacements))

    return flexibility


def eigenmodes(model: FiniteElementModel, count: int) -> tuple[Array, Array]:
    """Return the lowest eigenfrequencies and modes of the undamped model.

    Parameters
    ----------
    model : FiniteElementModel
    count : int
        Number of modes, the rigid ones included.

    Returns
    -------
    frequencies : ndarray, shape (count,)
        Hz, ascending; exactly 0 for rigid modes.
    modes : ndarray, shape (n, count)
        Orthonormal with respect to the mass. Their sign and, for equal frequencies, their rotation are
        arbitrary but the same in every run.

    Raises
    ------
    UserError
        If the model has fewer than `count` degrees of freedom, its stiffness is indefinite, or a matrix is
        singular beyond rigid modes.
    """
    if not 1 <= count <= model.order:
        raise UserError(f"{count} modes of {model.name} are wanted; it has {model.order} degrees of freedom")
    rigid = mass_normalized_rigid_modes(model)
    wanted = count - rigid.shape[1]
    if wanted <= 0:
        return np.zeros(count), rigid[:, :count]
    if model.order <= DENSE or 2 * wanted > model.order:
        squares, elastic = _dense(model, rigid, wanted)
    else:
        squares, elastic = _sparse(model, rigid, wanted)
    if squares[0] < 0:
        raise UserError(
            f"the stiffness matrix of {model.name} is not positive semi-definite (an eigenvalue is "
            f"{squares[0]:.3g} 1/s^2); it must be the one of the undeformed, unloaded body"
        )
    start = _start(model.order)
    elastic = elastic * np.where(start @ elastic < 0, -1.0, 1.0)
    frequencies = np.concatenate([np.zeros(rigid.shape[1]), np.sqrt(squares) / (2 * np.pi)])
    return frequencies, np.hstack([rigid, elastic])


def _start(order: int) -> Array:
    return np.random.default_rng(0).standard_normal(order)


def _sparse(model: FiniteElementModel, rigid: Array, wanted: int) -> tuple[Array, Array]:
    flexibility = elastic_flexibility(model, rigid)
    operator = LinearOperator((model.order, model.order), matvec=flexibility, dtype=np.float64)
    start = _start(model.order)
    start -= rigid @ (rigid.T @ (model.mass @ start))
    _, modes = eigsh(
        model.stiffness, k=wanted, M=model.mass, sigma=0.0, OPinv=operator, v0=start, which="LM", tol=1e-13
    )
    # The Rayleigh-Ritz values on the true matrix forgive what rounding left at the held degrees of freedom.
    squares, combinations = eigh(modes.T @ (model.stiffness @ modes), modes.T @ (model.mass @ modes))
    return squares, modes @ combinations


def _dense(model: FiniteElementModel, rigid: Array, wanted: int) -> tuple[Array, Array]:
    # All that is orthogonal to the rigid modes, as an orthonormal basis.
    basis = qr(model.mass @ rigid)[0][:, rigid.shape[1] :] if rigid.shape[1] else np.eye(model.order)
    try:
        squares, modes = eigh(
            basis.T @ (model.stiffness @ basis),
            basis.T @ (model.mass @ basis),
            subset_by_index=(0, wanted - 1),
        )
    except np.linalg.LinAlgError as error:
        raise UserError(
            f"the mass matrix of {model.name} is singular; it must be positive definite"
        ) from error
    return squares, basis @ modes
