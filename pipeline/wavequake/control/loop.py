"""Controllers on free runs: commands, motion of the stage, image that is left (Störkle 2018, Eq. 5.5).

The stage carries lens 5 alone and does not shake the chain, which swings the same under all controllers.
They run as any other loop does, on a batch of benches whose stages differ.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.control.bench import COMPENSATOR, SENSITIVITIES
from wavequake.control.linear import Array
from wavequake.control.regulator import ModalRegulator
from wavequake.control.sampled.channel import Dynamics, Timing
from wavequake.control.sampled.readings import Frames
from wavequake.control.sampled.regulator import Regulator, Stepped, advance, answer, played, start
from wavequake.control.sampled.run import Actuator, Eye, Loop, Schedule, run, schedule
from wavequake.control.sensor import quantized_command
from wavequake.control.stage import Stage, stage_model
from wavequake.control.thesis import SampledController
from wavequake.errors import UserError
from wavequake.prepared import prepared


@dataclass(frozen=True)
class Follower:
    """A controller with all that it reads on c benches beside each other.

    Attributes
    ----------
    name : str
    given : Regulator or Stepped
    timing : Timing
        From a reading to the command's arrival at the stage, whose pure delay comes on top.
    readings : Frames, shape (frames, m, c)
        Without what the stage does.
    first : float
        When the first of them is read, s; at most a frame after 0.
    eyes : tuple of Eye
        How readings follow the stage; none: they do not.
    unit : float
        Of commands, m.
    """

    name: str
    given: Regulator | Stepped
    timing: Timing
    readings: Frames
    first: float = 0.0
    eyes: tuple[Eye, ...] = ()
    unit: float = 1.0


def follow(one: Follower, stages: Stage | Sequence[Stage], step: float, count: int) -> tuple[Array, Array]:
    """Return commands, held, and positions of the stage, (c, count), in m, `step` s apart from 0 on.

    The control unit's converter rounds commands. `stages` is one for all benches, or one each, with equally
    many poles. Where a command acts just then, the position is that after it.

    Raises
    ------
    UserError
        If it diverges.
    """
    each = [stages] if isinstance(stages, Stage) else list(stages)
    delays = np.broadcast_to([stage.delay for stage in each], one.readings.shape[2])
    late = np.unique(delays)
    if len(late) == 1:
        return _followed(one, each, late[0], delays == late[0], step, count)
    # All benches of a run have one delay: of each run those count whose own it is.
    held, moved = np.empty((2, len(delays), count))
    for delay in late:
        mine = delays == delay
        held[mine], moved[mine] = _followed(one, each, delay, mine, step, count)
    return held, moved


def _followed(
    one: Follower, stages: Sequence[Stage], delay: float, mine: NDArray[np.bool_], step: float, count: int
) -> tuple[Array, Array]:
    """Return the same of the benches `mine` (c,), when all stages have this pure delay."""
    moving = tuple(dynamics_of(stage) for stage in stages)
    plain, benches = one.timing, one.readings.shape[2]
    timing = Timing(plain.frame, plain.integration, plain.frames, plain.latency + delay)
    commands = list[Array]()
    unit = _through_converter(one, benches, commands)
    blind = Eye(np.zeros((one.readings.shape[1], 1)))
    eye, *further = one.eyes or (blind,)
    actuator = Actuator(
        moving if len(moving) > 1 else moving[0], np.full(1, np.inf), np.inf, np.full(1, np.nan)
    )
    loop = Loop(timing, unit, actuator, eye.sees, eye.quantum, eye.sensor, further=tuple(further))
    # Loops begin a frame before their first reading.
    events = _events(timing, timing.frame - one.first, step, count)
    found = run([loop], events, [one.readings], count)
    if found.diverged[mine].any():
        raise UserError(f"It diverges under the controller {one.name!r}.")
    began = one.first + (timing.frames - 1) * timing.frame
    periods = np.floor((step * np.arange(count) - began) / timing.period + 1e-9).astype(np.int64)
    given = np.concatenate([np.zeros((1, benches)), *commands])
    held = given[np.clip(periods + 1, 0, len(given) - 1)].T
    return one.unit * held[mine], one.unit * found.positions[:, 0].T[mine]


def dynamics_of(stage: Stage) -> Dynamics:
    """Return how a stage follows, without its pure delay."""
    model = stage_model(stage)
    return Dynamics(model.a, model.b[:, 0], model.c[0], float(model.d[0, 0]))


@prepared(maxsize=16)
def _events(timing: Timing, lead: float, step: float, count: int) -> Schedule:
    """Return the events of a loop that begins `lead` s before it is looked at."""
    return schedule([timing], np.asarray(lead + step * np.arange(count)), jumped=True)


def _through_converter(one: Follower, benches: int, commands: list[Array]) -> Stepped:
    """Return a controller whose commands (1, c) the control unit's converter puts out and a list keeps."""
    rest = start(one.given, benches)

    def function(states: Array, readings: Array) -> tuple[Array, Array]:
        own, wanted = advance(one.given, states.reshape(rest.shape), readings)
        put = quantized_command(one.unit * wanted) / one.unit
        commands.append(put)
        return own.reshape(-1, benches), put

    return Stepped(rest.size // benches, function)


def commands_of(one: SampledController | ModalRegulator, measured: Array) -> Array:
    """Return the commands (c, k) of a controller, m, for positions (c, k) of lens 4 at its instants, m."""
    return np.asarray(answer(one.given, one.readings(measured))[:, 0].T)


def stage_motion(
    stages: Stage | Sequence[Stage],
    commands: Array,
    sample_time: float,
    compute_delay: float,
    step: float,
    count: int,
) -> Array:
    """Return positions (c, count) of stages in m, `step` s apart, for commands (c, k) in m, the last held."""
    blind = np.zeros((int((count - 1) * step / sample_time) + 2, 1, len(commands)))
    timing = Timing(sample_time, sample_time, 1, compute_delay)
    one = Follower("recorded", played(commands.T[:, None]), timing, blind)
    return follow(one, stages, step, count)[1]


def remaining_image(free: Array, stage: Array) -> Array:
    """Return the image motion a = a_F + s_5 y_M, m (Eq. 5.5)."""
    return np.asarray(free + SENSITIVITIES[COMPENSATOR] * stage)


def peak_to_peak(image: Array) -> Array:
    """Return the range of image motion over time, (...)."""
    return np.asarray(np.ptp(image, axis=-1))


def late_deviation(image: Array, time: Array, after: float = 1.0) -> Array:
    """Return the standard deviation of image motion later than `after` s, as in Störkle 2018, Fig. 5.33."""
    late = time > after
    if not late.any():
        raise UserError(f"The run ends at {time[-1]:g} s; the standard deviation is taken after {after:g} s.")
    return np.asarray(image[..., late].std(axis=-1))
