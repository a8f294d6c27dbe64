"""Buckens frame of a free body: rigid motion and deformation that carries no momentum. SI units."""

from dataclasses import dataclass

import numpy as np
import scipy  # its parts load when first used

from wavequake.errors import UserError
from wavequake.mechanics.model import Array, FiniteElementModel, Model, force_columns, rigid_modes, shifts
from wavequake.mechanics.vibration.eigen import rigid_motions
from wavequake.mechanics.vibration.modal import modal_model


@dataclass(frozen=True)
class FloatingFrame:
    """What the frame of reference of a free body needs.

    Attributes
    ----------
    mass : float
        kg.
    center : ndarray, shape (3,)
        Center of mass, m, in which the frame rests.
    inertia : ndarray, shape (3, 3)
        About the center, kg m^2.
    rigid : ndarray, shape (n, 6)
        Coordinates of the model under unit translations and small unit rotations about the center.
    projector : ndarray, shape (6, n)
        Takes coordinates of the model to rigid coordinates.
    """

    mass: float
    center: Array
    inertia: Array
    rigid: Array
    projector: Array


def floating_frame(model: Model) -> FloatingFrame:
    """Return the Buckens frame of a free body.

    In linear motion the mass matrix of Störkle 2018, Eq. 2.11, is then block diagonal: C_t = C_r = 0.

    Raises
    ------
    UserError
        If the body is held somewhere, or a reduced model has fewer than three interface nodes or nodes in
        one line, so that its rotations cannot be told.
    """
    raw = _rigid_shapes(model)
    weighted = np.asarray(model.mass @ raw)
    about_zero = raw.T @ weighted
    total = float(np.trace(about_zero[:3, :3])) / 3
    if np.abs(about_zero[:3, :3] - total * np.eye(3)).max() > 1e-6 * total:
        raise UserError(f"the mass of the model {model.name} differs between x, y and z; it is no free body")
    # The upper right block is -m times the cross product matrix of the center of mass.
    skew = -about_zero[:3, 3:] / total
    center = 0.5 * np.array([skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]])
    # A rotation about the center is one about the origin less the motion of the center: e x (r - c).
    shift = np.cross(np.eye(3), center)
    rigid = raw.copy()
    rigid[:, 3:] -= raw[:, :3] @ shift.T
    weighted = np.asarray(model.mass @ rigid)
    matrix = rigid.T @ weighted
    return FloatingFrame(
        total, center, matrix[3:, 3:], rigid, scipy.linalg.solve(matrix, weighted.T, assume_a="pos")
    )


def split(frame: FloatingFrame, coordinates: Array) -> tuple[Array, Array]:
    """Split motion into rigid coordinates (..., 6) and elastic ones (..., n) without momentum.

    Parameters
    ----------
    coordinates : ndarray, shape (..., n)
        Displacements or velocities in the coordinates of the model.
    """
    rigid = coordinates @ frame.projector.T
    return rigid, coordinates - rigid @ frame.rigid.T


def momentum(frame: FloatingFrame, model: Model, velocity: Array) -> Array:
    """Return linear (N s) and angular momentum about the center (N m s) of velocities (..., n): (..., 6)."""
    result: Array = velocity @ np.asarray(model.mass @ frame.rigid)
    return result


def _rigid_shapes(model: Model) -> Array:
    """Coordinates (n, 6) of unit rigid motions about the origin."""
    if isinstance(model, FiniteElementModel):
        shapes = rigid_motions(model, np.zeros(3))
        strain = np.abs(model.stiffness @ shapes).max() / np.abs(model.stiffness).max()
        if strain > 1e-6:
            raise UserError(f"the body {model.name} is held somewhere; a floating frame needs a free body")
        return shapes
    modal = modal_model(model)
    free = modal.modes[:, modal.free]
    if free.shape[1] != 6:
        raise UserError(
            f"the body {model.name} has {free.shape[1]} motions without stiffness; a floating frame needs a "
            "free body, which has 6"
        )
    points = model.nodes[model.interfaces[shifts(model)]]
    wanted, moved = rigid_modes(points, np.zeros(3)), model.inputs.T[force_columns(model)] @ free
    if np.linalg.matrix_rank(rigid_modes(points, points.mean(axis=0) if len(points) else np.zeros(3))) < 6:
        raise UserError(
            f"the interface nodes of the body {model.name} do not tell its rotations; it needs three "
            "that are not in one line"
        )
    found, *_ = np.linalg.lstsq(moved, wanted)
    if np.abs(moved @ found - wanted).max() > 1e-6 * np.abs(wanted).max():
        raise UserError(f"the free motions of the body {model.name} are not rigid at its interface nodes")
    shapes = free @ found
    return np.asarray(shapes)
