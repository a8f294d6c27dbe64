"""Gain, phase and delay margins of a loop of frames."""

import numpy as np
from scipy.optimize import brentq

from wavequake.control.frames.controllers import FrameController
from wavequake.control.frames.residual import dense_grid, error_transfer, spectral_radius
from wavequake.control.linear import Array
from wavequake.control.robustness.margins import Margins
from wavequake.errors import UserError

# Factors of the gain that are tried, up and down; beyond them a margin does not matter.
_FACTORS = np.geomspace(1.0, 1e3, 600)
# Below, an eigenvalue of an integrator that is switched off lies on the circle by rounding alone.
_ROUNDING = 1e-9


def frame_margins(controller: FrameController, frame: float) -> Margins:
    """Return the margins of a stable loop with frames of so many seconds; delay in s, frequencies in rad/s.

    Raises
    ------
    UserError
        If the loop is unstable.
    """
    if spectral_radius(controller) >= 1:
        raise UserError("The loop is unstable: it has no margins.")
    hertz = dense_grid(controller, frame)

    def gain(at: float) -> complex:
        s = complex(error_transfer(controller, frame, np.array([at]))[0])
        return (1 - s) / s

    s = error_transfer(controller, frame, hertz)
    sizes = np.abs((1 - s) / s) - 1
    crossings = [
        float(brentq(lambda at: abs(gain(at)) - 1, hertz[one], hertz[one + 1], rtol=1e-13))
        for one in np.flatnonzero(np.sign(sizes[1:]) != np.sign(sizes[:-1]))
    ]
    late = np.array([np.angle(-gain(at)) % (2 * np.pi) for at in crossings])
    omega = 2 * np.pi * np.array(crossings)
    peak = int(np.abs(s).argmax())
    return Margins(
        float(np.abs(s[peak])),
        2 * np.pi * float(hertz[peak]),
        _factor(controller, _FACTORS, np.inf),
        _factor(controller, 1 / _FACTORS, 0.0),
        float(np.minimum(late, 2 * np.pi - late).min(initial=np.pi)),
        float((late / omega).min(initial=np.inf)),
        float(omega.max(initial=0.0)),
    )


def _factor(controller: FrameController, factors: Array, none: float) -> float:
    """Return the first of rising or falling factors of the gain at which the loop becomes unstable."""

    def excess(factor: float) -> float:
        scaled = FrameController(controller.a, controller.b, factor * controller.c)
        return spectral_radius(scaled) - 1

    last = float(factors[0])
    for factor in map(float, factors[1:]):
        if excess(factor) > _ROUNDING:
            return float(brentq(excess, last, factor, rtol=1e-13))
        last = factor
    return none
