"""One channel of an actuator between events, exactly, and as a sensor with frames and delay sees it.

The states and the integral of the position over time are stepped together by one matrix exponential (Van Loan
1978), so that steps may end wherever something happens: frame, command, or an instant that is looked at.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import expm

from wavequake.control.linear import Array, LinearModel
from wavequake.errors import UserError

# Two events are one within this share of a period.
SAME = 1e-9


@dataclass(frozen=True)
class Dynamics:
    """How an actuator follows commands, or a sensor what it reads: x' = a x + b u, q = c x + d u.

    Attributes
    ----------
    a, b, c : ndarray, shapes (n, n), (n,), (n,)
        Time in s.
    d : float
    """

    a: Array
    b: Array
    c: Array
    d: float = 0.0

    def __len__(self) -> int:
        return len(self.b)

    @property
    def at_rest(self) -> Array:
        """States (n,) of u = 1 for ever."""
        return np.asarray(-np.linalg.solve(self.a, self.b)) if len(self) else np.zeros(0)

    @property
    def static_gain(self) -> float:
        """Give q of u = 1 for ever."""
        return float(self.c @ self.at_rest + self.d)


RIGID = Dynamics(np.zeros((0, 0)), np.zeros(0), np.zeros(0), 1.0)


def first_order(bandwidth_hz: float) -> Dynamics:
    """Return q' = w (u - q)."""
    w = 2 * np.pi * bandwidth_hz
    return Dynamics(np.array([[-w]]), np.array([w]), np.ones(1))


def second_order(frequency_hz: float, zeta: float) -> Dynamics:
    """Return q'' + 2 zeta w q' + w^2 q = w^2 u, with the states q and q' / w."""
    w = 2 * np.pi * frequency_hz
    a = np.array([[0.0, w], [-w, -2 * zeta * w]])
    return Dynamics(a, np.array([0.0, w]), np.array([1.0, 0.0]))


def acceleration(frequency_hz: float, zeta: float) -> Dynamics:
    """Return q = u'' as a proof mass on a spring shows it: s^2 w^2 / (s^2 + 2 zeta w s + w^2)."""
    w = 2 * np.pi * frequency_hz
    mass = second_order(frequency_hz, zeta)
    return Dynamics(mass.a, mass.b, np.array([-(w**2), -2 * zeta * w**2]), w**2)


def recoil(frequency_hz: float, zeta: float) -> Dynamics:
    """Return how a mode of a structure answers what moves along it: w^2 / (s^2 + 2 zeta w s + w^2) - 1.

    Nothing at rest, and the opposite of what is fast.
    """
    mode = second_order(frequency_hz, zeta)
    return Dynamics(mode.a, mode.b, mode.c, -1.0)


def in_series(first: Dynamics, second: Dynamics) -> Dynamics:
    """Return dynamics whose input is what others give; states of the first come first."""
    n, m = len(first), len(second)
    a = np.block([[first.a, np.zeros((n, m))], [np.outer(second.b, first.c), second.a]])
    return Dynamics(
        a,
        np.concatenate([first.b, second.b * first.d]),
        np.concatenate([second.d * first.c, second.c]),
        second.d * first.d,
    )


@dataclass(frozen=True)
class Step:
    """x' = phi x + gamma u over a time in which u is held; the integral of q is row x + through u."""

    phi: Array
    gamma: Array
    row: Array
    through: float | Array


def step_over(dynamics: Dynamics, seconds: float) -> Step:
    """Return the exact step over so many seconds."""
    n = len(dynamics)
    if not n:
        return Step(dynamics.a, dynamics.b, dynamics.c, dynamics.d * seconds)
    whole = np.zeros((n + 2, n + 2))
    whole[:n, :n], whole[:n, n], whole[n + 1, :n] = dynamics.a, dynamics.b, dynamics.c
    moved = expm(whole * seconds)
    return Step(moved[:n, :n], moved[:n, n], moved[n + 1, :n], float(moved[n + 1, n]) + dynamics.d * seconds)


@dataclass(frozen=True)
class Timing:
    """When a loop reads and acts, s.

    Attributes
    ----------
    frame : float
        From one reading of the sensor to the next.
    integration : float
        The last part of a frame, over which the sensor averages.
    frames : int
        Readings of which the controller takes the mean before it gives a command.
    latency : float
        From the end of the last of these frames until the command acts.
    """

    frame: float
    integration: float
    frames: int
    latency: float

    @property
    def period(self) -> float:
        """From one command to the next."""
        return self.frames * self.frame


def sampled_channel(dynamics: Dynamics, timing: Timing) -> LinearModel:
    """Return a channel from commands to the mean reading of each period, as a model by periods.

    The command of a period is given at its end. States are those of the actuator at the start of a period and
    the commands that wait, the newest first.

    Raises
    ------
    UserError
        If the latency is negative.
    """
    period, n = timing.period, len(dynamics)
    if timing.latency < 0:
        raise UserError(f"The latency is {timing.latency:g} s; it cannot be negative.")
    late = int(np.floor(timing.latency / period + SAME))
    change = max(timing.latency - late * period, 0.0)
    if change < SAME * period:
        change = 0.0
    waiting = late + (1 if change == 0.0 else 2)
    # What each span of the period does, with all that is known at its start as one vector: x and commands.
    size = n + waiting
    state, reading = np.eye(size), np.zeros(size)
    edges = {0.0, change, period}
    windows = [
        (k * timing.frame + timing.frame - timing.integration, (k + 1) * timing.frame)
        for k in range(timing.frames)
    ]
    edges |= {edge for window in windows for edge in window}
    times = _apart(sorted(edges), period)
    for begin, end in pairwise(times):
        middle = 0.5 * (begin + end)
        command = n + late if middle > change else n + late + 1
        step = step_over(dynamics, end - begin)
        if any(first < middle < last for first, last in windows):
            reading += (step.row @ state[:n] + step.through * np.eye(size)[command]) / (
                timing.frames * timing.integration
            )
        state[:n] = step.phi @ state[:n] + np.outer(step.gamma, np.eye(size)[command])
    a = np.zeros((size, size))
    a[:n] = state[:n]
    a[n + 1 :, n:-1] = np.eye(waiting - 1)
    b = np.zeros((size, 1))
    b[n] = 1.0
    return LinearModel(a, b, reading[None], np.zeros((1, 1)), period)


def _apart(times: list[float], period: float) -> list[float]:
    """Return rising times without those that differ by rounding alone."""
    found = times[:1]
    for one in times[1:]:
        if one - found[-1] > SAME * period:
            found.append(one)
    return found
