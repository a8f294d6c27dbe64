"""Sampled controllers of many channels: what is decoupled first, and a filter of every group of channels."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from wavequake.control.linear import Array, LinearModel


@dataclass(frozen=True)
class Regulator:
    """u_k = c x_k + d z_k, x_(k+1) = a x_k + b z_k, z = W y, for each of G groups of channels.

    Most controllers first decouple readings into one number per actuator channel, and then have one filter
    for all of them: matrices with a leading 1 are those of every group.

    Attributes
    ----------
    decoupling : ndarray, shape (G i, m)
        W.
    a, b, c, d : ndarray, shapes (G or 1, n, n), (G or 1, n, i), (G or 1, o, n), (G or 1, o, i)
        p = G o commands.
    """

    decoupling: Array
    a: Array
    b: Array
    c: Array
    d: Array

    @property
    def groups(self) -> int:
        """G."""
        return len(self.decoupling) // int(self.b.shape[2])

    @property
    def shared(self) -> bool:
        """Whether it is one filter of one input and one output for all channels."""
        return len(self.a) == 1 and self.b.shape[2] == self.c.shape[1] == 1


@dataclass(frozen=True)
class Stepped:
    """A controller that is a function: of states (n, cases) and readings (m, cases), to states and commands.

    A case's numbers may depend on nothing but its own column.
    """

    states: int
    function: Callable[[Array, Array], tuple[Array, Array]]


@dataclass(frozen=True)
class Instant:
    """A controller that puts actuators at -W y without delay, error or limit, W (p, m)."""

    decoupling: Array


def shared_filter(decoupling: Array, model: LinearModel) -> Regulator:
    """Return a filter of one input and one output for every row of a decoupling (p, m)."""
    return Regulator(decoupling, model.a[None], model.b[None], model.c[None], model.d[None])


def whole(model: LinearModel) -> Regulator:
    """Return a controller that is given by its matrices, readings to commands."""
    unit = np.eye(model.b.shape[1])
    return Regulator(unit, model.a[None], model.b[None], model.c[None], model.d[None])


def start(regulator: Regulator | Stepped, cases: int) -> Array:
    """Return the states (..., cases) at rest."""
    if isinstance(regulator, Stepped):
        return np.zeros((regulator.states, cases))
    return np.zeros((regulator.groups, regulator.a.shape[1], cases))


def advance(regulator: Regulator | Stepped, states: Array, readings: Array) -> tuple[Array, Array]:
    """Return the states after a reading (m, cases), and the commands (p, cases)."""
    if isinstance(regulator, Stepped):
        return regulator.function(states, readings)
    cases = readings.shape[1]
    z = (regulator.decoupling @ readings).reshape(regulator.groups, -1, cases)
    commands = np.matmul(regulator.c, states) + np.matmul(regulator.d, z)
    return np.matmul(regulator.a, states) + np.matmul(regulator.b, z), commands.reshape(-1, cases)


def answer(regulator: Regulator | Stepped, readings: Array) -> Array:
    """Return the commands (k, p, cases) to readings (k, m, cases) that nothing feeds back, from rest."""
    states, commands = start(regulator, readings.shape[2]), []
    for reading in readings:
        states, given = advance(regulator, states, reading)
        commands.append(given)
    return np.array(commands)


def played(commands: Array) -> Stepped:
    """Return what gives commands (k, p, cases) one after the other, whatever it reads, and holds the last."""

    def function(states: Array, readings: Array) -> tuple[Array, Array]:
        return states + 1.0, commands[min(int(states[0, 0]), len(commands) - 1)]

    return Stepped(1, function)


def shape_of(found: Regulator | Stepped | Instant, readings: int) -> tuple[int, int]:
    """Return the numbers of commands and of readings of a controller; a function is tried with so many."""
    if isinstance(found, Stepped):
        return len(advance(found, start(found, 1), np.zeros((readings, 1)))[1]), readings
    commands = len(found.decoupling) if isinstance(found, Instant) else found.groups * found.c.shape[1]
    return int(commands), found.decoupling.shape[1]


def model_of(regulator: Regulator, period: float) -> LinearModel:
    """Return a regulator as one model from readings to commands."""
    if len(regulator.a) == 1:
        parts = [np.kron(np.eye(regulator.groups), one[0]) for one in _matrices(regulator)]
    else:
        parts = [block_diag(*one) for one in _matrices(regulator)]
    a, b, c, d = parts
    return LinearModel(a, b @ regulator.decoupling, c, d @ regulator.decoupling, period)


def _matrices(regulator: Regulator) -> tuple[Array, Array, Array, Array]:
    return regulator.a, regulator.b, regulator.c, regulator.d
