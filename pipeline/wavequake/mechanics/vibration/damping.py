"""Modal damping of reduced models. SI units."""

from dataclasses import replace

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import ArrayLike

from wavequake.errors import UserError
from wavequake.mechanics.model import ReducedModel

# Squares of angular frequencies below this share of the largest are those of rigid modes and not damped.
_ROUNDING = 1e-14


def with_modal_damping(model: ReducedModel, ratios: ArrayLike) -> ReducedModel:
    """Return the model with damping ratios for its own undamped modes, in place of its damping.

    D = sum over modes of 2 zeta_k omega_k (M phi_k)(M phi_k)^T; rigid modes are not damped.

    Parameters
    ----------
    model : ReducedModel
    ratios : float or array_like, shape (r,)
        Damping ratios zeta, one for all modes or one for each by increasing frequency, rigid modes included.

    Raises
    ------
    UserError
        If a ratio is negative or not finite, there are neither one nor r of them, or the mass matrix is
        singular.
    """
    zeta = np.asarray(ratios, dtype=float)
    if zeta.shape not in ((), (model.order,)):
        raise UserError(
            f"{zeta.size} damping ratios are given for {model.name}; give one, or one for each of its "
            f"{model.order} modes"
        )
    if not (np.isfinite(zeta) & (zeta >= 0)).all():
        raise UserError(f"the damping ratios of {model.name} must be finite and not negative")
    try:
        squares, modes = scipy.linalg.eigh(model.stiffness, model.mass)
    except np.linalg.LinAlgError as error:
        raise UserError(
            f"the mass matrix of {model.name} is singular; it must be positive definite"
        ) from error
    squares = np.where(squares > _ROUNDING * squares[-1], squares, 0.0)
    momenta = model.mass @ modes
    return replace(model, damping_matrix=(momenta * (2 * zeta * np.sqrt(squares))) @ momenta.T)
