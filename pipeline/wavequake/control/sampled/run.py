"""Loops in time: a batch of cases from event to event, exact between events whatever the rates and delays.

An event is the begin or end of a sensor's average, a command that acts, or an instant that is looked at. What
the sensors see of the disturbance (means over their frames, with noise) is known before.
"""

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wavequake.control.linear import Array
from wavequake.control.sampled.channel import RIGID, SAME, Dynamics, Timing
from wavequake.control.sampled.moving import Channels, Modes, answering, channels
from wavequake.control.sampled.readings import Frames
from wavequake.control.sampled.regulator import Regulator, Stepped, advance, start

OPEN, READ, ACT, LOOK = range(4)
# Beyond it a case has diverged; commands are of the order of 1e-9 to 1.
ENDLESS = 1e30


@dataclass(frozen=True)
class Actuator:
    """What p channels of an actuator do with commands.

    Attributes
    ----------
    dynamics : Dynamics or tuple of Dynamics
        Of every channel; one for each case where cases differ in it.
    stroke : ndarray, shape (p,)
        Largest command; inf where there is no limit.
    slew : float
        Largest change from one command to the next; inf: none.
    stuck : ndarray, shape (p,)
        Where channels are stuck; NaN for those that move.
    """

    dynamics: Dynamics | tuple[Dynamics, ...]
    stroke: Array
    slew: float
    stuck: Array


@dataclass(frozen=True)
class Eye:
    """A further sensor of a loop, of the same frames; attributes as of `Loop`."""

    sees: Array
    quantum: float = 0.0
    sensor: Dynamics = RIGID


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
    further : tuple of Eye
        Sensors whose readings come after these.
    """

    timing: Timing
    regulator: Regulator | Stepped
    actuator: Actuator
    sees: Array
    quantum: float = 0.0
    sensor: Dynamics = RIGID
    drives: Array | None = None
    further: tuple[Eye, ...] = ()

    @property
    def eyes(self) -> tuple[Eye, ...]:
        """All its sensors."""
        return (Eye(self.sees, self.quantum, self.sensor), *self.further)

    @property
    def readings(self) -> int:
        """Number of readings of all its sensors."""
        return sum(len(eye.sees) for eye in self.eyes)


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


def schedule(timings: Sequence[Timing], looks: Array, jumped: bool = False) -> Schedule:
    """Return the events of loops from 0 to the last of the rising instants that are looked at, s.

    Looks come before what acts at the same instant, a limit from the left, or after it if `jumped`.
    """
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
        last = LOOK if jumped else ACT
        for one, (kind, loop) in enumerate(sorted(together, key=lambda event: (event[0] == last, event))):
            steps.append(place if one == 0 else -1)
            kinds.append(kind)
            loops.append(loop)
        now = at
    return Schedule(
        np.array(steps), tuple(length for _, length in lengths.values()), np.array(kinds), np.array(loops)
    )


def run(
    loops: Sequence[Loop],
    events: Schedule,
    seen: Sequence[Frames],
    looks: int,
    structure: Sequence[Dynamics] = (),
    beyond: Callable[[int, int, Array], Array] | None = None,
) -> Outcome:
    """Run loops that begin at rest.

    Parameters
    ----------
    loops : sequence of Loop
    events : Schedule
        Of their timings.
    seen : sequence of Frames, shape (frames, m, cases)
        Of each loop's sensors: the mean of the disturbance over each frame, with noise.
    looks : int
        Number of instants that are looked at.
    structure : sequence of Dynamics
        How each of its modes answers what moves along it, as `recoil`.
    beyond : callable, optional
        Of a loop's place, a frame (from 0) and the mean positions over it (P + K, cases): what its sensors
        read (m, cases) beside what follows positions linearly.
    """
    cases = seen[0].shape[2]
    same = SAME * min(loop.timing.frame for loop in loops)
    # Every sensor averages over its own frames what all actuators do, and what the structure answers.
    owners = [loop for loop in loops for _ in loop.eyes]
    eyes = [eye for loop in loops for eye in loop.eyes]
    watched = [(eye, owner.timing.integration) for eye, owner in zip(eyes, owners, strict=True)]
    moving = [[_channels(one, *each, same, cases) for one in loops] for each in watched]
    answers = [[_modes(structure, one, *each, same, cases) for one in loops if structure] for each in watched]
    sighted = [beyond is not None or bool(eye.sees.any()) for eye in eyes]
    starts = np.cumsum([0, *(len(loop.eyes) for loop in loops)])
    controlled = [_at_rest(loop, cases) for loop in loops]
    everything = [one for row in moving for one in row], [one for row in answers for one in row]
    count = sum(len(loop.actuator.stroke) for loop in loops) + len(structure)
    positions = np.empty((looks, count, cases))
    limited, total, look = np.zeros(cases), 0, 0
    with np.errstate(over="ignore", invalid="ignore"):
        for length, kind, index in zip(events.steps, events.kinds, events.loops, strict=True):
            if length >= 0:
                for one in everything[0]:
                    one.elapsed += events.lengths[length]
                for mode in everything[1]:
                    mode.elapsed += events.lengths[length]
            mine, places = controlled[index], range(starts[index], starts[index + 1])
            if kind == LOOK:
                positions[look] = _joined(
                    [one.position() for one in moving[0]], [mode.position() for mode in answers[0]]
                )
                look += 1
            elif kind == OPEN:
                for place in places:
                    for one in moving[place]:
                        one.open()
                    for mode in answers[place]:
                        mode.open()
            elif kind == READ:
                means = [
                    _joined([one.mean() for one in moving[place]], [one.mean() for one in answers[place]])
                    if sighted[place]
                    else np.zeros((count, cases))
                    for place in places
                ]
                given = seen[index][mine.frame]
                _read(mine, means, given + beyond(index, mine.frame, means[0]) if beyond else given)
                if mine.frame % mine.loop.timing.frames == 0:
                    limited += _command(mine)
                    total += len(mine.given)
            else:
                command = mine.waiting.pop(0)
                for row in moving:
                    row[index].hold(command)
                moved = np.where(np.isnan(mine.loop.actuator.stuck)[:, None], command, 0.0)
                for answered in answers:
                    for mode in answered[index : index + 1]:
                        mode.hold(moved)
    diverged = np.logical_not(np.all(np.abs(positions) < ENDLESS, axis=(0, 1)))
    return Outcome(positions, limited / max(total, 1), np.asarray(diverged))


@dataclass
class _Controlled:
    """A loop's controller: its states, what it has read of a period, and commands that wait."""

    loop: Loop
    states: Array
    readings: Array
    given: Array
    waiting: list[Array] = field(default_factory=list)
    frame: int = 0


def _at_rest(loop: Loop, cases: int) -> _Controlled:
    given = np.zeros((len(loop.actuator.stroke), cases))
    return _Controlled(loop, start(loop.regulator, cases), np.zeros((loop.readings, cases)), given)


def _channels(loop: Loop, eye: Eye, integration: float, same: float, cases: int) -> Channels:
    own = loop.actuator
    return channels(own.dynamics, own.stuck, eye.sensor, integration, same, cases)


def _modes(
    structure: Sequence[Dynamics], loop: Loop, eye: Eye, integration: float, same: float, cases: int
) -> Modes:
    own = loop.actuator.dynamics
    assert loop.drives is not None
    assert isinstance(own, Dynamics)
    return answering(structure, loop.drives, own, eye.sensor, integration, same, cases)


def _joined(channels: list[Array], modes: list[Array]) -> Array:
    """Return channels one loop after the other, and the sum of what the structure answers them."""
    return np.concatenate([*channels, *([np.sum(modes, axis=0)] if modes else [])])


def _read(one: _Controlled, means: list[Array], seen: Array) -> None:
    first = 0
    for eye, moved in zip(one.loop.eyes, means, strict=True):
        last = first + len(eye.sees)
        reading = seen[first:last] + eye.sees @ moved
        if eye.quantum:
            reading = eye.quantum * np.round(reading / eye.quantum)
        one.readings[first:last] += reading / one.loop.timing.frames
        first = last
    one.frame += 1


def _command(one: _Controlled) -> Array:
    """Give the command of a period; return of each case how many channels are limited."""
    actuator = one.loop.actuator
    one.states, wanted = advance(one.loop.regulator, one.states, one.readings)
    one.readings = np.zeros_like(one.readings)
    near = np.clip(wanted, one.given - actuator.slew, one.given + actuator.slew)
    one.given = np.clip(near, -actuator.stroke[:, None], actuator.stroke[:, None])
    one.waiting.append(one.given)
    return np.asarray((one.given != wanted).sum(axis=0), dtype=np.float64)
