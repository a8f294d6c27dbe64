"""Which loops of a study cannot run: unstable ones, alone or beside each other, and saturated ones."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from wavequake.chain.loops.answers import answering, drives_of, dynamics_of, names_of, shown_of
from wavequake.chain.loops.block import stuck_of
from wavequake.chain.loops.blocks import LoopBlocks
from wavequake.chain.loops.closing import Given, grows
from wavequake.chain.loops.designed import Designed, Sighted, assembled, designs_of, timing_of
from wavequake.control.linear import Array
from wavequake.control.sampled.channel import in_series
from wavequake.control.sampled.regulator import Regulator
from wavequake.control.sampled.run import frame_count, run, schedule
from wavequake.control.sampled.stability import SampledLoop, Sight, Worst, worst_pole
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.population import Population

# Motions that are seen less than this share of others ask for nothing.
_SEEN = 1e-6
# Periods of the slowest loop for which loops beside each other are watched after a kick.
_KICKED = 400


def judged_loops(
    study: LoopBlocks,
    called: str,
    optics: Sighted,
    populations: Sequence[Population],
    looks: Sequence[Array],
    seen: Callable[[int], tuple[Array, Array]],
) -> tuple[tuple[Designed, ...], dict[str, SampledLoop]]:
    """Return the controllers of a study as they run, and the loops of linear ones, each alone, by name.

    Parameters
    ----------
    study : LoopBlocks
    called : str
        What the study is called.
    optics : Sighted
    populations : sequence of Population
    looks : sequence of ndarray
        Of each of them that has cases, see `wavequake.chain.loops.designed.assembled`.
    seen : callable
        Of a disturbance's place: instants (n,) of its first case, and what is seen then, (n, K).

    Raises
    ------
    UserError
        If a sensor reads what is not there, a controller cannot be designed, its loop is unstable, alone or
        beside others, or a stroke is too short; names the block.
    """
    for sensor in study.sensor:
        sensor.labels(optics.light)  # what those cannot read that no controller uses, too
    designs = designs_of(study, optics)
    linear = sampled_loops(study, optics, designs)
    for name, loop in linear.items():
        refuse_unstable(study, called, name, loop, optics)
    controllers = tuple(assembled(study, optics, one, designs, looks) for one in study.controller)
    for one in controllers:
        refuse_unstable_together(study, one)
    if any(one.stroke is not None or one.slew is not None for one in study.actuator):
        first = {entry.name: seen(index) for index, entry in enumerate(populations) if entry.share}
        refuse_saturated(study, optics, first)
    return controllers, linear


def sampled_loops(study: LoopBlocks, optics: Sighted, designs: Mapping[str, Given]) -> dict[str, SampledLoop]:
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


def refuse_unstable(study: LoopBlocks, called: str, name: str, loop: SampledLoop, optics: Sighted) -> None:
    """Raise UserError if a loop of the study that is called so is unstable."""
    worst = worst_pole(loop)
    if grows(worst):
        said = growing(study, name, worst, optics)
        if loop.structure and not grows(worst_pole(replace(loop, structure=()))):
            said += f", by the mode {carrier(study, name, loop, optics)}; were all stiff, it would be stable"
        raise UserError(
            f"controller.{name} is unstable: {said}; lower gain or latency (wavequake margins {called})."
        )


def carrier(study: LoopBlocks, name: str, loop: SampledLoop, optics: Sighted) -> str:
    """Say which mode makes a loop unstable: that without which it grows least."""
    names = names_of(answering(optics.answers, [study.part("controller", name).actuator]))
    shown, drives = loop.modes()
    found = []
    for name in dict.fromkeys(names):
        left = np.flatnonzero([one != name for one in names])
        modes = tuple(loop.structure[place] for place in left)
        without = replace(loop, structure=modes, drives=drives[left], shown=shown[:, left])
        mode = loop.structure[names.index(name)]
        # What floats follows at once: nothing moves its states.
        hertz = np.sqrt(np.linalg.det(mode.a)) / (2 * np.pi) if mode.b.any() else 0.0
        found.append((worst_pole(without).growth, f"{name!r} ({hertz:.4g} Hz)"))
    return min(found)[1]


def refuse_unstable_together(study: LoopBlocks, one: Designed) -> None:
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
            # What is stuck stands where the loops are at rest: only what they do to each other counts.
            actuator=replace(loop.actuator, stroke=most, slew=np.inf, stuck=0.0 * loop.actuator.stuck),
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


def growing(study: LoopBlocks, name: str, worst: Worst, optics: Sighted) -> str:
    """Say which mode grows."""
    actuator = study.part("actuator", study.part("controller", name).actuator)
    channel = actuator.channels(optics.light)[int(worst.channels.argmax())]
    return f"{channel} of {actuator.name!r} grows by {worst.growth:.3g} 1/s at {worst.hertz:.4g} Hz"


def refuse_saturated(study: LoopBlocks, optics: Sighted, seen: Mapping[str, tuple[Array, Array]]) -> None:
    """Raise UserError if what an actuator would have to do is beyond its stroke or slew most of the time.

    It is judged by a correction without delay or error of what is seen (n, K) at instants (n,) of the first
    case of each disturbance, by name.
    """
    pairs = dict.fromkeys((one.sensor, one.actuator) for one in study.controller if one.sensor)
    for sensor, actuator in pairs:
        one = study.part("actuator", actuator)
        limits = ((one.stroke, "stroke", ""), (one.slew, "slew", " per second"))
        if study.part("sensor", sensor).dynamics().static_gain < 0.5:
            continue
        matrix = study.part("sensor", sensor).readings(optics.light, nominal=True)
        wants = -np.linalg.pinv(matrix @ optics.sights[actuator], rcond=_SEEN) @ matrix
        for name, (time, values) in seen.items():
            asks = values @ wants.T
            rates = np.diff(asks, axis=0) / np.diff(time)[:, None]
            for moved, (limit, key, unit) in zip((asks, rates), limits, strict=True):
                often = np.median(np.abs(moved), axis=0)
                if limit is None or (often <= limit).all():
                    continue
                most = int(often.argmax())
                channel, when = one.channels(optics.light)[most], strongest(time, asks[:, most])
                raise UserError(
                    f"actuator.{actuator} is saturated from the start: {name!r} asks {channel} for "
                    f"{often.max():.3g}{unit} half of the time ({when}), but its {key} is {limit:g}."
                )


def strongest(time: Array, motion: Array) -> str:
    """Say at which frequency there is most of a motion (n,) at instants: 0 Hz where it stands, mostly."""
    even = np.linspace(time[0], time[-1], len(time))
    values = np.interp(even, time, motion)
    if values.mean() ** 2 >= values.var():
        return "most at 0 Hz, where it stands"
    sizes = np.abs(np.fft.rfft(values)) ** 2
    if len(even) % 2 == 0:
        sizes[-1] /= 2.0  # of the fastest there is no negative frequency
    place = 1 + int(sizes[1:].argmax())
    return f"most at {place / (len(even) * (even[1] - even[0])):.3g} Hz"
