"""Controllers of the registry on the lens bench: its image and lenses are what sensors read, its stage moves.

The stage does not shake the chain, so a loop closes through the image alone: a = a_F + s_5 y (Eq. 5.5).
Loops are those of telescopes, exact between events; the control unit's converter rounds their commands.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from wavequake.chain.loops import closing
from wavequake.chain.loops.block import Controller, Sensor
from wavequake.chain.loops.design import Design, Shaken, Watch
from wavequake.chain.loops.light import Light
from wavequake.control.bench import COMPENSATOR, LENSES, SENSITIVITIES, Bench, bench_modes, force_column
from wavequake.control.experiment import PLANT_STEP, Beside, Plant
from wavequake.control.hammer import HAMMER
from wavequake.control.linear import Array
from wavequake.control.loop import Follower, dynamics_of, follow
from wavequake.control.plant import FreeRuns
from wavequake.control.regulator import blow_spectrum
from wavequake.control.sampled.channel import Timing, in_series
from wavequake.control.sampled.readings import Streamed
from wavequake.control.sampled.regulator import Instant, Regulator
from wavequake.control.sampled.run import Eye, frame_count
from wavequake.control.sampled.stability import SampledLoop, Sight, worst_pole
from wavequake.control.stage import Stage
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.layout import SegmentLayout
from wavequake.prepared import prepared
from wavequake.workflows.kinds import study_of
from wavequake.workflows.lens.bench import bench_of, stage_of
from wavequake.workflows.lens.study import STAGE, LensStudy
from wavequake.workflows.loops.curves import Looked, noise_of
from wavequake.workflows.loops.loop_margins import Makers, sampled_loop

OPEN = (
    "The bench's own controllers read lens 4, which the stage does not move: they feed forward, and the gain "
    "of their loop is 0 at every frequency."
)
"""Why there are no margins of controllers that are no [[loop]]."""

# Of the image and the stage's positions, and of the lenses, per m.
_UM, _NM = 1e6, 1e9
_NOTHING = SegmentLayout(
    (), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 1, 2)), np.zeros(0), owner="the lens bench"
)
# What sensors see: the image's place along x and y in um, where a telescope's line of sight has mas, and the
# lenses' in nm.
LIGHT = Light(
    3, 0.0, 1.0, _NOTHING, bodies_too=True, nodes=tuple(f"lens-{lens + 1}" for lens in range(LENSES))
)
_THERE = [0, 1, *range(len(LIGHT) - LENSES, len(LIGHT))]


def _seen(image: Array, lenses: Array, kept: Sequence[int]) -> Array:
    """Return all that sensors see (n, K) of image motion (n,) and positions of some lenses (n, l), m."""
    found = np.zeros((len(image), len(LIGHT)))
    found[:, 0] = _UM * image
    found[:, np.array(_THERE)[2:][list(kept)]] = _NM * lenses
    return found


# Of 1 um of the stage, which carries lens 5.
_SIGHT = _seen(np.array([SENSITIVITIES[COMPENSATOR]]), np.ones((1, 1)), [COMPENSATOR]).T / _UM


def _modes(bench: Bench) -> Shaken:
    """Return the modes of a bench, by what sensors see of them just after a blow."""
    modes = bench_modes(bench)
    driven = force_column(bench) @ modes.shapes * blow_spectrum(HAMMER, modes.poles)
    size = np.abs(driven / modes.poles.imag) / np.sqrt(2.0)
    lenses = modes.shapes[: len(bench.lenses)] * size
    image = np.array(SENSITIVITIES)[bench.lenses] @ lenses
    names = tuple(f"mode {k + 1}" for k in range(len(modes.omega)))
    zeta = -modes.poles.real / modes.omega
    return Shaken(names, modes.omega / (2 * np.pi), zeta, _seen(image, lenses.T, bench.lenses).T)


@dataclass(frozen=True)
class Closed:
    """A controller on the bench.

    Attributes
    ----------
    name : str
    given : Regulator, Stepped, Instant or None
    timing : Timing
        With the pure delay of the stage.
    sensors : tuple of Sensor
    matrices : tuple of ndarray, shape (m, K)
        What each reads of all that is seen.
    gain : float
        Of the nominal stage, for a constant command.
    """

    name: str
    given: closing.Given
    timing: Timing
    sensors: tuple[Sensor, ...]
    matrices: tuple[Array, ...]
    gain: float


@prepared(maxsize=8)
def closed_loops(study_text: str, springs: str) -> tuple[Closed, ...]:
    """Design the controllers of a study for a configuration of springs.

    Raises
    ------
    UserError
        If one cannot be designed, or its loop with the nominal stage is unstable; names it.
    """
    study = study_of(study_text)
    found = _designed(study, springs)
    for one in found:
        if isinstance(one.given, Regulator):
            worst = worst_pole(_sampled(one, stage_of(study)))
            if closing.grows(worst):
                raise UserError(
                    f"loop.{one.name} is unstable: {STAGE!r} grows by {worst.growth:.3g} 1/s at "
                    f"{worst.hertz:.4g} Hz; lower gain or latency (wavequake margins {study.study.name})."
                )
    return found


def _designed(study: LensStudy, springs: str) -> tuple[Closed, ...]:
    return tuple(_closed(study, springs, one) for one in study.loop)


def _closed(study: LensStudy, springs: str, one: Controller) -> Closed:
    sensors, stage = study.sensors(one), stage_of(study)
    if not sensors:
        return Closed(one.name, None, Timing(1.0, 1.0, 1, 0.0), (), (), stage.gain)
    asked, matrices = asked_of(study, springs, one), tuple(sensor.readings(LIGHT) for sensor in sensors)
    return Closed(one.name, closing.design(one, asked), asked.timing, sensors, matrices, stage.gain)


def asked_of(study: LensStudy, springs: str, one: Controller) -> Design:
    """Return what a controller with sensors is designed for on the nominal bench."""
    sensors, stage = study.sensors(one), stage_of(study)
    plain = closing.timing_of(one, sensors[0])
    timing = Timing(plain.frame, plain.integration, plain.frames, plain.latency + stage.delay)
    shaken = _modes(bench_of(study, springs))
    watched = []
    for sensor in sensors:
        reads = sensor.readings(LIGHT, nominal=True)
        if not (len(reads) and reads[:, _THERE].any(axis=1).all()):
            raise UserError(
                f"sensor.{sensor.name} reads what the lens bench does not have; it has a line of sight and "
                f"the nodes {LIGHT.nodes[0]} to {LIGHT.nodes[-1]}."
            )
        watched.append(
            Watch(
                sensor.name,
                sensor.labels(LIGHT),
                reads @ _SIGHT * stage.gain,
                sensor.noise_rms(LIGHT) / np.sqrt(timing.frames),
                sensor.dynamics(),
                reads @ shaken.seen,
                np.zeros((len(reads), 0)),
            )
        )
    # A constant command of 1 moves the stage by its gain; designs take channels of gain 1.
    follows = dynamics_of(replace(stage, gain=1.0))
    return Design(one.name, STAGE, tuple(watched), (STAGE,), follows, timing, shaken, (), np.zeros((0, 1)))


def _sampled(one: Closed, stage: Stage) -> SampledLoop:
    """Return the loop of a linear controller with the nominal stage."""
    assert isinstance(one.given, Regulator)
    sights = [
        Sight(in_series(dynamics_of(stage), sensor.dynamics()), matrix @ _SIGHT)
        for sensor, matrix in zip(one.sensors, one.matrices, strict=True)
    ]
    first, *further = sights
    return SampledLoop(one.timing, first.dynamics, first.sees, one.given, further=tuple(further))


def beside(study_text: str, springs: str, realizations: Sequence[int]) -> tuple[Beside, ...]:
    """Return what runs each controller of a study on plants of these realizations."""
    seed = study_of(study_text).study.seed
    return tuple(
        partial(_follow, one, seed, tuple(realizations)) for one in closed_loops(study_text, springs)
    )


def _follow(
    one: Closed, seed: int, realizations: Sequence[int], plants: Sequence[Plant], runs: FreeRuns, step: float
) -> tuple[Array, Array]:
    """Return commands and positions of the stages (c, k), m, under a controller on free runs of plants.

    What is beyond the realizations repeats the last one.

    Raises
    ------
    UserError
        If it diverges.
    """
    assert runs.lenses is not None
    every = round(step / PLANT_STEP)
    count = len(runs.time[::every])
    still = np.zeros((len(plants), count))
    if one.given is None:
        return still, still
    seen = [
        _seen(image, lenses.T, plant.bench.lenses)
        for image, lenses, plant in zip(runs.image, runs.lenses, plants, strict=True)
    ]
    if isinstance(one.given, Instant):
        wanted = one.given.decoupling @ np.vstack(one.matrices)
        command = np.stack([-(wanted @ each[::every].T)[0] / _UM for each in seen])
        return command, one.gain * command
    cases = [realizations[min(row, len(realizations) - 1)] for row in range(len(plants))]
    given = [
        closing.readings(runs.time, each, one.timing, one.sensors, one.matrices, LIGHT, seed, case)
        for each, case in zip(seen, cases, strict=True)
    ]
    frames = frame_count(one.timing, runs.time[-1])
    streamed = Streamed(frames, sum(len(matrix) for matrix in one.matrices), given)
    eyes = tuple(
        Eye(matrix @ _SIGHT, sensor.quantum, sensor.dynamics())
        for matrix, sensor in zip(one.matrices, one.sensors, strict=True)
    )
    timing = replace(one.timing, latency=one.timing.latency - plants[0].stage.delay)
    follower = Follower(one.name, one.given, timing, streamed, timing.frame, eyes, 1.0 / _UM)
    return follow(follower, [plant.stage for plant in plants], step, count)


def looked(study: LensStudy, springs: str) -> dict[str, Looked]:
    """Return every linear controller of a study, each alone, with the nominal stage, and the image in um."""
    stage = stage_of(study)
    look = Sight(dynamics_of(stage), _SIGHT[:2])
    return {
        one.name: Looked(_sampled(one, stage), look, noise_of(one.sensors, LIGHT, one.timing.frames))
        for one in _designed(study, springs)
        if isinstance(one.given, Regulator)
    }


def loops(study: LensStudy) -> Makers:
    """Return every linear controller of a study, each alone, with the nominal stage.

    Raises
    ------
    UserError
        If there is none.
    """
    makers = {}
    for springs in study.bench.springs:
        for known, one in looked(study, springs).items():
            name = f"{known}, {springs} springs" if len(study.bench.springs) > 1 else known
            makers[name] = partial(sampled_loop, name, one.loop)
    if not makers:
        raise UserError(f"{study.study.name} has no linear [[loop]], so that there are no margins. {OPEN}")
    return makers
