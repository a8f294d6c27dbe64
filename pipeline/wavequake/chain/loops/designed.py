"""Controllers of a study as they run: designed, with actuators, what sensors see of them, and events."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from wavequake.chain.loops import closing
from wavequake.chain.loops.answers import Answer, answering, drives_of, dynamics_of, shown_of
from wavequake.chain.loops.block import Actuator, Controller, stroke_of, stuck_of
from wavequake.chain.loops.blocks import LoopBlocks
from wavequake.chain.loops.closing import Given
from wavequake.chain.loops.design import Design, Shaken, Watch
from wavequake.chain.loops.light import Light
from wavequake.control.linear import Array
from wavequake.control.sampled.channel import Timing
from wavequake.control.sampled.readings import Streamed
from wavequake.control.sampled.regulator import Instant, Regulator, Stepped
from wavequake.control.sampled.run import Actuator as Moved
from wavequake.control.sampled.run import Eye, Loop, Schedule, frame_count, schedule
from wavequake.errors import UserError

# Of all that a motion shows, what a sensor sees of it by errors of derivatives alone.
_ROUNDING = 1e-5


class Sighted(Protocol):
    """What sensors see of an instrument.

    Attributes
    ----------
    light : Light
    sights : mapping of str to ndarray, shape (K, p)
        Of all K things that are seen, per position of each actuator, by name.
    shaken : Shaken or None
        Modes that controllers may expect.
    answers : sequence of Answer
        Modes that answer actuators.
    """

    @property
    def light(self) -> Light: ...  # noqa: D102
    @property
    def sights(self) -> Mapping[str, Array]: ...  # noqa: D102
    @property
    def shaken(self) -> Shaken | None: ...  # noqa: D102
    @property
    def answers(self) -> Sequence[Answer]: ...  # noqa: D102


@dataclass(frozen=True)
class Designed:
    """A controller with all that runs beside it.

    Attributes
    ----------
    name : str
    actuators : tuple of Actuator
        Whose channels are the positions, one after the other.
    answers : tuple of Answer
        Whose modes answer them.
    sight : ndarray, shape (K, P + modes)
        What sensors see per position of all channels, and of these modes.
    loops : tuple of Loop
    readings : tuple of tuple of ndarray, shape (m, K)
        Of each loop's sensors, per what is seen.
    instant : ndarray, shape (P, K), or None
        Positions per what is seen, of a controller that acts at once.
    schedules : tuple of Schedule
        Of each population.
    """

    name: str
    actuators: tuple[Actuator, ...]
    answers: tuple[Answer, ...]
    sight: Array
    loops: tuple[Loop, ...]
    readings: tuple[tuple[Array, ...], ...]
    instant: Array | None
    schedules: tuple[Schedule, ...]

    def channels(self, light: Light) -> int:
        """Return P."""
        return sum(len(one.channels(light)) for one in self.actuators)


def timing_of(study: LoopBlocks, one: Controller) -> Timing:
    """Return when a controller reads and acts."""
    return closing.timing_of(one, study.part("sensor", one.sensor))


def designed(study: LoopBlocks, optics: Sighted, one: Controller) -> Given:
    """Return what a controller came to: a regulator, what acts at once, or None.

    Raises
    ------
    UserError
        If its design fails, or gives what does not fit sensor and actuator; names the controller.
    """
    if not one.sensor or not one.actuator:
        return None
    return closing.design(one, asked_of(study, optics, one))


def asked_of(study: LoopBlocks, optics: Sighted, one: Controller) -> Design:
    """Return what a controller with sensors and actuator is designed for."""
    actuator, modes = study.part("actuator", one.actuator), optics.shaken
    channels, timing = actuator.channels(optics.light), timing_of(study, one)
    answers = answering(optics.answers, [actuator.name])
    shown = shown_of(answers, len(optics.light))
    shaken = np.zeros((len(optics.light), 0)) if modes is None else modes.seen
    watched = []
    sight, optical = optics.sights[actuator.name], optics.light.optical
    for sensor in study.sensors(one):
        readings, noise = sensor.readings(optics.light, nominal=True), sensor.noise_rms(optics.light)
        rows = slice(optical) if sensor.sees == "light" else slice(optical, None)
        watched.append(
            Watch(
                sensor.name,
                sensor.labels(optics.light),
                _beyond_rounding(readings, sight, rows),
                noise / np.sqrt(timing.frames),
                sensor.dynamics(),
                _beyond_rounding(readings, shaken, rows),
                readings @ shown,
            )
        )
    return Design(
        one.name,
        actuator.name,
        tuple(watched),
        channels,
        actuator.dynamics(),
        timing,
        modes,
        dynamics_of(answers),
        drives_of(answers, actuator.name, len(channels)),
    )


def _beyond_rounding(readings: Array, shown: Array, rows: slice) -> Array:
    """Return readings (m, K) of what motions show (K, p), of those that show no more than rounding none.

    M2 along its axis moves the wavefront; its line of sight then is what derivatives of that are off. `rows`
    are what such a sensor can see: light, or bodies.
    """
    found, most = readings @ shown, np.abs(readings).max(initial=0.0)
    sizes, largest = (np.abs(one).max(axis=0, initial=0.0) for one in (found, shown[rows]))
    return np.where(sizes > _ROUNDING * most * largest, found, 0.0)


def designs_of(study: LoopBlocks, optics: Sighted) -> dict[str, Given]:
    """Return what all controllers of a study came to, by name; see `designed`."""
    return {one.name: designed(study, optics, one) for one in study.controller}


def design_notices(study: LoopBlocks, optics: Sighted) -> Iterator[str]:
    """Yield what controllers leave out in their designs."""
    for one in study.controller:
        if one.sensor and one.actuator:
            yield from one.notices(asked_of(study, optics, one))


def assembled(
    study: LoopBlocks,
    optics: Sighted,
    one: Controller,
    designs: Mapping[str, Given],
    looks: Sequence[Array],
) -> Designed:
    """Return a controller, as `designs` has it, with all that runs beside it.

    `looks` are the instants (n,) after 0 of each population, s, at which positions are asked for.
    """
    found = designs[one.name]
    if found is None:
        return Designed(one.name, (), (), np.zeros((len(optics.light), 0)), (), (), None, ())
    running = study.running(one)
    actuators = tuple(study.part("actuator", each.actuator) for each in running)
    sight = np.hstack([optics.sights[each.name] for each in actuators])
    if isinstance(found, Instant):
        sensor = study.part("sensor", one.sensor)
        instant = -found.decoupling @ sensor.readings(optics.light, nominal=True)
        return Designed(one.name, actuators, (), sight, (), (), instant, ())
    loops, readings = [], []
    answers = answering(optics.answers, [each.name for each in actuators])
    sight = np.hstack([sight, shown_of(answers, len(optics.light))])
    for each, actuator in zip(running, actuators, strict=True):
        sensors = study.sensors(each)
        timing = timing_of(study, each)
        channels = actuator.channels(optics.light)
        slew = np.inf if actuator.slew is None else actuator.slew * timing.period
        stuck = stuck_of(actuator, channels)
        moved = Moved(actuator.dynamics(), stroke_of(actuator, len(channels)), slew, stuck)
        readings.append(tuple(sensor.readings(optics.light) for sensor in sensors))
        regulator = designs[each.name]
        if not isinstance(regulator, Regulator | Stepped):
            raise UserError(f"controller.{each.name} gives no commands, so that it cannot run beside others.")
        drives = drives_of(answers, actuator.name, len(channels)) * np.isnan(stuck)
        first, *further = (
            Eye(matrix @ sight, sensor.quantum, sensor.dynamics())
            for sensor, matrix in zip(sensors, readings[-1], strict=True)
        )
        loops.append(
            Loop(timing, regulator, moved, first.sees, first.quantum, first.sensor, drives, tuple(further))
        )
    schedules = tuple(schedule([loop.timing for loop in loops], one_look) for one_look in looks)
    return Designed(one.name, actuators, answers, sight, tuple(loops), tuple(readings), None, schedules)


def readings_of(
    study: LoopBlocks,
    light: Light,
    one: Designed,
    cases: Sequence[tuple[Array, Array, int] | None],
    seed: int,
) -> list[Streamed]:
    """Return the readings of each loop's sensors of cases beside each other, with their noise.

    A case is its instants (n,), all that is seen at them (n, K) and its number; None reads zeros.
    """
    running, found = study.running(study.part("controller", one.name)), []
    duration = next(case[0][-1] for case in cases if case is not None)
    for each, loop, matrices in zip(running, one.loops, one.readings, strict=True):
        sensors = study.sensors(each)
        blocks = [
            case and closing.readings(*case[:2], loop.timing, sensors, matrices, light, seed, case[2])
            for case in cases
        ]
        found.append(Streamed(frame_count(loop.timing, duration), loop.readings, blocks))
    return found
