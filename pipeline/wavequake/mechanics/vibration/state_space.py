"""Linear state space of a mechanical model, as control software takes it (Störkle 2018, Eq. 2.13, 2.14)."""

from typing import NamedTuple

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.model import Array
from wavequake.mechanics.vibration.modal import ModalModel


class StateSpace(NamedTuple):
    """x' = A x + B u, y = C x + D u; unpacks as ``scipy.signal.StateSpace(*system)``.

    So it does for python-control: ``control.ss(*system)``.
    ``a`` (s, s), ``b`` (s, p), ``c`` (m, s), ``d`` (m, p); SI units.
    """

    a: Array
    b: Array
    c: Array
    d: Array


def state_space(modal: ModalModel, rows: Array) -> StateSpace:
    """Return the state space from the inputs of a model to chosen displacements.

    States are modal positions x and velocities x' - G1 u (free modes and non-proportional damping included),
    so prescribed displacements enter without their derivatives: the system is proper.

    Parameters
    ----------
    modal : ModalModel
        r modes, p inputs.
    rows : ndarray or sparse array, shape (m, n)
        Outputs in the coordinates of the model, for example ``model.surface`` or ``model.inputs.T``.

    Returns
    -------
    StateSpace
        Of order 2 r.

    Raises
    ------
    UserError
        If the rows do not fit the model.
    """
    count = len(modal.squared)
    if rows.ndim != 2 or rows.shape[1] != len(modal.modes):
        raise UserError(
            f"output rows of shape {rows.shape} do not fit the {len(modal.modes)} coordinates of the model "
            f"{modal.name}"
        )
    a = np.block([[np.zeros((count, count)), np.eye(count)], [-np.diag(modal.squared), -modal.damping]])
    b = np.vstack([modal.input_rates, modal.inputs - modal.damping @ modal.input_rates])
    shapes = np.asarray(rows @ modal.modes)
    return StateSpace(a, b, np.hstack([shapes, np.zeros_like(shapes)]), np.asarray(rows @ modal.lift))
