"""Undamped eigenmodes of a sparse model: rigid modes exactly, elastic ones by shift-invert; SI units."""

from collections.abc import Callable

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.model import FiniteElementModel, rigid_modes
from wavequake.mechanics.vibration.factors import factorize

Array = NDArray[np.float64]

# Twice the energy of a rigid motion of 1 m of a free body is a sum of rounding errors: 1e-16 of the norm of
# the stiffness matrix, 1e-10 where a file has 10 digits. Springs that are softer in sum count as none.
RIGID = 1e-10
# Squared period of motions without mass, as a share of the longest one.
MASSLESS = 1e-13
# Smallest eigenvalue, over the diagonal, of a mass matrix by which one may divide.
SINGULAR = 1e-11
# Below this order all modes are computed densely.
DENSE = 200


def rigid_motions(model: FiniteElementModel, origin: Array) -> Array:
    """Return the degrees of freedom of unit rigid motions about `origin`, shape (n, 6), m and rad.

    Inner coordinates, which belong to no node, take the values that strain the body least.

    Raises
    ------
    UserError
        If inner coordinates have no stiffness.
    """
    per_node = np.zeros((len(model.nodes), 6, 6))
    per_node[:, :3] = rigid_modes(model.nodes, origin).reshape(-1, 3, 6)
    per_node[:, 3:, 3:] = np.eye(3)
    known = model.dof_node >= 0
    motions = np.zeros((model.order, 6))
    motions[known] = per_node[model.dof_node[known], model.dof_direction[known]]
    inner = np.flatnonzero(~known)
    if len(inner):
        forces = (model.stiffness @ motions)[inner]
        motions[inner] = -factorize(model.stiffness[inner][:, inner]).solve(forces)
    return motions


def mass_normalized_rigid_modes(model: FiniteElementModel) -> Array:
    """Return the rigid motions that strain nothing, shape (n, r) with r from 0 (held) to 6 (free).

    They are orthonormal with respect to the mass matrix: translations along x, y and z first, then rotations.
    """
    spread = model.nodes[model.dof_node[model.dof_node >= 0]]
    center = spread.mean(axis=0)
    length = float(np.abs(spread - center).max()) or 1.0
    motions = rigid_motions(model, center) / np.array([1.0] * 3 + [length] * 3)
    energies, combinations = np.linalg.eigh(motions.T @ (model.stiffness @ motions))
    free = combinations[:, energies <= RIGID * scipy.sparse.linalg.norm(model.stiffness)]
    if free.shape[1] == 6:
        free = np.eye(6)
    basis = motions @ free
    # A chain that moves along x alone has one translation and no rotation.
    moves = np.abs(basis).max(axis=0, initial=0.0) > 1e-12
    basis = basis[:, moves]
    gram = basis.T @ (model.mass @ basis)
    return np.asarray(
        scipy.linalg.solve_triangular(scipy.linalg.cholesky(gram, lower=True), basis.T, lower=True).T
    )


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
    held = scipy.linalg.qr(rigid.T, mode="r", pivoting=True)[1][: rigid.shape[1]]
    free = np.delete(np.arange(model.order), held)
    factors = factorize(model.stiffness[free][:, free], definite=True)
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
    operator = scipy.sparse.linalg.LinearOperator(
        (model.order, model.order), matvec=flexibility, dtype=np.float64
    )
    start = _start(model.order)
    start -= rigid @ (rigid.T @ (model.mass @ start))
    _, modes = scipy.sparse.linalg.eigsh(
        model.stiffness, k=wanted, M=model.mass, sigma=0.0, OPinv=operator, v0=start, which="LM", tol=1e-13
    )
    # The Rayleigh-Ritz values on the true matrix forgive what rounding left at the held degrees of freedom.
    squares, combinations = scipy.linalg.eigh(
        modes.T @ (model.stiffness @ modes), modes.T @ (model.mass @ modes)
    )
    return squares, modes @ combinations


def _dense(model: FiniteElementModel, rigid: Array, wanted: int) -> tuple[Array, Array]:
    # All that is orthogonal to the rigid modes, as an orthonormal basis.
    basis = (
        scipy.linalg.qr(model.mass @ rigid)[0][:, rigid.shape[1] :] if rigid.shape[1] else np.eye(model.order)
    )
    squares, modes = dense_modes(basis.T @ (model.stiffness @ basis), basis.T @ (model.mass @ basis), wanted)
    heavy = int((squares < 0.5 * squares[0] / MASSLESS).sum()) if squares[0] > 0 else wanted
    if heavy < wanted:
        raise UserError(f"{wanted} elastic modes of {model.name} are wanted; only {heavy} have a mass")
    return squares, basis @ modes


def dense_modes(stiffness: Array, mass: Array, wanted: int | None = None) -> tuple[Array, Array]:
    """Return squared angular frequencies, ascending, and mass-normalized modes of K x = w^2 M x.

    Motions without mass count as if they had the share `MASSLESS` of the most there is: their frequencies are
    far above all others, and their flexibility is right.

    Parameters
    ----------
    stiffness, mass : ndarray, shape (n, n)
        Where the mass is singular the stiffness must be positive definite.
    wanted : int, optional
        How many; all where left out.

    Raises
    ------
    UserError
        If a motion has neither mass nor stiffness.
    """
    scale = 1.0 / np.sqrt(np.maximum(mass.diagonal(), MASSLESS * mass.diagonal().max()))
    if scipy.linalg.eigvalsh(mass * scale[:, None] * scale, subset_by_index=(0, 0))[0] > SINGULAR:
        squares, modes = scipy.linalg.eigh(
            stiffness, mass, subset_by_index=None if wanted is None else (0, min(wanted, len(mass)) - 1)
        )
        return squares, modes
    try:
        inverse, shapes = scipy.linalg.eigh(mass, stiffness)
    except np.linalg.LinAlgError as error:
        raise UserError("mass and stiffness are singular together: a motion has neither") from error
    squared_periods = np.maximum(inverse, MASSLESS * inverse[-1])[::-1][:wanted]
    return 1.0 / squared_periods, shapes[:, ::-1][:, :wanted] / np.sqrt(squared_periods)
