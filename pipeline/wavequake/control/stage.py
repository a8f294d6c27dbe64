"""The linear stage that carries lens 5, as a transfer function with zeros in the right half plane.

Störkle 2018, Section 5.2.1 and Eq. 5.21.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavequake.control.linear import Array, LinearModel, linear_model
from wavequake.errors import UserError

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Stage:
    """Commanded to actual position: gain Π(1 - s/z) / Π(1 - s/p) e^{-s delay}.

    Attributes
    ----------
    zeros, poles : tuple of complex
        1/s; conjugate where complex.
    gain : float
        For a constant command.
    delay : float
        s, beyond what the zeros stand for.
    """

    zeros: tuple[complex, ...] = (1000.0, 480 + 850j, 480 - 850j)
    poles: tuple[complex, ...] = (-377.0, -360 + 293j, -360 - 293j)
    gain: float = 0.97
    delay: float = 0.0

    def __post_init__(self) -> None:
        if len(self.zeros) > len(self.poles):
            raise UserError(f"The stage has {len(self.zeros)} zeros, more than its {len(self.poles)} poles.")
        if not all(np.real(pole) < 0 for pole in self.poles):
            raise UserError("The stage is unstable: the real part of every pole must be negative.")
        if 0 in self.zeros or not (np.isfinite(self.gain) and self.gain != 0 and self.delay >= 0):
            raise UserError(
                "The stage needs zeros and a gain other than 0, and a delay that is not negative."
            )
        for roots in (self.zeros, self.poles):
            if np.abs(np.imag(np.poly(roots))).max() > 1e-9 * np.abs(np.poly(roots)).max():
                raise UserError("The stage's complex zeros and poles must come in conjugate pairs.")


def stage_response(stage: Stage, s: ArrayLike) -> Complex:
    """Return the transfer function at complex frequencies in 1/s, any shape."""
    at = np.asarray(s, dtype=np.complex128)
    up = np.prod([1 - at / zero for zero in stage.zeros], axis=0)
    down = np.prod([1 - at / pole for pole in stage.poles], axis=0)
    return np.asarray(stage.gain * up / down * np.exp(-at * stage.delay))


def low_frequency_delay(stage: Stage) -> float:
    """Return the time by which slow motion lags, s: of zeros, poles and pure delay."""
    lag = sum(1 / zero for zero in stage.zeros) - sum(1 / pole for pole in stage.poles)
    return float(np.real(lag)) + stage.delay


def numerator_and_denominator(stage: Stage) -> tuple[Array, Array]:
    """Return the polynomials in s, highest power first; the denominator ends in 1."""
    down = np.real(np.poly(stage.poles))
    up = np.real(np.poly(stage.zeros))
    return stage.gain * up / up[-1], down / down[-1]


def stage_model(stage: Stage) -> LinearModel:
    """Return the stage without its pure delay as a state space, in units in which its states are alike."""
    up, down = numerator_and_denominator(stage)
    return _companion(up, down)


def all_pass_inverse(stage: Stage) -> LinearModel:
    """Return the approximate inverse of Eq. 5.21: zeros in the right half plane become mirrored poles.

    Its product with the stage is an all-pass of gain 1, which lags by 2 Σ 1/z, and by the stage's pure delay.

    Raises
    ------
    UserError
        If the stage has fewer zeros than poles: its inverse would differentiate.
    """
    if len(stage.zeros) < len(stage.poles):
        raise UserError(
            f"A stage of {len(stage.zeros)} zeros and {len(stage.poles)} poles has no proper inverse; "
            "identify it with as many zeros as poles."
        )
    mirrored = tuple(-zero if np.real(zero) > 0 else zero for zero in stage.zeros)
    _, down = numerator_and_denominator(replace(stage, zeros=mirrored))
    up, _ = numerator_and_denominator(replace(stage, zeros=mirrored, gain=1.0))
    return _companion(down / stage.gain, up)


def _companion(up: Array, down: Array) -> LinearModel:
    """Return up(s) / down(s) in controllable form; time is scaled so that coefficients are of order 1."""
    order = len(down) - 1
    unit = float((down[-1] / down[0]) ** (1 / order))  # geometric mean of the poles, 1/s
    powers = unit ** np.arange(order, -1, -1.0)
    bottom = down * powers / (down[0] * powers[0])
    top = np.concatenate([np.zeros(order + 1 - len(up)), up]) * powers / (down[0] * powers[0])
    a = np.vstack([-bottom[1:], np.eye(order - 1, order)])
    c = top[1:] - top[0] * bottom[1:]
    return linear_model(unit * a, unit * np.eye(order, 1), c[None], np.array([[top[0]]]))


def scaling(signal: tuple[float, float], position: tuple[float, float]) -> tuple[float, float]:
    """Return gain and offset that take normalized input values to positions (Eq. 5.7, 5.8).

    Parameters
    ----------
    signal : (float, float)
        Least and largest normalized value, e.g. 5.5 and 27.5 for 0.55 V to 2.75 V.
    position : (float, float)
        Least and largest position.

    Raises
    ------
    UserError
        If the range of the signal is empty.
    """
    if not signal[1] > signal[0]:
        raise UserError(f"The range of the signal, {signal[0]} to {signal[1]}, is empty.")
    gain = (position[1] - position[0]) / (signal[1] - signal[0])
    return gain, position[1] - gain * signal[1]
