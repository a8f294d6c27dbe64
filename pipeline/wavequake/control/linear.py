"""Linear models x' = A x + B u, y = C x + D u, continuous or sampled (Störkle 2018, Eq. 2.13 to 2.15)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm, lu_factor, lu_solve

from wavequake.errors import UserError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LinearModel:
    """A linear time-invariant model of n states, p inputs and m outputs.

    Attributes
    ----------
    a, b, c, d : ndarray, shapes (n, n), (n, p), (m, n), (m, p)
    sample_time : float or None
        In s; None is continuous.
    """

    a: Array
    b: Array
    c: Array
    d: Array
    sample_time: float | None = None


def linear_model(
    a: ArrayLike, b: ArrayLike, c: ArrayLike, d: ArrayLike | None = None, sample_time: float | None = None
) -> LinearModel:
    """Check the matrices of a model and return it; takes ``*state_space(...)`` of the mechanics.

    Raises
    ------
    UserError
        If a shape does not fit, or a value is not finite.
    """
    square = np.atleast_2d(np.asarray(a, dtype=np.float64))
    states = len(square)
    into = np.asarray(b, dtype=np.float64).reshape(states, -1) if np.size(b) else np.zeros((states, 0))
    out = np.atleast_2d(np.asarray(c, dtype=np.float64))
    if square.shape != (states, states) or out.shape[1] != states:
        raise UserError(f"A has shape {square.shape} and C {out.shape}; (n, n) and (m, n) are needed.")
    shape = (len(out), into.shape[1])
    through = np.zeros(shape) if d is None else np.asarray(d, dtype=np.float64)
    if through.size != shape[0] * shape[1]:
        raise UserError(f"D has shape {through.shape}; C and B ask for {shape}.")
    for name, matrix in (("A", square), ("B", into), ("C", out), ("D", through)):
        if not np.isfinite(matrix).all():
            raise UserError(f"{name} has entries that are not finite.")
    return LinearModel(square, into, out, through.reshape(shape), sample_time)


def second_order_model(
    mass: Array, damping: Array, stiffness: Array, inputs: Array, rows: Array
) -> LinearModel:
    """Return M q'' + D q' + K q = B u, y = rows q as a model of states (q, q') (Eq. 2.13, 5.16).

    Raises
    ------
    UserError
        If the mass matrix is singular.
    """
    count = len(mass)
    if np.linalg.matrix_rank(mass) < count:
        raise UserError("The mass matrix is singular; every coordinate needs a mass or inertia.")
    solved = np.linalg.solve(mass, np.hstack([-stiffness, -damping, np.reshape(inputs, (count, -1))]))
    a = np.block([[np.zeros((count, count)), np.eye(count)], [solved[:, : 2 * count]]])
    b = np.vstack([np.zeros((count, solved.shape[1] - 2 * count)), solved[:, 2 * count :]])
    return linear_model(a, b, np.hstack([np.atleast_2d(rows), np.zeros((len(np.atleast_2d(rows)), count))]))


def in_units(model: LinearModel, time: float, inputs: float, outputs: float) -> LinearModel:
    """Return a continuous model in other units of time, input and output, each given in the present one."""
    return LinearModel(model.a * time, model.b * time * inputs, model.c / outputs, model.d * inputs / outputs)


def poles(model: LinearModel) -> NDArray[np.complex128]:
    """Return the eigenvalues of A, in 1/s (or of one step, if sampled)."""
    return np.asarray(np.linalg.eigvals(model.a), dtype=np.complex128)


def spectral_radius(model: LinearModel) -> float:
    """Return the largest magnitude of a sampled model's eigenvalues; at 1 and above it does not settle."""
    return float(np.abs(poles(model)).max(initial=0.0))


def frequency_response(model: LinearModel, omega: ArrayLike) -> NDArray[np.complex128]:
    """Return the transfer matrix at angular frequencies in rad/s, (f, m, p) (Eq. 2.15)."""
    s = np.asarray(1j * np.atleast_1d(np.asarray(omega)), dtype=np.complex128)
    if model.sample_time is not None:
        s = np.asarray(np.exp(s * model.sample_time), dtype=np.complex128)
    resolvent = np.linalg.solve(s[:, None, None] * np.eye(len(model.a)) - model.a, model.b.astype(complex))
    return np.asarray(model.c @ resolvent + model.d, dtype=np.complex128)


def zero_order_hold(model: LinearModel, sample_time: float) -> LinearModel:
    """Sample a continuous model whose input is held over each step; exact, A may be singular."""
    phi, hold, _ = _integrals(model, sample_time)
    return LinearModel(phi, hold, model.c, model.d, sample_time)


def first_order_hold(model: LinearModel, sample_time: float) -> LinearModel:
    """Sample a continuous model whose input runs straight between samples; exact.

    The states are x_k - G2 u_k, with which the model needs no future input.
    """
    phi, hold, ramp = _integrals(model, sample_time)
    return LinearModel(phi, hold - ramp + phi @ ramp, model.c, model.d + model.c @ ramp, sample_time)


def bogacki_shampine(model: LinearModel, sample_time: float) -> LinearModel:
    """Sample a continuous model as the fixed-step solver "ode3" does, input held over each step.

    A third-order Runge-Kutta step of a linear system is the Taylor polynomial of its exponential; it is
    unstable if the step is too long.
    """
    _check_step(model, sample_time)
    step, unit = sample_time * model.a, np.eye(len(model.a))
    mean = unit + step / 2 + step @ step / 6
    return LinearModel(unit + step @ mean, sample_time * mean @ model.b, model.c, model.d, sample_time)


def _check_step(model: LinearModel, sample_time: float) -> None:
    if model.sample_time is not None:
        raise UserError("The model is sampled already; a continuous one is needed.")
    if not (np.isfinite(sample_time) and sample_time > 0):
        raise UserError(f"The sample time is {sample_time} s; it must be positive.")


def _integrals(model: LinearModel, step: float) -> tuple[Array, Array, Array]:
    """Return e^{A h} and the responses of the states to a held input and to one that rises from 0 to 1."""
    _check_step(model, step)
    n, p = model.b.shape
    block = np.zeros((n + 2 * p, n + 2 * p))
    block[:n, :n], block[:n, n : n + p] = model.a * step, model.b * step
    block[n : n + p, n + p :] = np.eye(p)
    whole = expm(block)
    return whole[:n, :n], whole[:n, n : n + p], whole[:n, n + p :]


def in_series(first: LinearModel, second: LinearModel) -> LinearModel:
    """Return the model that feeds the outputs of `first` to the inputs of `second`."""
    if len(first.c) != second.b.shape[1] or first.sample_time != second.sample_time:
        raise UserError(
            f"{len(first.c)} outputs at {first.sample_time} s do not fit {second.b.shape[1]} inputs at "
            f"{second.sample_time} s."
        )
    zeros = np.zeros((len(first.a), len(second.a)))
    return LinearModel(
        np.block([[first.a, zeros], [second.b @ first.c, second.a]]),
        np.vstack([first.b, second.b @ first.d]),
        np.hstack([second.d @ first.c, second.c]),
        second.d @ first.d,
        first.sample_time,
    )


def static_gain(model: LinearModel) -> Array:
    """Return the response to a constant input, (m, p).

    Raises
    ------
    UserError
        If the model integrates.
    """
    a = -model.a if model.sample_time is None else np.eye(len(model.a)) - model.a
    if np.linalg.matrix_rank(a) < len(a):
        raise UserError("The model integrates: a constant input has no constant answer.")
    gain: Array = model.c @ lu_solve(lu_factor(a), model.b) + model.d
    return gain


def simulate(model: LinearModel, inputs: ArrayLike, start: Sequence[float] | None = None) -> Array:
    """Return the outputs (k, m) of a sampled model for inputs (k, p), from rest or from states `start`."""
    if model.sample_time is None:
        raise UserError("A continuous model cannot be stepped; sample it, e.g. with zero_order_hold.")
    given = np.asarray(inputs, dtype=np.float64).reshape(-1, model.b.shape[1])
    state = np.zeros(len(model.a)) if start is None else np.asarray(start, dtype=np.float64)
    states = np.empty((len(given), len(state)))
    driven = given @ model.b.T
    for k in range(len(given)):
        states[k] = state
        state = model.a @ state + driven[k]
    return np.asarray(states @ model.c.T + given @ model.d.T)
