"""The lens experiment: draw plants with all their errors, and run all controllers on the same blow.

Störkle 2018, Section 5.3 and 5.4, as a Monte Carlo over plants.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from wavequake.control.bench import COMPENSATOR, SENSITIVITIES, Bench, bench_modes
from wavequake.control.camera import Camera, CameraError, calibrate, camera_error, camera_reading
from wavequake.control.identification import Identified, Record, identify
from wavequake.control.linear import Array
from wavequake.control.loop import Follower, follow, late_deviation, peak_to_peak, remaining_image
from wavequake.control.plant import FreeRuns, swing
from wavequake.control.regulator import (
    ModalModel,
    ModalRegulator,
    modal_model,
    modal_regulator,
    side_by_side,
)
from wavequake.control.sampled.channel import Timing
from wavequake.control.sampled.regulator import Regulator, Stepped, played
from wavequake.control.sensor import SensorChain, positions, read_codes, read_positions
from wavequake.control.stage import Stage
from wavequake.control.thesis import SampledController, feed_forward, future_integration

CONTROLLERS = ("uncontrolled", "FF", "FI", "FF+FI", "modal", "identified")

# Runs a regulator in a control unit's firmware: codes of its converter (k,) to commands (k,) in m.
ControlUnit = Callable[[ModalRegulator, NDArray[np.int64]], Array]
# Runs a controller on free runs of plants: to command and position of each stage (c, k), m, so many seconds
# apart.
Beside = Callable[[Sequence["Plant"], FreeRuns, float], tuple[Array, Array]]

# Width of the arrays in which benches swing beside each other: constant, so that bits depend on nothing else.
TILE = 16
PLANT_STEP = 1e-3


@dataclass(frozen=True)
class Errors:
    """What the plant has and its nominal model lacks; standard deviations unless said otherwise.

    Attributes
    ----------
    stiffness : float
        Of the logarithm of each spring.
    friction : float
        Coulomb friction of each lens's bearing, N.
    stage_gain, stage_poles : float
        Of the logarithms of the stage's gain, its real pole and its pair of poles.
    blow : float
        Of the logarithm of a blow's strength.
    trigger : float
        Longest time from the hammer's first touch to the step that the trigger begins, s; evenly distributed.
        The identification's run is recorded with the hammer's own signal, which has no such lag.
    """

    stiffness: float = 0.02
    friction: float = 0.3e-3
    stage_gain: float = 0.01
    stage_poles: float = 0.05
    blow: float = 0.0
    trigger: float = 0.0


@dataclass(frozen=True)
class Settings:
    """Sample times and delays of the controllers, s, and the noise that the modal observers reckon with.

    Attributes
    ----------
    ff_step, fi_step, both_step, modal_step : float
        Sample times of FF, FI, FF+FI and the modal regulators.
    ff_delay, fi_delay, both_delay, modal_delay : float
        From sampling to the command.
    nominal_noise, identified_noise : float
        Process noise per step, as shares of the modes' amplitudes after the blow.
    trigger_late : float
        By how much the modal regulators expect the trigger to be late, s.
    """

    ff_step: float = 0.002
    fi_step: float = 0.008
    both_step: float = 0.002
    modal_step: float = 0.002
    ff_delay: float = 0.001
    fi_delay: float = 0.003
    both_delay: float = 0.001
    modal_delay: float = 0.0002
    nominal_noise: float = 0.01
    identified_noise: float = 0.003
    trigger_late: float = 0.0


@dataclass(frozen=True)
class Designs:
    """Everything that is designed on nominal models, before a plant is known."""

    stage: Stage
    settings: Settings
    thesis: tuple[SampledController, ...]
    model: ModalModel
    regulator: ModalRegulator


@dataclass(frozen=True)
class Plant:
    """One draw: what swings, what moves lens 5, what is measured, two blows, the second seen late."""

    bench: Bench
    stage: Stage
    phases: Array
    blows: tuple[float, float]
    noise: Array
    frame_noise: Array
    late: float = 0.0


@dataclass(frozen=True)
class Runs:
    """What c plants do under all controllers; lengths in m.

    Attributes
    ----------
    time : ndarray, shape (k,)
    image, command, stage : ndarray, shape (c, controller, k)
        What is left of the image motion, held commands, positions of the stage.
    lens, measured : ndarray, shape (c, k)
        Lens 4, and what the control unit takes for it.
    identified : tuple of Identified
    regulators : tuple of ModalRegulator
        Those that units ran, one per plant.
    """

    time: Array
    image: Array
    command: Array
    stage: Array
    lens: Array
    measured: Array
    identified: tuple[Identified, ...]
    regulators: tuple[ModalRegulator, ...]


def design(bench: Bench, stage: Stage, settings: Settings) -> Designs:
    """Design all controllers on nominal models.

    Raises
    ------
    UserError
        If lens 4 does not see a mode (says which), or ode3 is unstable at a sample time (says its spectral
        radius).
    """
    bench_modes(bench)  # says at once if a mode does not swing
    both = feed_forward(bench, stage, settings.both_step, settings.both_delay, ahead=2)
    thesis = (
        feed_forward(bench, stage, settings.ff_step, settings.ff_delay),
        future_integration(bench, settings.fi_step, settings.fi_delay),
        both,
    )
    model = modal_model(bench)
    return Designs(
        stage, settings, thesis, model, regulator(model, stage, settings, "modal", settings.nominal_noise)
    )


def regulator(
    model: ModalModel, stage: Stage, settings: Settings, name: str, process_noise: float
) -> ModalRegulator:
    """Design a modal regulator with the sample time and delay of the settings."""
    return modal_regulator(
        model, stage, settings.modal_step, settings.modal_delay, name=name, process_noise=process_noise,
        late=settings.trigger_late,
    )  # fmt: skip


def tuned_regulator(designs: Designs, found: Identified) -> ModalRegulator:
    """Design the modal regulator of an identified plant."""
    noise = designs.settings.identified_noise
    return regulator(found.model, designs.stage, designs.settings, "identified", noise)


def draw_plant(
    rng: np.random.Generator,
    bench: Bench,
    stage: Stage,
    errors: Errors,
    waves: int,
    instants: int,
    frames: int,
) -> Plant:
    """Draw one plant around nominal models; the same generator gives paired plants for other springs."""
    scatter = np.exp(errors.stiffness * rng.standard_normal(18))
    gain, real, pair = np.exp(
        np.array([errors.stage_gain, errors.stage_poles, errors.stage_poles]) * rng.standard_normal(3)
    )
    blows = np.exp(errors.blow * rng.standard_normal(2))
    phases = rng.uniform(0, 2 * np.pi, waves)
    noise = rng.standard_normal((2, instants))
    frame_noise = rng.standard_normal(frames)
    late = errors.trigger * rng.uniform()
    shaken = replace(
        bench,
        lens_springs=bench.lens_springs * scatter[:6],
        ring_springs=bench.ring_springs * scatter[6:12],
        couplings=bench.couplings * scatter[12:17],
        housing_spring=bench.housing_spring * float(scatter[17]),
    )
    poles = tuple(pole * (real if np.imag(pole) == 0 else pair) for pole in stage.poles)
    moved = replace(stage, poles=poles, gain=stage.gain * float(gain))
    struck = float(blows[0]), float(blows[1])
    return Plant(shaken, moved, phases, struck, noise, frame_noise, float(late))


def camera_of(camera: Camera, seed: int) -> CameraError:
    """Calibrate the camera with the stage and return what its readings are off (Fig. 5.24)."""
    rng = np.random.default_rng(seed)
    calibration = calibrate(camera, 1e-3 * np.arange(-3, 4), SENSITIVITIES[COMPENSATOR])
    return camera_error(camera, calibration, rng)


def instants_of(duration: float) -> int:
    """Return the number of instants of the plant's own grid, the first at 0."""
    return round(duration / PLANT_STEP) + 1


def run_plants(
    designs: Designs,
    plants: Sequence[Plant],
    chain: SensorChain,
    camera: CameraError,
    *,
    friction: float,
    duration: float,
    frame_rate: float = 200.0,
    output_step: float = 0.002,
    units: Sequence[ControlUnit] = (),
    unit_design: str = "nominal",
    beside: Sequence[Beside] = (),
) -> Runs:
    """Hit each plant twice: one uncontrolled run identifies it, the other one is what controllers face.

    Parameters
    ----------
    designs : Designs
    plants : sequence of Plant
        At most `TILE`.
    chain : SensorChain
    camera : CameraError
        For the identification alone.
    friction : float
        N.
    duration : float
        s.
    frame_rate : float
        Hz.
    output_step : float
        Of the histories that are returned, a multiple of the plant's step, s.
    units : sequence of ControlUnit
        Run beside the controllers, on the same readings.
    unit_design : str
        The modal regulator that they run: "nominal", or "identified", each plant's own.
    beside : sequence of Beside
        Further controllers.

    Raises
    ------
    UserError
        If an identification fails, or a time does not fit the plant's step.
    """
    width = len(plants)
    padded = [*plants, *[plants[-1]] * (TILE - width)]
    first, second = (_hit(padded, run, friction, duration, bool(beside)) for run in (0, 1))
    phases, noise = np.stack([plant.phases for plant in padded]), np.stack([plant.noise for plant in padded])
    found = tuple(
        _identified(designs, plant, first, row, chain, camera, frame_rate) for row, plant in enumerate(plants)
    )
    codes = read_codes(chain, second.measured, phases, noise[:, 1])
    measured = positions(chain, codes)
    tuned = [tuned_regulator(designs, one) for one in found]
    tuned = [*tuned, *[tuned[-1]] * (TILE - width)]
    chosen = tuned if unit_design == "identified" else [designs.regulator] * TILE
    sampled = codes[:width, :: _every(designs.settings.modal_step)]
    given = [[unit(*one) for one in zip(chosen, sampled, strict=False)] for unit in units]
    own: tuple[SampledController | ModalRegulator, ...] = (*designs.thesis, designs.regulator)
    followers = [
        *(_follower(one, one.given, measured) for one in own),
        _follower(designs.regulator, side_by_side(tuned), measured),
        *(_follower(designs.regulator, _recorded(each), measured) for each in given),
    ]
    every = _every(output_step)
    stages, kept = [plant.stage for plant in padded], slice(None, None, every)
    count = len(second.time[kept])
    still = np.zeros((TILE, count))
    moved = [(still, still), *(follow(one, stages, every * PLANT_STEP, count) for one in followers)]
    moved += [one(padded, second, every * PLANT_STEP) for one in beside]
    command, stage = (np.stack([one[side][:width] for one in moved], axis=1) for side in (0, 1))
    return Runs(
        second.time[kept], remaining_image(second.image[:width, None, kept], stage), command, stage,
        second.measured[:width, kept], measured[:width, kept], found, tuple(chosen[:width]),
    )  # fmt: skip


def _follower(
    one: SampledController | ModalRegulator, given: Regulator | Stepped, measured: Array
) -> Follower:
    """Return what runs with a controller's timing; it reads at the trigger for the first time."""
    timing = Timing(one.sample_time, one.sample_time, 1, one.compute_delay)
    return Follower(one.name, given, timing, one.readings(measured[:, :: _every(one.sample_time)]))


def _recorded(commands: Sequence[Array]) -> Stepped:
    """Return what plays the commands (k,) that units gave, and the last ones on the rest of a tile."""
    return played(np.stack([*commands, *[commands[-1]] * (TILE - len(commands))], axis=-1)[:, None])


def _hit(
    plants: Sequence[Plant], run: int, friction: float, duration: float, keep_lenses: bool = False
) -> FreeRuns:
    blows = np.array([plant.blows[run] for plant in plants])
    late = np.array([plant.late if run else 0.0 for plant in plants])
    benches, keep = [plant.bench for plant in plants], keep_lenses and run == 1
    return swing(benches, blows, friction=friction, duration=duration, late=late, keep_lenses=keep)


def identify_plant(
    designs: Designs,
    plant: Plant,
    chain: SensorChain,
    camera: CameraError,
    *,
    friction: float,
    duration: float,
    frame_rate: float = 200.0,
) -> Identified:
    """Identify a plant from its first, uncontrolled run: what `run_plants` finds, bit by bit."""
    first = _hit([plant] * TILE, 0, friction, duration)
    return _identified(designs, plant, first, 0, chain, camera, frame_rate)


def _every(time: float) -> int:
    return max(1, round(time / PLANT_STEP))


def _identified(
    designs: Designs,
    plant: Plant,
    runs: FreeRuns,
    row: int,
    chain: SensorChain,
    camera: CameraError,
    frame_rate: float,
) -> Identified:
    """Identify one plant from its first run: lens 4 at the controller's instants, image at the camera's."""
    every, frames = _every(0.002), _every(1 / frame_rate)
    lens = read_positions(chain, runs.measured[row], plant.phases, plant.noise[0])[::every]
    image = runs.image[row, ::frames]
    seen = camera_reading(camera, image, plant.frame_noise[: len(image)])
    record = Record(runs.time[::every], lens, runs.time[::frames], seen)
    return identify(record, designs.model)


def residuals(runs: Runs) -> tuple[Array, Array]:
    """Return ranges and standard deviations after 1 s, (c, controller), in % of uncontrolled (Fig. 5.33)."""
    whole, late = peak_to_peak(runs.image), late_deviation(runs.image, runs.time)
    return 100 * whole / whole[:, :1], 100 * late / late[:, :1]
