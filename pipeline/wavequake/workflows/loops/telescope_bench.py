"""What the cases of ``telescope-loop`` share: light as sensitivities, designed controllers, their events."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from wavequake.chain.images.extended import check_object
from wavequake.chain.loops import closing
from wavequake.chain.loops.answers import Answer, answering, drives_of, dynamics_of, names_of, shown_of
from wavequake.chain.loops.block import Actuator, Controller, stroke_of, stuck_of
from wavequake.chain.loops.closing import Given, grows
from wavequake.chain.loops.design import Design, Shaken, Watch
from wavequake.chain.loops.light import Light
from wavequake.control.linear import Array
from wavequake.control.sampled.channel import Timing, in_series
from wavequake.control.sampled.regulator import Instant, Regulator, Stepped
from wavequake.control.sampled.run import Actuator as Moved
from wavequake.control.sampled.run import Eye, Loop, Schedule, frame_count, run, schedule
from wavequake.control.sampled.stability import SampledLoop, Sight, Worst, worst_pole
from wavequake.errors import UserError
from wavequake.workflows.loops.telescope_light import Optics, drawn, optics_of, seen_of
from wavequake.workflows.loops.telescope_study import TelescopeLoopStudy

# Motions that are seen less than this share of others ask for nothing.
_SEEN = 1e-6
# Periods of the slowest loop for which loops beside each other are watched after a kick.
_KICKED = 400


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


@dataclass(frozen=True)
class Bench:
    """A study with its telescope and controllers.

    Attributes
    ----------
    study : TelescopeLoopStudy
    optics : Optics
    controllers : tuple of Designed
    linear : dict of SampledLoop
        The loops of linear controllers, each alone, by name.
    """

    study: TelescopeLoopStudy
    optics: Optics
    controllers: tuple[Designed, ...]
    linear: dict[str, SampledLoop]


def bench_of(study: TelescopeLoopStudy) -> Bench:
    """Prepare a study.

    Raises
    ------
    UserError
        If a disturbance moves what loops cannot see, a controller cannot be designed, its loop is unstable,
        or a stroke is too short; names the block.
    """
    optics = optics_of(study)
    if study.object is not None:
        check_object(study.object, study.imaging.pixels, study.imaging.sampling)
    for index, entry in enumerate(study.disturbance):
        if entry.share:
            drawn(study, optics, index, 0)  # what no case can do is said before a run
    for sensor in study.sensor:
        sensor.labels(optics.light)  # what those cannot read that no controller uses, too
    designs = {one.name: designed(study, optics, one) for one in study.controller}
    linear = sampled_loops(study, optics, designs)
    for name, loop in linear.items():
        refuse_unstable(study, name, loop, optics)
    bench = Bench(
        study, optics, tuple(_designed(study, optics, one, designs) for one in study.controller), linear
    )
    for one in bench.controllers:
        refuse_unstable_together(study, one)
    refuse_saturated(bench)
    return bench


def timing_of(study: TelescopeLoopStudy, one: Controller) -> Timing:
    """Return when a controller reads and acts."""
    return closing.timing_of(one, study.part("sensor", one.sensor))


def designed(study: TelescopeLoopStudy, optics: Optics, one: Controller) -> Given:
    """Return what a controller came to: a regulator, what acts at once, or None.

    Raises
    ------
    UserError
        If its design fails, or gives what does not fit sensor and actuator; names the controller.
    """
    if not one.sensor or not one.actuator:
        return None
    return closing.design(one, asked_of(study, optics, one))


def asked_of(study: TelescopeLoopStudy, optics: Optics, one: Controller) -> Design:
    """Return what a controller with sensors and actuator is designed for."""
    actuator, structure = study.part("actuator", one.actuator), optics.structure
    channels, timing = actuator.channels(optics.light), timing_of(study, one)
    answers = answering(optics.answers, [actuator.name])
    shown = shown_of(answers, len(optics.light))
    shaken = np.zeros((len(optics.light), 0))
    if structure is not None:
        shaken = optics.answers[0].shown * structure.rms
    watched = []
    for sensor in study.sensors(one):
        readings, noise = sensor.readings(optics.light, nominal=True), sensor.noise_rms(optics.light)
        watched.append(
            Watch(
                sensor.name,
                sensor.labels(optics.light),
                readings @ optics.sights[actuator.name],
                noise / np.sqrt(timing.frames),
                sensor.dynamics(),
                readings @ shaken,
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
        None if structure is None else Shaken(structure.hertz, structure.zeta),
        dynamics_of(answers),
        drives_of(answers, actuator.name, len(channels)),
    )


def sampled_loops(
    study: TelescopeLoopStudy, optics: Optics, designs: Mapping[str, Given]
) -> dict[str, SampledLoop]:
    """Return the loops of the linear controllers among those designed, each alone, by name."""
    loops = {}
    for name, found in designs.items():
        if isinstance(found, Regulator):
            one = study.part("controller", name)
            actuator, sensors = study.part("actuator", one.actuator), study.sensors(one)
            free = np.isnan(stuck_of(actuator, actuator.channels(optics.light)))
            if not free.any():
                raise UserError(
                    f"controller.{name}: all {len(free)} channels of the actuator {actuator.name!r} are "
                    "stuck; leave one free, or the controller out."
                )
            answers = answering(optics.answers, [actuator.name])
            shown = shown_of(answers, len(optics.light))
            sights = []
            for sensor in sensors:
                readings = sensor.readings(optics.light)
                sees = readings @ optics.sights[actuator.name] * free
                sights.append(
                    Sight(in_series(actuator.dynamics(), sensor.dynamics()), sees, readings @ shown)
                )
            first, *further = sights
            loop = SampledLoop(timing_of(study, one), first.dynamics, first.sees, found)
            if answers:
                drives = drives_of(answers, actuator.name, len(free)) * free
                loop = replace(loop, structure=dynamics_of(answers), drives=drives, shown=first.shown)
            loop = replace(loop, further=tuple(further))
            loops[name] = loop
    return loops


def refuse_unstable(study: TelescopeLoopStudy, name: str, loop: SampledLoop, optics: Optics) -> None:
    """Raise UserError if a loop is unstable."""
    worst = worst_pole(loop)
    if grows(worst):
        said = growing(study, name, worst, optics)
        if loop.structure and not grows(worst_pole(replace(loop, structure=()))):
            said += f", by the mode {carrier(study, name, loop, optics)}; were all stiff, it would be stable"
        raise UserError(
            f"controller.{name} is unstable: {said}; lower gain or latency "
            f"(wavequake margins {study.study.name})."
        )


def carrier(study: TelescopeLoopStudy, name: str, loop: SampledLoop, optics: Optics) -> str:
    """Say which mode makes a loop unstable: that without which it grows least."""
    names = names_of(answering(optics.answers, [study.part("controller", name).actuator]))
    shown, drives = loop.modes()
    found = []
    for k, mode in enumerate(loop.structure):
        left = np.delete(np.arange(len(names)), k)
        modes = tuple(loop.structure[place] for place in left)
        without = replace(loop, structure=modes, drives=drives[left], shown=shown[:, left])
        hertz = np.sqrt(np.linalg.det(mode.a)) / (2 * np.pi)
        found.append((worst_pole(without).growth, f"{names[k]!r} ({hertz:.4g} Hz)"))
    return min(found)[1]


def refuse_unstable_together(study: TelescopeLoopStudy, one: Designed) -> None:
    """Raise UserError if loops that run beside each other, of any rates, drive each other without limits.

    They are kicked by noise in the first part of a run, and it is seen whether the kick dies away.
    """
    if len(one.loops) < 2 or not all(isinstance(loop.regulator, Regulator) for loop in one.loops):
        return
    free = [np.full(loop.actuator.stroke.shape, np.inf) for loop in one.loops]
    loops = [
        replace(
            loop,
            quantum=0.0,
            further=tuple(replace(eye, quantum=0.0) for eye in loop.further),
            actuator=replace(loop.actuator, stroke=most, slew=np.inf),
        )
        for loop, most in zip(one.loops, free, strict=True)
    ]
    slowest = max(loop.timing.period + loop.timing.latency for loop in loops)
    at = slowest * np.arange(1.0, _KICKED + 1)
    random = np.random.default_rng(0)
    seen = []
    for loop in loops:
        kick = random.standard_normal((frame_count(loop.timing, at[-1]), loop.readings, 1))
        kick[len(kick) // 10 :] = 0.0
        seen.append(kick)
    events = schedule([loop.timing for loop in loops], at)
    found = np.abs(run(loops, events, seen, len(at), dynamics_of(one.answers)).positions[..., 0])
    early, late = found[: _KICKED // 4].max(axis=0), found[-_KICKED // 4 :].max(axis=0)
    if not late.max() <= early.max():
        names = " and ".join(repr(each.name) for each in study.running(study.part("controller", one.name)))
        raise UserError(
            f"the controllers {names} are stable each alone, but not beside each other; lower the gain or "
            f"latency of one, or let them see and move different things."
        )


def growing(study: TelescopeLoopStudy, name: str, worst: Worst, optics: Optics) -> str:
    """Say which mode grows."""
    actuator = study.part("actuator", study.part("controller", name).actuator)
    channel = actuator.channels(optics.light)[int(worst.channels.argmax())]
    return f"{channel} of {actuator.name!r} grows by {worst.growth:.3g} 1/s at {worst.hertz:.4g} Hz"


def _designed(
    study: TelescopeLoopStudy,
    optics: Optics,
    one: Controller,
    designs: Mapping[str, Given],
) -> Designed:
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
    schedules = tuple(schedule([loop.timing for loop in loops], time[1:]) for time in optics.times)
    return Designed(one.name, actuators, answers, sight, tuple(loops), tuple(readings), None, schedules)


def refuse_saturated(bench: Bench) -> None:
    """Raise UserError if what an actuator would have to do is beyond its stroke most of the time.

    It is judged by the first case of each disturbance and a correction without delay or error.
    """
    study, optics = bench.study, bench.optics
    pairs = dict.fromkeys((one.sensor, one.actuator) for one in study.controller if one.sensor)
    for sensor, actuator in pairs:
        one = study.part("actuator", actuator)
        if one.stroke is None or study.part("sensor", sensor).dynamics().static_gain < 0.5:
            continue
        matrix = study.part("sensor", sensor).readings(optics.light, nominal=True)
        wants = -np.linalg.pinv(matrix @ optics.sights[actuator], rcond=_SEEN) @ matrix
        for index, entry in enumerate(study.disturbance):
            if not entry.share:
                continue
            seen = seen_of(study, optics, drawn(study, optics, index, 0))
            often = np.median(np.abs(seen @ wants.T), axis=0)
            if (often > one.stroke).any():
                channel = one.channels(optics.light)[int(often.argmax())]
                raise UserError(
                    f"actuator.{actuator} is saturated from the start: {entry.name!r} asks {channel} for "
                    f"{often.max():.3g} half of the time, but its stroke is {one.stroke:g}."
                )
