"""Loops in time: a batch of cases from event to event, exact between events whatever the rates and delays.

An event is the begin or end of a sensor's average, a command that acts, or an instant that is looked at. What
the sensors see of the disturbance (means over their frames, with noise) is known before.
"""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wavequake.control.linear import Array
from wavequake.control.sampled.channel import RIGID, SAME, Dynamics, Step, Timing, in_series, step_over
from wavequake.control.sampled.regulator import Regulator, Stepped, advance, start

OPEN, READ, ACT, LOOK = range(4)
_STEP = ("phi", "gamma", "row", "through")
# Beyond it a case has diverged; commands are of the order of 1e-9 to 1.
ENDLESS = 1e30


@dataclass(frozen=True)
class Actuator:
    """What p channels of an actuator do with commands.

    Attributes
    ----------
    dynamics : Dynamics
        Of every channel.
    stroke : ndarray, shape (p,)
        Largest command; inf where there is no limit.
    slew : float
        Largest change from one command to the next; inf: none.
    stuck : ndarray, shape (p,)
        Where channels are stuck; NaN for those that move.
    """

    dynamics: Dynamics
    stroke: Array
    slew: float
    stuck: Array


@dataclass(frozen=True)
class Loop:
    """A controller with its sensor and actuator.

    Attributes
    ----------
    timing : Timing
    regulator : Regulator
    actuator : Actuator
    sees : ndarray, shape (m, P + K)
        How readings follow the positions of all loops' channels, one loop after the other, and then the
        modes of the structure.
    quantum : float
        To whole multiples of this readings are rounded; 0: they are not.
    sensor : Dynamics
        How each reading follows what is read.
    drives : ndarray, shape (K, p), or None
        How the channels move along each mode of the structure.
    """

    timing: Timing
    regulator: Regulator | Stepped
    actuator: Actuator
    sees: Array
    quantum: float = 0.0
    sensor: Dynamics = RIGID
    drives: Array | None = None


@dataclass(frozen=True)
class Schedule:
    """Events in their order.

    Attributes
    ----------
    steps : ndarray of int, shape (e,)
        Which of the lengths passes before an event; -1: none.
    lengths : tuple of float
        s.
    kinds, loops : ndarray of int, shape (e,)
        OPEN, READ, ACT or LOOK, and of which loop.
    """

    steps: NDArray[np.int64]
    lengths: tuple[float, ...]
    kinds: NDArray[np.int64]
    loops: NDArray[np.int64]


@dataclass(frozen=True)
class Outcome:
    """What a batch of cases came to.

    Attributes
    ----------
    positions : ndarray, shape (l, P + K, cases)
        Of all channels and of the structure's modes at the instants that are looked at, before what acts just
        then.
    limited : ndarray, shape (cases,)
        Share of the channels' commands that stroke or slew limited.
    diverged : ndarray of bool, shape (cases,)
    """

    positions: Array
    limited: Array
    diverged: NDArray[np.bool_]


def frame_count(timing: Timing, duration: float) -> int:
    """Return how many whole frames a run holds."""
    return int(np.floor(duration / timing.frame + SAME))


def schedule(timings: Sequence[Timing], looks: Array) -> Schedule:
    """Return the events of loops from 0 to the last of the rising instants that are looked at, s."""
    duration = float(looks[-1])
    queue: list[tuple[float, int, int]] = [(float(at), LOOK, 0) for at in looks]
    for index, timing in enumerate(timings):
        for k in range(1, frame_count(timing, duration) + 1):
            if timing.integration < timing.frame:
                queue.append((k * timing.frame - timing.integration, OPEN, index))
            queue.append((k * timing.frame, READ, index))
            if k % timing.frames == 0:
                queue.append((k * timing.frame + timing.latency, ACT, index))
    same = SAME * min([timing.frame for timing in timings], default=duration)
    heapq.heapify(queue)
    steps, kinds, loops, lengths = [], [], [], dict[int, tuple[int, float]]()
    now, together = 0.0, list[tuple[int, int]]()
    while queue:
        at, kind, loop = heapq.heappop(queue)
        if at > duration + same:
            break
        together = [(kind, loop)]
        while queue and queue[0][0] - at <= same:
            together.append(heapq.heappop(queue)[1:])
        length = at - now
        key = round(length / same)
        place = -1 if key == 0 else lengths.setdefault(key, (len(lengths), length))[0]
        # Looks come before what acts at the same instant: a limit from the left.
        for one, (kind, loop) in enumerate(sorted(together, key=lambda event: (event[0] == ACT, event))):
            steps.append(place if one == 0 else -1)
            kinds.append(kind)
            loops.append(loop)
        now = at
    return Schedule(
        np.array(steps), tuple(length for _, length in lengths.values()), np.array(kinds), np.array(loops)
    )


@dataclass
class _Moving:
    """An actuator as a sensor sees it: states of both (n, p, cases), integral of what is read, controller."""

    loop: Loop
    sensor: Dynamics
    integration: float
    steps: Sequence[Step]
    states: Array
    held: Array
    given: Array
    integral: Array
    controller: Array
    readings: Array
    waiting: list[Array] = field(default_factory=list)
    frame: int = 0

    def pass_by(self, length: int) -> None:
        """Move on by one of the lengths of the schedule."""
        step = self.steps[length]
        self.integral += step.through * self.held
        if len(step.gamma):
            flat = self.states.reshape(len(self.states), -1)
            self.integral += (step.row @ flat).reshape(self.held.shape)
            self.states = (step.phi @ flat).reshape(self.states.shape) + step.gamma[:, None, None] * self.held

    def position(self) -> Array:
        """Return where the channels are, (p, cases)."""
        dynamics, stuck = self.loop.actuator.dynamics, self.loop.actuator.stuck[:, None]
        found = np.tensordot(dynamics.c, self.states[: len(dynamics)], 1) + dynamics.d * self.held
        return np.asarray(np.where(np.isnan(stuck), found, stuck))

    def mean(self) -> Array:
        """Return what is read of the channels, on average since the sensor opened."""
        stuck = self.sensor.static_gain * self.loop.actuator.stuck[:, None]
        return np.asarray(np.where(np.isnan(stuck), self.integral / self.integration, stuck))


@dataclass
class _Answering:
    """Modes of a structure, as a sensor sees them, that answer one actuator: states (K, n, cases)."""

    drives: Array
    own: int
    rows: Array
    through: Array
    integration: float
    steps: Sequence[tuple[Array, ...]]
    states: Array
    held: Array
    integral: Array

    def pass_by(self, length: int) -> None:
        """Move on by one of the lengths of the schedule."""
        phi, gamma, row, through = self.steps[length]
        self.integral += np.matmul(row[:, None], self.states)[:, 0] + through[:, None] * self.held
        self.states = np.matmul(phi, self.states) + gamma[:, :, None] * self.held[:, None]

    def position(self) -> Array:
        """Return where the modes are, (K, cases)."""
        found = np.matmul(self.rows[:, None], self.states[:, : self.own])[:, 0]
        return np.asarray(found + self.through[:, None] * self.held)

    def mean(self) -> Array:
        """Return what is read of the modes, on average since the sensor opened."""
        return np.asarray(self.integral / self.integration)


def run(
    loops: Sequence[Loop],
    events: Schedule,
    seen: Sequence[Array],
    looks: int,
    structure: Sequence[Dynamics] = (),
) -> Outcome:
    """Run loops that begin at rest.

    Parameters
    ----------
    loops : sequence of Loop
    events : Schedule
        Of their timings.
    seen : sequence of ndarray, shape (frames, m, cases)
        Of each loop's sensor: the mean of the disturbance over each frame, with noise.
    looks : int
        Number of instants that are looked at.
    structure : sequence of Dynamics
        How each of its modes answers what moves along it, as `recoil`.
    """
    cases = seen[0].shape[2]
    # Every sensor averages over its own frames what all actuators do, and what the structure answers.
    moving = [[_at_rest(other, loop, events.lengths, cases) for other in loops] for loop in loops]
    answers = [
        [_answering(structure, other, loop, events.lengths, cases) for other in loops if structure]
        for loop in loops
    ]
    channels = sum(len(loop.actuator.stroke) for loop in loops) + len(structure)
    positions = np.empty((looks, channels, cases))
    limited, total, look = np.zeros(cases), 0, 0
    with np.errstate(over="ignore", invalid="ignore"):
        for length, kind, index in zip(events.steps, events.kinds, events.loops, strict=True):
            if length >= 0:
                for row, answered in zip(moving, answers, strict=True):
                    for one in row:
                        one.pass_by(length)
                    for mode in answered:
                        mode.pass_by(length)
            if kind == LOOK:
                positions[look] = _joined(
                    [one.position() for one in moving[0]], [one.position() for one in answers[0]]
                )
                look += 1
            elif kind == OPEN:
                for one in (*moving[index], *answers[index]):
                    one.integral[:] = 0.0
            elif kind == READ:
                mine = moving[index][index]
                means = _joined([one.mean() for one in moving[index]], [one.mean() for one in answers[index]])
                _read(mine, means, seen[index])
                for one in (*moving[index], *answers[index]):
                    one.integral[:] = 0.0
                if mine.frame % mine.loop.timing.frames == 0:
                    limited += _command(mine)
                    total += len(mine.given)
            else:
                command = moving[index][index].waiting.pop(0)
                for row in moving:
                    row[index].held = command
                for answered in answers:
                    for mode in answered[index : index + 1]:
                        mode.held = mode.drives @ command
    diverged = np.logical_not(np.all(np.abs(positions) < ENDLESS, axis=(0, 1)))
    return Outcome(positions, limited / max(total, 1), np.asarray(diverged))


def _at_rest(loop: Loop, seen_by: Loop, lengths: Sequence[float], cases: int) -> _Moving:
    dynamics, p = in_series(loop.actuator.dynamics, seen_by.sensor), len(loop.actuator.stroke)
    return _Moving(
        loop,
        seen_by.sensor,
        seen_by.timing.integration,
        [step_over(dynamics, length) for length in lengths],
        states=np.zeros((len(dynamics), p, cases)),
        held=np.zeros((p, cases)),
        given=np.zeros((p, cases)),
        integral=np.zeros((p, cases)),
        controller=start(loop.regulator, cases),
        readings=np.zeros((len(loop.sees), cases)),
    )


def _answering(
    structure: Sequence[Dynamics], loop: Loop, seen_by: Loop, lengths: Sequence[float], cases: int
) -> _Answering:
    assert loop.drives is not None
    own = [in_series(loop.actuator.dynamics, mode) for mode in structure]
    read = [in_series(one, seen_by.sensor) for one in own]
    steps = []
    for length in lengths:
        each = [step_over(one, length) for one in read]
        steps.append(tuple(np.array([getattr(one, name) for one in each]) for name in _STEP))
    k = len(structure)
    return _Answering(
        loop.drives,
        len(own[0]),
        np.array([one.c for one in own]),
        np.array([one.d for one in own]),
        seen_by.timing.integration,
        steps,
        states=np.zeros((k, len(read[0]), cases)),
        held=np.zeros((k, cases)),
        integral=np.zeros((k, cases)),
    )


def _joined(channels: list[Array], modes: list[Array]) -> Array:
    """Return channels one loop after the other, and the sum of what the structure answers them."""
    return np.concatenate([*channels, *([np.sum(modes, axis=0)] if modes else [])])


def _read(one: _Moving, means: Array, seen: Array) -> None:
    reading = seen[one.frame] + one.loop.sees @ means
    if one.loop.quantum:
        reading = one.loop.quantum * np.round(reading / one.loop.quantum)
    one.readings += reading / one.loop.timing.frames
    one.frame += 1


def _command(one: _Moving) -> Array:
    """Give the command of a period; return of each case how many channels are limited."""
    actuator = one.loop.actuator
    one.controller, wanted = advance(one.loop.regulator, one.controller, one.readings)
    one.readings = np.zeros_like(one.readings)
    near = np.clip(wanted, one.given - actuator.slew, one.given + actuator.slew)
    one.given = np.clip(near, -actuator.stroke[:, None], actuator.stroke[:, None])
    one.waiting.append(one.given)
    return np.asarray((one.given != wanted).sum(axis=0), dtype=np.float64)
