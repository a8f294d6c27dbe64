"""What a frame loop leaves: exactly by covariances, by an integral over frequency, and step by step.

The time average of the squared residual is the variance within a frame, which no held command can change,
and the variance of the frames' means.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_lyapunov
from scipy.optimize import minimize_scalar

from wavequake.control.frames.controllers import FrameController, integrator, largest_gain
from wavequake.control.frames.disturbance import Sampled
from wavequake.control.linear import Array
from wavequake.errors import UserError

# A pole that a step makes this small has no resonance.
_GONE = 1e-6


def spectral_radius(controller: FrameController) -> float:
    """Return the largest size of an eigenvalue of the closed loop; below 1 it is stable."""
    closed = controller.a - np.outer(controller.b, controller.c)
    return float(np.abs(np.linalg.eigvals(closed)).max())


def residual(disturbance: Sampled, controller: FrameController, noise: float) -> float:
    """Return the rms of the residual over time, from the joint stationary covariance (Lyapunov).

    Raises
    ------
    UserError
        If the loop is unstable.
    """
    radius = spectral_radius(controller)
    if radius >= 1:
        raise UserError(f"The loop is unstable: an eigenvalue of a step has the size {radius:.6g}.")
    count = len(disturbance.phi)
    b = controller.b[:, None]
    step = np.block(
        [
            [disturbance.phi, np.zeros((count, len(b)))],
            [b * disturbance.row, controller.a - b * controller.c],
        ]
    )
    cross = np.outer(disturbance.s, controller.b)
    forced = np.block(
        [[disturbance.q, cross], [cross.T, np.outer(controller.b, controller.b) * (disturbance.r + noise**2)]]
    )
    covariance = solve_discrete_lyapunov(step, forced)
    row = np.concatenate([disturbance.row, -controller.c])
    return float(np.sqrt(row @ covariance @ row + disturbance.r + disturbance.within))


def sensitivity(controller: FrameController, frame: float, hertz: Array) -> tuple[Array, Array]:
    """Return |S|^2 and |T|^2 of frame means at frequencies (f,)."""
    s = error_transfer(controller, frame, hertz)
    return np.abs(s) ** 2, np.abs(1 - s) ** 2


def error_transfer(controller: FrameController, frame: float, hertz: Array) -> NDArray[np.complex128]:
    """Return S at frequencies (f,): det(z - a) / det(z - a + b c), poles of the open loop over the closed."""
    z = np.exp(2j * np.pi * np.asarray(hertz) * frame)[:, None]
    closed = controller.a - np.outer(controller.b, controller.c)
    before, after = np.linalg.eigvals(controller.a), np.linalg.eigvals(closed)
    return np.asarray(np.prod((z - before) / (z - after), axis=1))


def loop_gain(controller: FrameController, frame: float, hertz: Array) -> NDArray[np.complex128]:
    """Return the loop gain c (z - a)^-1 b = 1 / S - 1 at frequencies (f,)."""
    s = error_transfer(controller, frame, hertz)
    return np.asarray((1 - s) / s)


def resonances(controller: FrameController, frame: float) -> tuple[Array, Array]:
    """Return frequencies and half widths, Hz, of the closed loop's poles up to half the rate of frames."""
    closed = controller.a - np.outer(controller.b, controller.c)
    values = np.linalg.eigvals(closed)
    poles = np.log(values[np.abs(values) > _GONE].astype(complex)) / frame / (2 * np.pi)
    poles = poles[poles.imag >= 0]
    return poles.imag, np.abs(poles.real)


def dense_grid(controller: FrameController, frame: float) -> Array:
    """Return rising frequencies up to half the rate of frames, Hz, many about each resonance of a loop."""
    hertz, width = resonances(controller, frame)
    about = (hertz[:, None] + width[:, None] * np.linspace(-6, 6, 241)).ravel()
    high = 0.5 / frame
    between = [np.linspace(0, high, 2001)[1:], np.geomspace(1e-8 * high, high, 1000)]
    return np.unique(np.concatenate([about[(about > 0) & (about <= high)], *between]))


def passed(controller: FrameController, frame: float) -> Callable[[Array], Array]:
    """Return by what a PSD is multiplied to give that of the residual: 1 - sinc^2(f T) (1 - |S|^2)."""

    def factor(hertz: Array) -> Array:
        flat = np.ravel(hertz)
        found: Array = 1 - np.sinc(flat * frame) ** 2 * (1 - sensitivity(controller, frame, flat)[0])
        return found.reshape(np.shape(hertz))

    return factor


def best_gain(disturbance: Sampled, noise: float, frames: int) -> float:
    """Return the gain of the integrator that leaves the least."""
    most = largest_gain(frames)
    found = minimize_scalar(
        lambda gain: residual(disturbance, integrator(gain, frames), noise),
        bounds=(1e-4 * most, (1 - 1e-6) * most),
        method="bounded",
        options={"xatol": 1e-7},
    )
    return float(found.x)


def run(controller: FrameController, readings: Array) -> Array:
    """Return the commands (k,) of a closed loop whose frames have the means and noises (k,) of `readings`.

    The commands of frame k are subtracted from what the sensor would read without them.
    """
    closed = controller.a - np.outer(controller.b, controller.c)
    state = np.zeros(len(controller.a))
    states = np.empty((len(readings), len(state)))
    for place, reading in enumerate(readings):
        states[place] = state
        state = closed @ state + controller.b * reading
    return np.asarray(states @ controller.c)
