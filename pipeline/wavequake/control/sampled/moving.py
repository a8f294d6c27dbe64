"""What moves between events, as one sensor sees it: channels of an actuator, and modes that answer them.

Nothing is stepped before someone asks: where only commands of others come, one exact step leads over them.
Cases of a batch share an actuator's dynamics, or each has its own: matrices then have a first axis of cases.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from wavequake.control.linear import Array
from wavequake.control.sampled.channel import Dynamics, Step, in_series, step_over

Made = TypeVar("Made")


@dataclass
class Channels:
    """An actuator as a sensor sees it: states of both (n, p, cases), and the integral of what is read.

    Attributes
    ----------
    rows, through : ndarray, shapes (n,) or (cases, n), () or (cases,)
        Positions per state, and per command.
    static : float
        What the sensor makes of a constant 1.
    stuck : ndarray, shape (p, 1)
        Where channels are stuck; NaN for those that move.
    integration : float
        Of the sensor, s.
    steps : callable
        Gives the step over so many seconds.
    states, held, integral : ndarray
    elapsed : float
        Since the last step, s.
    """

    rows: Array
    through: Array
    static: float
    stuck: Array
    integration: float
    steps: Callable[[float], Step]
    states: Array
    held: Array
    integral: Array
    elapsed: float = 0.0

    def catch_up(self) -> None:
        """Step over what has elapsed."""
        if not self.elapsed:
            return
        step, self.elapsed = self.steps(self.elapsed), 0.0
        self.integral += step.through * self.held
        if len(self.states):
            self.integral += _seen(step.row, self.states)
            driven = step.gamma.T[:, None] if step.gamma.ndim > 1 else step.gamma[:, None, None]
            self.states = _led(step.phi, self.states) + driven * self.held

    def hold(self, command: Array) -> None:
        """Hold a command (p, cases) from now on."""
        self.catch_up()
        self.held = command

    def position(self) -> Array:
        """Return where the channels are, (p, cases)."""
        self.catch_up()
        found = _seen(self.rows, self.states[: self.rows.shape[-1]]) + self.through * self.held
        return np.asarray(np.where(np.isnan(self.stuck), found, self.stuck))

    def mean(self) -> Array:
        """Return what is read of the channels, on average since the sensor opened, and open it again."""
        found = self.open() / self.integration
        return np.asarray(np.where(np.isnan(self.stuck), found, self.static * self.stuck))

    def open(self) -> Array:
        """Begin an average; returns the integral until now."""
        self.catch_up()
        found, self.integral = self.integral, np.zeros_like(self.integral)
        return found


@dataclass
class Modes:
    """Modes of a structure, as a sensor sees them, that answer one actuator: states (K, n, cases)."""

    drives: Array
    rows: Array
    through: Array
    integration: float
    steps: Callable[[float], tuple[Array, ...]]
    states: Array
    held: Array
    integral: Array
    elapsed: float = 0.0

    def catch_up(self) -> None:
        """Step over what has elapsed."""
        if not self.elapsed:
            return
        (phi, gamma, row, through), self.elapsed = self.steps(self.elapsed), 0.0
        self.integral += np.matmul(row[:, None], self.states)[:, 0] + through[:, None] * self.held
        self.states = np.matmul(phi, self.states) + gamma[:, :, None] * self.held[:, None]

    def hold(self, command: Array) -> None:
        """Answer a command (p, cases) of the actuator from now on."""
        self.catch_up()
        self.held = self.drives @ command

    def position(self) -> Array:
        """Return where the modes are, (K, cases)."""
        self.catch_up()
        found = np.matmul(self.rows[:, None], self.states[:, : self.rows.shape[1]])[:, 0]
        return np.asarray(found + self.through[:, None] * self.held)

    def mean(self) -> Array:
        """Return what is read of the modes, on average since the sensor opened, and open it again."""
        return self.open() / self.integration

    def open(self) -> Array:
        """Begin an average; returns the integral until now."""
        self.catch_up()
        found, self.integral = self.integral, np.zeros_like(self.integral)
        return found


def _led(phi: Array, states: Array) -> Array:
    """Return states (n, p, cases) a step later."""
    if phi.ndim > 2:
        return np.asarray(np.einsum("kij,jpk->ipk", phi, states))
    return np.asarray((phi @ states.reshape(len(states), -1)).reshape(states.shape))


def _seen(row: Array, states: Array) -> Array:
    """Return what a row makes of states (n, p, cases), (p, cases)."""
    if row.ndim > 1:
        return np.asarray(np.einsum("kj,jpk->pk", row, states))
    if not len(row):
        return np.zeros(states.shape[1:])
    return np.asarray((row @ states.reshape(len(states), -1)).reshape(states.shape[1:]))


def channels(
    actuator: Dynamics | tuple[Dynamics, ...],
    stuck: Array,
    sensor: Dynamics,
    integration: float,
    same: float,
    cases: int,
) -> Channels:
    """Return p channels at rest; lengths of steps that differ by less than `same` s are one."""
    p = len(stuck)
    if isinstance(actuator, Dynamics):
        together = in_series(actuator, sensor)
        rows, through, states = actuator.c, np.asarray(actuator.d), len(together)
        steps = _kept(lambda seconds: step_over(together, seconds), same)
    else:
        each = [in_series(one, sensor) for one in actuator]
        rows, through = np.stack([one.c for one in actuator]), np.array([one.d for one in actuator])
        states = len(each[0])
        steps = _kept(lambda seconds: _stacked([step_over(one, seconds) for one in each]), same)
    return Channels(
        rows,
        through,
        sensor.static_gain,
        stuck[:, None],
        integration,
        steps,
        np.zeros((states, p, cases)),
        np.zeros((p, cases)),
        np.zeros((p, cases)),
    )


def answering(
    structure: Sequence[Dynamics],
    drives: Array,
    actuator: Dynamics,
    sensor: Dynamics,
    integration: float,
    same: float,
    cases: int,
) -> Modes:
    """Return K modes of a structure at rest that p channels drive, (K, p)."""
    own = [in_series(actuator, mode) for mode in structure]
    read = [in_series(one, sensor) for one in own]

    def steps(seconds: float) -> tuple[Array, ...]:
        one = _stacked([step_over(one, seconds) for one in read])
        return one.phi, one.gamma, one.row, np.asarray(one.through)

    k = len(structure)
    return Modes(
        drives,
        np.array([one.c for one in own]),
        np.array([one.d for one in own]),
        integration,
        _kept(steps, same),
        np.zeros((k, len(read[0]), cases)),
        np.zeros((k, cases)),
        np.zeros((k, cases)),
    )


def _stacked(each: Sequence[Step]) -> Step:
    """Return steps as one, with a leading axis."""
    phi, gamma, row, through = (
        np.array([getattr(one, name) for one in each]) for name in ("phi", "gamma", "row", "through")
    )
    return Step(phi, gamma, row, through)


def _kept(make: Callable[[float], Made], same: float) -> Callable[[float], Made]:
    """Return a function of seconds that remembers what it made."""
    found: dict[int, Made] = {}

    def of(seconds: float) -> Made:
        key = round(seconds / same)
        if key not in found:
            found[key] = make(seconds)
        return found[key]

    return of
