"""Disturbances of rational spectra as filtered white noise, sampled exactly by frames (Van Loan 1978)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, expm, solve_continuous_lyapunov

from wavequake.control.linear import Array

# So many times a disturbance may decay by e within a step.
_DECAYS = 5.0


@dataclass(frozen=True)
class Shaped:
    """d = C x with x' = A x + G w, w white noise of unit (two-sided) intensity.

    Attributes
    ----------
    a, g, c : ndarray, shapes (n, n), (n, p), (n,)
        Time in s.
    """

    a: Array
    g: Array
    c: Array


def wind_shake(amplitude: float, corner_hz: float, mode_hz: float, damping: float) -> Shaped:
    """Return the noise with the one-sided PSD A f^2 / [(1 + (f/f0)^2)^2 |1 + i xi f/f1 - (f/f1)^2|^2].

    It is c s / ((1 + s/w0)^2 (1 + xi s/w1 + (s/w1)^2)) on white noise.
    """
    from scipy.signal import tf2ss  # takes half a second to load, in every worker

    corner, mode = 2 * np.pi * corner_hz, 2 * np.pi * mode_hz
    down = np.polymul(np.polymul([1 / corner, 1], [1 / corner, 1]), [1 / mode**2, damping / mode, 1])
    a, g, c, _ = tf2ss([np.sqrt(amplitude / 2) / (2 * np.pi), 0.0], down)
    return balanced(Shaped(a, g, c[0]))[0]


def line(center_hz: float, fwhm_hz: float, rms: float) -> Shaped:
    """Return an oscillator shaken by white noise: a line of given full width at half maximum and rms."""
    f0, w = center_hz, fwhm_hz
    width = np.sqrt(2 * f0**2 + w**2 - np.sqrt(4 * f0**4 + 2 * w**4))
    return oscillator(f0, 2 * np.pi * width, rms)


def oscillator(hertz: float, rate: float, rms: float) -> Shaped:
    """Return an oscillator x'' + rate x' + omega^2 x that white noise shakes; its rate is 2 zeta omega."""
    omega = 2 * np.pi * hertz
    # x'' + rate x' + omega^2 x = k w has the variance k^2 / (2 rate omega^2).
    k = rms * np.sqrt(2 * rate) * omega
    a = np.array([[0.0, 1.0], [-(omega**2), -rate]])
    return balanced(Shaped(a, np.array([[0.0], [k]]), np.array([1.0, 0.0])))[0]


def joined(parts: Sequence[Shaped]) -> Shaped:
    """Return the sum of independent disturbances."""
    return Shaped(
        block_diag(*(one.a for one in parts)),
        block_diag(*(one.g for one in parts)),
        np.concatenate([one.c for one in parts]),
    )


def balanced(one: Shaped) -> tuple[Shaped, Array]:
    """Scale states to unit variance; returns their sizes (n,) too."""
    sizes = np.sqrt(np.diag(solve_continuous_lyapunov(one.a, -one.g @ one.g.T)))
    return Shaped(one.a * sizes / sizes[:, None], one.g / sizes[:, None], one.c * sizes), sizes


@dataclass(frozen=True)
class Sampled:
    """A disturbance by frames: x' = phi x + w and its mean over the frame m = row x + v.

    Attributes
    ----------
    frame : float
        s.
    phi, row : ndarray, shapes (n, n), (n,)
    q, s, r : ndarray, ndarray, float
        Covariances of w (n, n), of w with v (n,), and of v.
    within : float
        Variance of the disturbance about its mean within a frame.
    variance : float
        Of the disturbance at any instant.
    """

    frame: float
    phi: Array
    row: Array
    q: Array
    s: Array
    r: float
    within: float
    variance: float


def stepped(a: Array, g: Array, seconds: float) -> tuple[Array, Array]:
    """Return the step of x' = A x + G w over a time, and the covariance of its noise, exactly."""
    zero, count = np.zeros_like(a), len(a)
    # What decays within the step would overflow backwards: shorter steps, doubled.
    fastest = float(-np.linalg.eigvals(a).real.min()) * seconds
    doubled = max(int(np.ceil(np.log2(fastest / _DECAYS))), 0) if fastest > 0 else 0
    whole = expm(np.block([[-a, g @ g.T], [zero, a.T]]) * (seconds / 2**doubled))
    step = whole[count:, count:].T
    noise = step @ whole[:count, count:]
    for _ in range(doubled):
        noise, step = step @ noise @ step.T + noise, step @ step
    return step, (noise + noise.T) / 2


def sampled(disturbance: Shaped, frame: float) -> Sampled:
    """Return a disturbance by frames of so many seconds, exactly."""
    count = len(disturbance.a)
    # The integral of d over the frame is one more state, which starts at zero.
    a = np.zeros((count + 1, count + 1))
    a[:count, :count], a[count, :count] = disturbance.a, disturbance.c
    g = np.vstack([disturbance.g, np.zeros((1, disturbance.g.shape[1]))])
    step, noise = stepped(a, g, frame)
    states = solve_continuous_lyapunov(disturbance.a, -disturbance.g @ disturbance.g.T)
    row, r = step[count, :count] / frame, float(noise[count, count]) / frame**2
    variance = float(disturbance.c @ states @ disturbance.c)
    return Sampled(
        frame,
        step[:count, :count],
        row,
        noise[:count, :count],
        noise[:count, count] / frame,
        r,
        variance - float(row @ states @ row) - r,
        variance,
    )
