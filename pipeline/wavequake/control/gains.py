"""Feedback and observer gains by pole placement or optimal for a quadratic cost (Störkle 2018, Fig. 2.2).

States in SI units differ by many orders of magnitude. Equations are solved in units of the states, inputs and
outputs that balance them, and refined there by Newton's iteration, so that gains do not depend on the units.
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.linalg import (
    matrix_balance,
    schur,
    solve_continuous_lyapunov,
    solve_discrete_are,
    solve_discrete_lyapunov,
    solve_triangular,
)

from wavequake.control.linear import Array, LinearModel
from wavequake.control.modes import check_controllable, check_observable, check_stable, grows, modes
from wavequake.errors import UserError

_REFINEMENTS = 3
# Poles farther from where they are wanted, as a share of the largest, are not placed.
_PLACED = 1e-6
# Below, a mode does not show; eigenvalues nearer than this to the unit circle do not decay.
_HIDDEN, _LASTS = 1e-9, 1e-9


def regulator_gain(model: LinearModel, q: ArrayLike, r: ArrayLike) -> Array:
    """Return the linear-quadratic regulator K, u = -K x, (p, n), of a continuous model.

    It minimizes the integral of x' Q x + u' R u.

    Raises
    ------
    UserError
        If a mode that does not decay is not driven, or a weight is of the wrong shape or sign.
    """
    count, inputs = model.b.shape
    weight, cost = _weight(q, count, "Q"), _weight(r, inputs, "R")
    _positive(cost, "R")
    lost = [mode for mode in modes(model, only=grows) if mode.controllability < _HIDDEN]
    if lost:
        raise UserError(f"The regulator cannot be designed: the input does not drive {lost[0]}, which grows.")
    solution = _riccati(model.a, model.b, weight, cost)
    if solution is None or _idles(replace(model, c=weight)):
        raise UserError(
            f"The regulator cannot be designed: {_idle(replace(model, c=weight))} neither decays nor is "
            "weighted; give Q for it."
        )
    gain = np.asarray(np.linalg.solve(cost, model.b.T @ solution), dtype=np.float64)
    check_stable(replace(model, a=model.a - model.b @ gain), "The regulator")
    return gain


def kalman_bucy_gain(model: LinearModel, q: ArrayLike, r: ArrayLike, g: ArrayLike | None = None) -> Array:
    """Return the gain L (n, m) of the stationary Kalman-Bucy filter (Störkle 2018, Eq. 2.16 to 2.23).

    Parameters
    ----------
    model : LinearModel
        Continuous; its outputs are measured.
    q, r : array_like
        Power spectral densities of process noise, (w, w), and of measurement noise, (m, m); numbers stand
        for multiples of the unit matrix.
    g : array_like, shape (n, w), optional
        Input matrix of the process noise; the unit matrix by default.

    Raises
    ------
    UserError
        If a mode that does not decay is not seen, or a density is of the wrong shape or sign.
    """
    count = len(model.a)
    into = np.eye(count) if g is None else np.asarray(g, dtype=np.float64).reshape(count, -1)
    weight, noise = _weight(q, into.shape[1], "Q"), _weight(r, len(model.c), "R")
    _positive(noise, "R")
    lost = [mode for mode in modes(model, only=grows) if mode.observability < _HIDDEN]
    if lost:
        raise UserError(
            f"The filter cannot be designed: the measurement does not see {lost[0]}, which grows."
        )
    shaken = into @ weight @ into.T
    solution = _riccati(model.a.T, model.c.T, shaken, noise)
    hidden = replace(model, a=model.a.T, c=shaken)
    if solution is None or _idles(hidden):
        raise UserError(
            f"The filter cannot be designed: {_idle(hidden)} neither decays nor is shaken; give Q for it."
        )
    gain = np.asarray(np.linalg.solve(noise, model.c @ solution), dtype=np.float64).T
    check_stable(replace(model, a=model.a - gain @ model.c), "The filter")
    return gain


def kalman_gain(a: Array, c: Array, q: ArrayLike, r: ArrayLike) -> Array:
    """Return the gain M (n, m) of the stationary sampled Kalman filter: x := x + M (y - C x), then x := A x.

    Parameters
    ----------
    a, c : ndarray, shapes (n, n), (m, n)
        One step, and the measurement.
    q, r : array_like
        Covariances of process noise per step and of the measurement.

    Raises
    ------
    UserError
        If the Riccati equation has no stabilizing solution: a mode on or outside the unit circle is hidden.
    """
    weight, noise = _weight(q, len(a), "Q"), _weight(r, len(c), "R")
    _positive(noise, "R")
    try:
        solution = _discrete_riccati(a.T, c.T, weight, noise)
    except (np.linalg.LinAlgError, ValueError):
        raise UserError(
            f"The sampled filter cannot be designed: the measurement does not see {_lasting(a, c)}, which "
            "does not decay."
        ) from None
    return np.asarray(np.linalg.solve(c @ solution @ c.T + noise, c @ solution).T, dtype=np.float64)


def placed_regulator(model: LinearModel, poles: Sequence[complex]) -> Array:
    """Return K (p, n) with which A - B K has the given eigenvalues; raises UserError as placed_observer."""
    check_controllable(model)
    return _placed(model.a, model.b, poles)


def placed_observer(model: LinearModel, poles: Sequence[complex]) -> Array:
    """Return L (n, m) with which A - L C has the given eigenvalues.

    Raises
    ------
    UserError
        If a mode is hidden (says which), or the poles are not n in number, conjugate, or too often repeated.
    """
    check_observable(model)
    return _placed(model.a.T, model.c.T, poles).T


def _placed(a: Array, b: Array, poles: Sequence[complex]) -> Array:
    wanted = np.asarray(poles, dtype=np.complex128)
    if len(wanted) != len(a):
        raise UserError(f"{len(wanted)} poles are given; a model of {len(a)} states needs as many.")
    scale = _balance(a, b @ b.T, np.zeros_like(a))
    a, b = a * scale / scale[:, None], b / scale[:, None]
    sizes = np.asarray(np.linalg.norm(b, axis=0), dtype=np.float64)
    b = b / sizes
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that robustness could still grow
            gain = scipy.signal.place_poles(a, b, wanted).gain_matrix
    except ValueError as error:
        raise UserError(f"The poles cannot be placed: {str(error).rstrip('.')}.") from None
    apart = np.abs(wanted[:, None] - np.linalg.eigvals(a - b @ gain))
    pairs = scipy.optimize.linear_sum_assignment(apart)
    missed = float(apart[pairs].max() / np.abs(wanted).max())
    if not missed <= _PLACED:
        raise UserError(
            f"The poles cannot be placed: rounding leaves them off by {missed:.1e} of the largest; give some "
            "that are nearer to those of the model."
        )
    return np.asarray(gain / sizes[:, None] / scale, dtype=np.float64)


def _weight(value: ArrayLike, count: int, name: str) -> Array:
    given = np.asarray(value, dtype=np.float64)
    matrix = given * np.eye(count) if given.ndim == 0 else np.diag(given) if given.ndim == 1 else given
    largest = np.abs(matrix).max(initial=0.0)
    if matrix.shape != (count, count) or np.abs(matrix - matrix.T).max(initial=0.0) > 1e-8 * largest:
        raise UserError(f"{name} must be a number, {count} numbers or a symmetric ({count}, {count}) matrix.")
    matrix = (matrix + matrix.T) / 2.0
    if not np.isfinite(matrix).all() or np.linalg.eigvalsh(matrix)[0] < -1e-12 * largest:
        raise UserError(f"{name} must be finite and without negative eigenvalues.")
    return matrix


def _positive(matrix: Array, name: str) -> None:
    sizes = np.sqrt(np.abs(np.diag(matrix)))
    if not (sizes > 0).all() or np.linalg.eigvalsh(matrix / sizes / sizes[:, None])[0] <= 0:
        raise UserError(f"{name} must be positive definite.")


def _balance(a: Array, g: Array, q: Array) -> Array:
    """Return units t of the states, x = t z, that balance [[A, G], [Q, A']] (Benner 2001)."""
    pencil = np.abs(np.block([[a, g], [q, a.T]]))
    np.fill_diagonal(pencil, 0.0)
    sizes = matrix_balance(pencil, permute=False, separate=True)[1][0]
    count = len(a)
    units: Array = 2.0 ** np.round(np.log2(sizes[:count] / sizes[count:]) / 2.0)
    return units


def _scaled(a: Array, b: Array, q: Array, r: Array) -> tuple[Array, Array, Array, Array]:
    """Return A, B, Q in balanced units with a cost of inputs of 1, and the units of the states."""
    b = solve_triangular(np.linalg.cholesky(r), b.T, lower=True).T
    units = _balance(a, b @ b.T, q)
    return a * units / units[:, None], b / units[:, None], q * units * units[:, None], units


def _idles(model: LinearModel) -> bool:
    """Return whether a mode neither decays nor grows, and the outputs do not see it."""
    lasting = modes(model, only=lambda pole: abs(pole.real) <= _LASTS * abs(pole))
    return any(mode.observability < _HIDDEN for mode in lasting)


def _idle(model: LinearModel) -> str:
    """Name the mode that is nearest to neither decaying nor growing, of those that the outputs hardly see."""
    found = modes(model)
    hidden = [mode for mode in found if mode.observability < _HIDDEN] or found
    return str(min(hidden, key=lambda mode: abs(mode.pole.real)))


def _lasting(a: Array, c: Array) -> str:
    """Name the mode of a sampled model that does not decay and shows least, by its turns per sample."""
    values, vectors = np.linalg.eig(a)
    lasts = np.flatnonzero(np.abs(values) >= np.abs(values).max(initial=0.0).clip(max=1.0) - _LASTS)
    least = lasts[np.linalg.norm(c @ vectors[:, lasts], axis=0).argmin()]
    turns = abs(np.angle(values[least])) / (2 * np.pi)
    return f"the mode of {turns:.4g} turns per sample (eigenvalue of size {abs(values[least]):.6g})"


def _riccati(a: Array, b: Array, q: Array, r: Array) -> Array | None:
    """Return X of A'X + XA - X B R^-1 B' X + Q = 0 with A - B R^-1 B' X stable, by the Schur vectors.

    None: there is none.
    """
    a, b, q, units = _scaled(a, b, q, r)
    count, g = len(a), b @ b.T
    hamiltonian = np.block([[a, -g], [-q, -a.T]])
    try:
        _, vectors, stable = schur(hamiltonian, sort="lhp")
        if stable != count:
            raise np.linalg.LinAlgError
        x = np.linalg.solve(vectors[:count, :count].T, vectors[count:, :count].T)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that a loop hardly decays, which is judged by its poles
            for _ in range(_REFINEMENTS):
                x = (x + x.T) / 2.0
                rest = a.T @ x + x @ a - x @ g @ x + q
                x = x + solve_continuous_lyapunov((a - g @ x).T, -rest)
    except (np.linalg.LinAlgError, ValueError):
        return None
    return np.asarray((x + x.T) / 2.0 / units / units[:, None])


def _discrete_riccati(a: Array, b: Array, q: Array, r: Array) -> Array:
    """Return X of A'XA - X - A'XB (R + B'XB)^-1 B'XA + Q = 0 with a stable closed loop."""
    a, b, q, units = _scaled(a, b, q, r)
    cost = np.eye(b.shape[1])
    x = solve_discrete_are(a, b, (q + q.T) / 2.0, cost)
    for _ in range(_REFINEMENTS):
        x = (x + x.T) / 2.0
        closed = a - b @ np.linalg.solve(cost + b.T @ x @ b, b.T @ x @ a)
        rest = a.T @ x @ closed - x + q
        x = x + solve_discrete_lyapunov(closed.T, rest)
    return np.asarray((x + x.T) / 2.0 / units / units[:, None])
