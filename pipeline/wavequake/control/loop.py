"""Controllers on free runs: commands, motion of the stage, image that is left (Störkle 2018, Eq. 5.5).

The stage carries lens 5 alone and does not shake the chain, which swings the same under all controllers.
"""

import numpy as np
import scipy

from wavequake.control.bench import COMPENSATOR, SENSITIVITIES
from wavequake.control.hammer import HAMMER, Hammer, step_means
from wavequake.control.linear import Array, zero_order_hold
from wavequake.control.sensor import quantized_command
from wavequake.control.stage import Stage, stage_model
from wavequake.control.thesis import SampledController
from wavequake.errors import UserError

# The stage is followed on this grid; delays of the control unit are multiples of it.
FINE_STEP = 1e-4


def run_thesis(controller: SampledController, measured: Array, hammer: Hammer = HAMMER) -> Array:
    """Return commands (c, k) in m for measured positions (c, k) at the controller's instants.

    The trigger at the first sample tells the controller of the blow, whose course is known beforehand (Eq.
    5.9): it takes the mean force of each step, which a held input must be for no momentum to come too early.
    """
    force = step_means(hammer, controller.sample_time, measured.shape[1])
    state = np.zeros((len(controller.a), len(measured)))
    commands = np.empty_like(measured)
    # A product and a sum over axis 1, not a matrix product: its bits do not depend on the number of columns.
    a, b = controller.a[:, :, None], controller.b[:, :1]
    pushed = np.outer(force, controller.b[:, 1])
    for k in range(measured.shape[1]):
        y = measured[:, k]
        commands[:, k] = (controller.c[:, None] * state).sum(axis=0) + controller.d[0] * y
        state = (a * state).sum(axis=1) + b * y + pushed[k][:, None]
    return np.asarray(commands + controller.d[1] * force)


def stage_motion(
    stage: Stage, commands: Array, sample_time: float, compute_delay: float, step: float, count: int
) -> Array:
    """Return positions (..., count) of the stage in m, `step` s apart, for commands (..., k) in m.

    Raises
    ------
    UserError
        If a time is no multiple of 0.1 ms.
    """
    delay = compute_delay + stage.delay
    every, late, kept = (_multiple(value) for value in (sample_time, delay, step))
    model = zero_order_hold(stage_model(stage), FINE_STEP)
    up, down = scipy.signal.ss2tf(model.a, model.b, model.c, model.d)
    held = np.repeat(quantized_command(commands), every, axis=-1)
    shape = (*held.shape[:-1], late)
    shifted = np.concatenate([np.zeros(shape), held], axis=-1)
    missing = (count - 1) * kept + 1 - shifted.shape[-1]
    if missing > 0:
        shifted = np.concatenate([shifted, np.repeat(shifted[..., -1:], missing, axis=-1)], axis=-1)
    moved = scipy.signal.lfilter(up[0], down, shifted, axis=-1)
    return np.asarray(moved[..., : (count - 1) * kept + 1 : kept])


def _multiple(value: float) -> int:
    whole = round(value / FINE_STEP)
    if abs(whole * FINE_STEP - value) > 1e-9:
        raise UserError(f"A time of {1e3 * value:g} ms is no multiple of {1e3 * FINE_STEP:g} ms.")
    return whole


def remaining_image(free: Array, stage: Array) -> Array:
    """Return the image motion a = a_F + s_5 y_M, m (Eq. 5.5)."""
    return np.asarray(free + SENSITIVITIES[COMPENSATOR] * stage)


def peak_to_peak(image: Array) -> Array:
    """Return the range of image motion over time, (...)."""
    return np.asarray(np.ptp(image, axis=-1))


def late_deviation(image: Array, time: Array, after: float = 1.0) -> Array:
    """Return the standard deviation of image motion later than `after` s, as in Störkle 2018, Fig. 5.33."""
    late = time > after
    if not late.any():
        raise UserError(f"The run ends at {time[-1]:g} s; the standard deviation is taken after {after:g} s.")
    return np.asarray(image[..., late].std(axis=-1))
