"""Identify the stage's transfer function from a step response by instrumental variables.

Störkle 2018, Section 5.2.1; the refined instrumental variables of Young and Jakeman 1980 for continuous time.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from wavequake.control.linear import Array, linear_model, zero_order_hold
from wavequake.control.stage import Stage
from wavequake.errors import UserError

Filters = Callable[[Array], Array]

# Iterations end when no coefficient moves by more than this share.
_SETTLED, _ITERATIONS = 1e-6, 60


@dataclass(frozen=True)
class IdentifiedStage:
    """A stage and how well it explains the record: 1 - var(error)/var(position)."""

    stage: Stage
    fit: float


def smoothed(signal: Array, step: float, cutoff_hz: float = 100.0, order: int = 5) -> Array:
    """Return a measured signal without its noise above a cutoff, by a Butterworth filter run both ways."""
    if not 0 < cutoff_hz < 0.5 / step:
        raise UserError(
            f"The cutoff {cutoff_hz:g} Hz must lie below half the sampling rate, {0.5 / step:g} Hz."
        )
    sections = scipy.signal.butter(order, cutoff_hz, fs=1 / step, output="sos")
    return np.asarray(scipy.signal.sosfiltfilt(sections, signal))


def identify_stage(
    command: Array, position: Array, step: float, *, poles: int = 3, zeros: int = 3, start: float = 300.0
) -> IdentifiedStage:
    """Identify a transfer function of given numbers of poles and zeros.

    The equation A(s) y = B(s) u is filtered by 1/A, so that it holds for the signals' derivatives without
    differentiating, and its unknowns are found with the modeled output in place of the noisy one as
    instrument: unlike least squares, that is unbiased by measurement noise.

    Parameters
    ----------
    command, position : ndarray, shape (k,)
        From rest, held over each step; any unit of length, the same for both.
    step : float
        Sampling interval, s.
    poles, zeros : int
        zeros at most poles.
    start : float
        Bandwidth of the first filter, rad/s: about that of the stage.

    Raises
    ------
    UserError
        If the record does not fit, does not excite the stage, or the search does not settle on a stable one.
    """
    if command.shape != position.shape or len(command) < 10 * (poles + zeros):
        raise UserError(
            f"A command of {command.shape} and a position of {position.shape} samples do not identify "
            f"{poles} poles and {zeros} zeros."
        )
    if not (np.isfinite(command).all() and np.isfinite(position).all()) or np.ptp(command) == 0:
        raise UserError("The step response must be finite, and its command must move.")
    if not 0 <= zeros <= poles:
        raise UserError(f"{zeros} zeros do not go with {poles} poles.")
    unit = start  # time in units of 1/start keeps the coefficients of one size
    down = np.real(np.poly(-np.ones(poles)))
    unknowns = None
    for _ in range(_ITERATIONS):
        filters = _states(down, step * unit)
        u, y = filters(command), filters(position)  # (poles + 1, k), derivatives 0..poles
        regressors = np.concatenate([-y[:poles], u[: zeros + 1]])
        modeled = (
            regressors if unknowns is None else _instruments(unknowns, filters, command, step * unit, poles)
        )
        try:
            found = np.linalg.solve(modeled @ regressors.T, modeled @ y[poles])
        except np.linalg.LinAlgError:
            raise UserError("The command does not excite the stage enough to identify it.") from None
        moved = np.inf if unknowns is None else np.abs(found - unknowns).max() / np.abs(found).max()
        unknowns = found
        down = _stable(np.concatenate([[1.0], found[poles - 1 :: -1]]))
        if moved < _SETTLED:
            break
    else:
        raise UserError(
            f"The identification did not settle in {_ITERATIONS} iterations; give a longer record."
        )
    up = unknowns[: poles - 1 : -1]
    roots = (_paired(unit * np.roots(up)), _paired(unit * np.roots(down)))
    stage = Stage(*roots, gain=float(up[-1] / down[-1]))
    error = position - _output(up, down, command, step * unit)
    return IdentifiedStage(stage, float(1 - error.var() / position.var()))


def _states(down: Array, step: float) -> Filters:
    """Return a function that gives the derivatives 0..n of a signal, filtered by 1/down(s) of degree n."""
    order = len(down) - 1
    a = np.vstack([-down[1:], np.eye(order - 1, order)]) if order > 1 else -down[None, 1:]
    model = zero_order_hold(
        linear_model(a, np.eye(order, 1), np.vstack([a[0], np.eye(order)]), np.eye(order + 1, 1)), step
    )
    up, bottom = scipy.signal.ss2tf(model.a, model.b, model.c, model.d)

    def derivatives(signal: Array) -> Array:
        return np.asarray([scipy.signal.lfilter(row, bottom, signal) for row in up[::-1]])

    return derivatives


def _output(up: Array, down: Array, command: Array, step: float) -> Array:
    derivatives = _states(down, step)(command)
    return np.asarray(up[::-1] @ derivatives[: len(up)])


def _instruments(unknowns: Array, filters: Filters, command: Array, step: float, poles: int) -> Array:
    down = _stable(np.concatenate([[1.0], unknowns[poles - 1 :: -1]]))
    noiseless = filters(_output(unknowns[: poles - 1 : -1], down, command, step))
    return np.concatenate([-noiseless[:poles], filters(command)[: len(unknowns) - poles]])


def _stable(down: Array) -> Array:
    """Mirror unstable roots: a filter must decay."""
    roots = np.roots(down)
    return np.asarray(np.real(np.poly(np.where(roots.real < 0, roots, -roots.conj()))))


def _paired(roots: NDArray[np.number]) -> tuple[complex, ...]:
    """Return roots as complex numbers, real ones as real, conjugate ones exactly so, in a fixed order."""
    values = [complex(root) for root in np.atleast_1d(roots)]
    real = sorted(v.real for v in values if abs(v.imag) <= 1e-9 * abs(v))
    upper = sorted((v for v in values if v.imag > 1e-9 * abs(v)), key=lambda v: (v.real, v.imag))
    return (*(complex(v) for v in real), *(w for v in upper for w in (v, v.conjugate())))
