"""Linear models to python-control and back: its Bode and Nyquist plots, root loci, margins, other designs."""

from importlib import import_module
from typing import Any

import numpy as np

from wavequake.control.linear import LinearModel, linear_model
from wavequake.errors import UserError


def to_control(model: LinearModel) -> Any:
    """Return a model as a ``control.StateSpace``, continuous or with its sample time.

    Raises
    ------
    UserError
        If python-control is not installed.
    """
    try:
        # By name, and not before it is needed: python-control loads Matplotlib.
        control = import_module("control")
    except ImportError:
        raise UserError("python-control is not installed; run: pip install control") from None
    return control.ss(model.a, model.b, model.c, model.d, model.sample_time or 0)


def from_control(system: Any) -> LinearModel:
    """Return a ``control.StateSpace`` as a linear model; ``control.ss`` makes one of a transfer function.

    Raises
    ------
    UserError
        If it is no state space, is sampled at no stated time, or has entries that are not finite.
    """
    if not all(hasattr(system, name) for name in "ABCD"):
        raise UserError(
            f"A state space of python-control is needed, not {type(system).__name__}; "
            "control.ss makes one of a transfer function."
        )
    if system.dt is True:
        raise UserError("The system is sampled but does not say how often; give control.ss the time step.")
    a, b, c, d = (np.asarray(getattr(system, name)) for name in "ABCD")
    return linear_model(a, b, c, d, system.dt or None)
