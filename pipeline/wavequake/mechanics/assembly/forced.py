"""What a plant answers to loads that are given over time, from rest: exact for straight lines."""

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.model import Array
from wavequake.mechanics.vibration.state_space import state_space

Complex = NDArray[np.complex128]

_SERIES = 0.3  # below this |z| the functions of the exponential are summed as series
_TERMS = 16


def forced(plant: Plant, rows: Array, loads: Array, time: Array) -> Array:
    """Return the outputs (n, m) at any instants under loads that are joined by straight lines.

    Before the first row nothing acts, and all is at rest; after the last one its loads stay. The states of
    the plant are decoupled once, and every line is solved exactly for each of them.

    Parameters
    ----------
    plant : Plant
    rows : ndarray, shape (k,)
        Instants of the rows, s, increasing.
    loads : ndarray, shape (k, p)
        Of all inputs: N, N m, and the floor's m and rad.
    time : ndarray, shape (n,)
        s, in any order.
    """
    a, b, *_ = state_space(plant.modal, np.zeros((0, len(plant.modal.modes))))
    count = len(plant.modal.squared)
    scale = np.concatenate([plant.omega, np.ones(count)])  # positions as large as velocities
    rates, shapes = np.linalg.eig(scale[:, None] * a / scale)
    shares = scipy.linalg.solve(shapes, scale[:, None] * b)
    drive = loads @ shares.T  # (k, s)
    steps = np.diff(rows)
    states = np.zeros((len(rows), len(rates)), dtype=np.complex128)
    for row, step in enumerate(steps):
        states[row + 1] = _onward(rates, states[row], drive[row], (drive[row + 1] - drive[row]) / step, step)
    place = np.clip(np.searchsorted(rows, time, side="right") - 1, 0, len(rows) - 1)
    slopes = np.concatenate([np.diff(drive, axis=0) / steps[:, None], np.zeros((1, len(rates)))])
    away = np.maximum(time - rows[place], 0.0)
    found = _onward(rates, states[place], drive[place], slopes[place], away[:, None])
    moved = (found @ shapes.T).real[:, :count] / plant.omega
    now = np.stack([np.interp(time, rows, column, left=0.0) for column in loads.T], axis=1)
    on = (time >= rows[0])[:, None]
    return np.asarray((moved * on) @ plant.shapes.T + now @ plant.carried.T)


def _onward(rates: Complex, states: Complex, drive: Complex, slopes: Complex, step: Array | float) -> Complex:
    """Return the states after a step in which the drive grows evenly: z' = rate z + drive + slope t."""
    z = rates * step
    first, second = _phi(z)
    return np.asarray(np.exp(z) * states + step * first * drive + step**2 * second * slopes)


def _phi(z: Complex) -> tuple[Complex, Complex]:
    """Return (exp(z) - 1) / z and (exp(z) - 1 - z) / z²."""
    small = np.abs(z) < _SERIES
    safe = np.where(small, 1.0, z)
    first = np.where(small, 0.0, np.expm1(safe) / safe)
    second = np.where(small, 0.0, (first - 1.0) / safe)
    term = np.where(small, 0.5 + 0.0j, 0.0)  # z^k / (k + 2)!
    tiny = np.where(small, z, 0.0)
    for k in range(_TERMS):
        second = second + term
        term = term * tiny / (k + 3)
    return np.where(small, 1.0 + tiny * second, first), second
