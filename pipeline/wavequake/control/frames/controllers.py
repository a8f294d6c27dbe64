"""Controllers of a frame loop: integrator and Kalman predictor (LQG of a mirror that is a pure delay).

In frame k the sensor sees e_k, the mean of disturbance minus command over the frame, with noise. The command
c_k is held over frame k; with a delay of n frames it knows e up to e_(k-n); n = 1: a frame acts in the next.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_discrete_are

from wavequake.control.frames.disturbance import Sampled
from wavequake.control.linear import Array, LinearModel
from wavequake.errors import UserError


@dataclass(frozen=True)
class FrameController:
    """c_k = c s_k, s_(k+1) = a s_k + b e_k."""

    a: Array
    b: Array
    c: Array


def largest_gain(frames: int) -> float:
    """Return the gain at which an integrator of n frames delay becomes unstable, 2 sin(pi/(2(2n-1)))."""
    return float(2 * np.sin(np.pi / (2 * (2 * frames - 1))))


def integrator_pole(gain: float, frames: int) -> complex:
    """Return the largest pole of an integrator's loop of n frames delay, z^n - z^(n-1) + gain = 0."""
    powers = np.zeros(frames + 1)
    powers[0] = 1.0
    powers[1] -= 1.0
    powers[-1] += gain
    poles = np.roots(powers)
    return complex(poles[np.abs(poles).argmax()])


def integrator(gain: float, frames: int) -> FrameController:
    """Return c_k = c_(k-1) + gain e_(k-n).

    Raises
    ------
    UserError
        If the loop is unstable, or the delay is not a whole number of frames of at least 1.
    """
    _check(frames)
    if not 0 < gain < largest_gain(frames):
        raise UserError(
            f"An integrator of gain {gain:g} with {frames} frames of delay is unstable; give it a gain "
            f"between 0 and {largest_gain(frames):.6g}."
        )
    # States: the errors that wait, the newest first, then the command.
    a, b, c = np.eye(frames, k=-1), np.zeros(frames), np.zeros(frames)
    a[-1, -2:] = [gain, 1.0][-frames:]
    b[0] = gain if frames == 1 else 1.0
    c[-1] = 1.0
    return FrameController(a, b, c)


def predictor(known: Sampled, noise: float, frames: int) -> FrameController:
    """Return the optimal controller: the mean over frame k is predicted from all frames up to k - n.

    Parameters
    ----------
    known : Sampled
        What the controller believes of the disturbance.
    noise : float
        Standard deviation of the sensor's noise per frame; above 0.
    frames : int

    Raises
    ------
    UserError
        If the noise is not positive, or the delay is not a whole number of frames of at least 1.
    """
    _check(frames)
    gain = filter_gain(known, noise)
    count, waiting = len(known.phi), frames - 1
    size = count + waiting
    c = np.zeros(size)
    c[:count] = known.row @ np.linalg.matrix_power(known.phi, waiting)
    # States: the estimate one frame after the last reading in it, then readings e + c that wait.
    a, b = np.zeros((size, size)), np.zeros(size)
    a[:count, :count] = known.phi - np.outer(gain, known.row)
    if waiting:
        a[:count, -1] = gain
        a[count, :] = c
        a[count + 1 :, count:-1] = np.eye(waiting - 1)
        b[count] = 1.0
    else:
        a[:count] += np.outer(gain, c)
        b[:count] = gain
    return FrameController(a, b, c)


def filter_gain(known: Sampled, noise: float) -> Array:
    """Return the gain (n,) of the Kalman predictor of a disturbance whose frame means are read with noise.

    Raises
    ------
    UserError
        If the noise is not positive, or the equation cannot be solved in double precision.
    """
    if not (np.isfinite(noise) and noise > 0):
        raise UserError(f"The noise of the sensor is {noise:g}; a filter needs a positive one.")
    row, seen = known.row[:, None], known.r + noise**2
    try:
        p = solve_discrete_are(known.phi.T, row, known.q, np.array([[seen]]), s=known.s[:, None])
    except (ValueError, np.linalg.LinAlgError):
        raise UserError(
            "The filter's equation is too ill-conditioned to be solved; expect wider or faster lines, or "
            "read less often."
        ) from None
    return np.asarray((known.phi @ p @ known.row + known.s) / (known.row @ p @ known.row + seen))


def plant_and_controller(
    controller: FrameController, frames: int, frame: float
) -> tuple[LinearModel, LinearModel]:
    """Return a loop as models by frames: a plant that is the delay alone, z^-n, and the controller before it.

    A controller of n frames delay is c (z - a)^-1 b with c a^j b = 0 for j < n - 1, so that
    z^n c (z - a)^-1 b = c a^n (z - a)^-1 b + c a^(n-1) b. Their product is the loop gain.

    Parameters
    ----------
    controller : FrameController
    frames : int
        n, its delay.
    frame : float
        s.
    """
    unit = np.eye(frames)
    plant = LinearModel(np.eye(frames, k=-1), unit[:, :1], unit[-1:], np.zeros((1, 1)), frame)
    row = controller.c @ np.linalg.matrix_power(controller.a, frames - 1)
    b = controller.b[:, None]
    return plant, LinearModel(controller.a, b, (row @ controller.a)[None], (row @ b)[None], frame)


def _check(frames: int) -> None:
    if frames != int(frames) or frames < 1:
        raise UserError(f"The delay is {frames} frames; it must be a whole number of at least 1.")
