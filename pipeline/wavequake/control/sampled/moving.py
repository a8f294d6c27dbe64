"""What moves between events, as one sensor sees it: channels of an actuator, and modes that answer them.

Nothing is stepped before someone asks: where only commands of others come, one exact step leads over them.
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
    actuator, sensor : Dynamics
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

    actuator: Dynamics
    sensor: Dynamics
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
        if len(step.gamma):
            flat = self.states.reshape(len(self.states), -1)
            self.integral += (step.row @ flat).reshape(self.held.shape)
            self.states = (step.phi @ flat).reshape(self.states.shape) + step.gamma[:, None, None] * self.held

    def hold(self, command: Array) -> None:
        """Hold a command (p, cases) from now on."""
        self.catch_up()
        self.held = command

    def position(self) -> Array:
        """Return where the channels are, (p, cases)."""
        self.catch_up()
        found = np.tensordot(self.actuator.c, self.states[: len(self.actuator)], 1)
        found = found + self.actuator.d * self.held
        return np.asarray(np.where(np.isnan(self.stuck), found, self.stuck))

    def mean(self) -> Array:
        """Return what is read of the channels, on average since the sensor opened, and open it again."""
        found = self.open() / self.integration
        return np.asarray(np.where(np.isnan(self.stuck), found, self.sensor.static_gain * self.stuck))

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


def channels(
    actuator: Dynamics, stuck: Array, sensor: Dynamics, integration: float, same: float, cases: int
) -> Channels:
    """Return p channels at rest; lengths of steps that differ by less than `same` s are one."""
    together, p = in_series(actuator, sensor), len(stuck)
    return Channels(
        actuator,
        sensor,
        stuck[:, None],
        integration,
        _kept(lambda seconds: step_over(together, seconds), same),
        np.zeros((len(together), p, cases)),
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
        each = [step_over(one, seconds) for one in read]
        return tuple(
            np.array([getattr(one, name) for one in each]) for name in ("phi", "gamma", "row", "through")
        )

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


def _kept(make: Callable[[float], Made], same: float) -> Callable[[float], Made]:
    """Return a function of seconds that remembers what it made."""
    found: dict[int, Made] = {}

    def of(seconds: float) -> Made:
        key = round(seconds / same)
        if key not in found:
            found[key] = make(seconds)
        return found[key]

    return of
