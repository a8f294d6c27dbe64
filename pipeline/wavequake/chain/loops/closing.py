"""What closing a loop takes, whatever the plant: parts that fit, timing, design, and what sensors read."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from wavequake.chain.loops.block import Controller, Sensor
from wavequake.chain.loops.design import Array, Design
from wavequake.chain.loops.light import Light
from wavequake.control.sampled.channel import Dynamics, Timing
from wavequake.control.sampled.readings import mean_blocks
from wavequake.control.sampled.regulator import Instant, Regulator, Stepped, shape_of
from wavequake.control.sampled.run import frame_count
from wavequake.control.sampled.stability import Worst
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.motion import generator
from wavequake.prepared import prepared

Given = Regulator | Stepped | Instant | None
_WHOLE = 1e-9
# A pole this near to the circle neither grows nor decays within a run.
_GROWS = 1e-9
# Frames of a sensor in a case, whose events are kept.
_FRAMES = 1_000_000


def check_part(one: Controller, kind: str, known: Sequence[str]) -> None:
    """Raise ValueError unless a controller names one of the parts of a kind ("sensor" or "actuator")."""
    asked = getattr(one, kind)
    if not known:
        raise ValueError(f"the controller {one.name!r} needs {kind}s, but there is no [[{kind}]]")
    if asked not in known:
        said = f"names the {kind} {asked!r}" if asked else f"names no {kind}"
        raise ValueError(f"the controller {one.name!r} {said}; there is {', '.join(known)}")


def check_sensors(one: Controller, sensors: Sequence[Sensor]) -> None:
    """Raise ValueError unless the sensors that a controller also reads are there and fit its first one."""
    if one.also_reads and not one.fuses:
        raise ValueError(
            f"the controller {one.name!r} takes one sensor; leave also_reads out, or take "
            "lqg-fusion, state-space or a function"
        )
    known = {each.name: each for each in sensors}
    first = known[one.sensor]
    for place, name in enumerate(one.also_reads):
        if name not in known:
            raise ValueError(f"the controller {one.name!r} also reads {name!r}; there is {', '.join(known)}")
        if name in (one.sensor, *one.also_reads[:place]):
            raise ValueError(f"the controller {one.name!r} reads {name!r} twice")
        other = known[name]
        if (other.rate_hz, other.integration) != (first.rate_hz, first.integration):
            raise ValueError(
                f"the sensors {one.sensor!r} and {name!r} of the controller {one.name!r} have different "
                "frames; give both one rate_hz and integration"
            )


def check_rates(one: Controller, sensor: Sensor, runs: Iterable[tuple[str, float]]) -> None:
    """Raise ValueError unless rates divide, and commands act within each of some runs, (words, s)."""
    rate = sensor.rate_hz
    frames = rate / (one.rate_hz or rate)
    if frames < 1 - _WHOLE or abs(frames - round(frames)) > _WHOLE * frames:
        raise ValueError(
            f"the controller {one.name!r} gives {one.rate_hz:g} commands per second, but its sensor "
            f"{one.sensor!r} {rate:g} frames, which is no whole multiple of it"
        )
    first = (1.0 + one.latency_frames) * round(frames) / rate
    for words, duration in runs:
        if rate * duration > _FRAMES:
            raise ValueError(
                f"the sensor {one.sensor!r} has {rate * duration:.3g} frames in a case of "
                f"{words} ({duration:g} s); lower rate_hz, to {_FRAMES:,} or fewer"
            )
        if first >= duration:
            raise ValueError(
                f"the first command of the controller {one.name!r} acts after {first:g} s, when the cases of "
                f"{words} are over ({duration:g} s)"
            )


def timing_of(one: Controller, sensor: Sensor) -> Timing:
    """Return when a controller reads and acts."""
    frame = 1.0 / sensor.rate_hz
    frames = round(sensor.rate_hz / (one.rate_hz or sensor.rate_hz))
    return Timing(frame, sensor.integration * frame, frames, one.latency_frames * frames * frame)


def design(one: Controller, asked: Design) -> Given:
    """Return what a controller came to: a regulator, what acts at once, or None.

    Raises
    ------
    UserError
        If its design fails, or gives what does not fit sensor and actuator; names the controller.
    """
    wanted = len(asked.channels), asked.read
    try:
        found = one.design(asked)
        shape = wanted if found is None else shape_of(found, wanted[1])
    except UserError:
        raise
    except Exception as error:  # what others wrote fails in ways of its own
        raise UserError(
            f"controller.{one.name} cannot be designed: {type(error).__name__}: {error}."
        ) from error
    if shape != wanted:
        raise UserError(
            f"controller.{one.name} gives {shape[0]} commands of {shape[1]} readings; the actuator "
            f"{asked.actuator!r} takes {wanted[0]}, its sensors give {wanted[1]}."
        )
    return found


def grows(pole: Worst) -> bool:
    """Return whether a loop with this pole is unstable: what neither grows nor decays is off by rounding."""
    return abs(pole.value) > 1.0 + _GROWS


def readings(
    time: Array,
    seen: Array,
    timing: Timing,
    sensors: Sequence[Sensor],
    matrices: Sequence[Array],
    light: Light,
    seed: int,
    case: int,
) -> Iterator[Array]:
    """Yield the readings (frames, m) of a loop's sensors of a disturbance, with noise, by blocks of frames.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Rising, s.
    seen : ndarray, shape (n, K)
        All that `light` has of the disturbance at these instants, straight lines between.
    timing : Timing
    sensors : sequence of Sensor
    matrices : sequence of ndarray, shape (m, K)
        What each reads of all that is seen.
    light : Light
    seed, case : int
        Of the noise, which does not depend on the controller.
    """
    begins, ends = _spans(timing, frame_count(timing, time[-1]))
    each = [
        _means(time, seen, matrix, begins, ends, sensor.dynamics())
        for sensor, matrix in zip(sensors, matrices, strict=True)
    ]
    noises = [generator(seed, f"sensor {sensor.name}", case) for sensor in sensors]
    sizes = [sensor.noise_rms(light) for sensor in sensors]
    for blocks in zip(*each, strict=True):
        yield np.hstack(
            [
                clean + size * random.standard_normal(clean.shape)
                for clean, size, random in zip(blocks, sizes, noises, strict=True)
            ]
        )


@prepared(maxsize=8)
def _spans(timing: Timing, frames: int) -> tuple[Array, Array]:
    """Return begins and ends of a sensor's averages, s: one for all cases."""
    ends: Array = np.arange(1.0, frames + 1) * timing.frame
    return ends - timing.integration, ends


def _means(
    time: Array, seen: Array, matrix: Array, begins: Array, ends: Array, sensor: Dynamics
) -> Iterator[Array]:
    """Yield mean readings (frames, m) of what is seen (n, K), by blocks."""
    if len(sensor):
        yield from mean_blocks(time, seen @ matrix.T, begins, ends, sensor)
        return
    for block in mean_blocks(time, seen, begins, ends):
        yield np.asarray(block @ matrix.T)
