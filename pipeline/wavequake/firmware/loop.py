"""The firmware in the loop with the simulated bench: what a board reads, and what its commands leave."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavequake.control.bench import Bench
from wavequake.control.linear import Array
from wavequake.control.loop import late_deviation, peak_to_peak, remaining_image, stage_motion
from wavequake.control.plant import swing
from wavequake.control.regulator import ModalRegulator
from wavequake.control.sensor import SensorChain, adc_codes, dac_codes, quadrature_counts, strip_reading
from wavequake.control.stage import Stage
from wavequake.errors import UserError
from wavequake.firmware.devices import Codes, Device
from wavequake.firmware.gains import CODE_BITS

PLANT_STEP = 1e-3


@dataclass(frozen=True)
class Blow:
    """A blow on a bench, as a board meets it.

    Attributes
    ----------
    time, image : ndarray, shape (n,)
        s; image motion without control, m.
    adc : ndarray of uint16, shape (k,)
        Codes at the controller's instants.
    trigger : ndarray of bool, shape (k,)
    """

    time: Array
    image: Array
    adc: Codes
    trigger: NDArray[np.bool_]


def blow(
    bench: Bench,
    chain: SensorChain,
    sample_time: float,
    *,
    duration: float = 6.0,
    friction: float = 0.3e-3,
    strength: float = 1.0,
    phases: Array | None = None,
    seed: int = 0,
    late: float = 0.0,
) -> Blow:
    """Hit a bench and read lens 4 through the whole sensor chain.

    The stage carries lens 5 alone, so that commands change nothing of what is measured.

    Parameters
    ----------
    bench : Bench
    chain : SensorChain
    sample_time, duration : float
        Of the controller, of the run, s.
    friction : float
        N.
    strength : float
        As a multiple of the hammer's.
    phases : ndarray, shape (waves,), optional
        Of the strip's error, rad; drawn if not given.
    seed : int
        Of what is drawn.
    late : float
        From the hammer's first touch to the step that sees the trigger, s.

    Raises
    ------
    UserError
        If the sample time is no multiple of the plant's step of 1 ms.
    """
    every = round(sample_time / PLANT_STEP)
    if every < 1 or abs(every * PLANT_STEP - sample_time) > 1e-9:
        raise UserError(f"The sample time is {1e3 * sample_time:g} ms; it must be a multiple of 1 ms.")
    free = swing(
        [bench], np.array([strength]), friction=friction, duration=duration, step=PLANT_STEP,
        late=np.array([late]),
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(0, 2 * np.pi, len(chain.strip_periods))
    phases = drawn if phases is None else phases
    lens = free.measured[0, ::every]
    counts = quadrature_counts(chain, strip_reading(chain, lens, phases))
    codes = adc_codes(chain, dac_codes(chain, counts), rng.standard_normal(len(lens)))
    trigger = np.zeros(len(lens), dtype=bool)
    trigger[0] = True
    return Blow(free.time, free.image[0], codes.astype(np.uint16), trigger)


def wandering(steps: int, top: int) -> Blow:
    """Return readings that wander and jump over the whole converter (codes 0 to top), for any regulator."""
    rng = np.random.default_rng(0)
    walk = top * (0.5 + 0.6 * np.sin(np.cumsum(rng.normal(0, 0.2, steps))))
    jumps = np.where(rng.random(steps) < 0.02, rng.uniform(0, top, steps), walk)
    codes = np.clip(np.rint(jumps), 0, top).astype(np.uint16)
    return Blow(np.zeros(0), np.zeros(0), codes, np.zeros(steps, dtype=bool))


@dataclass(frozen=True)
class Residual:
    """What is left of the image motion, in % of that without control: its range, its deviation after 1 s."""

    range: float
    deviation: float


def residual(device: Device, hit: Blow, stage: Stage, regulator: ModalRegulator, reach: float) -> Residual:
    """Start a board, run it on a blow, move the stage by its commands; return what is left (Fig. 5.33)."""
    device.reset()
    commands = positions_of(device.run(hit.adc, hit.trigger), reach)
    moved = stage_motion(
        stage, commands[None], regulator.sample_time, regulator.compute_delay, PLANT_STEP, len(hit.time)
    )[0]
    left = remaining_image(hit.image, moved)
    return Residual(
        float(100 * peak_to_peak(left) / peak_to_peak(hit.image)),
        float(100 * late_deviation(left, hit.time) / late_deviation(hit.image, hit.time)),
    )


def positions_of(codes: Codes, reach: float) -> Array:
    """Return the commands in m that codes stand for."""
    return np.asarray(codes * (2 * reach / (2**CODE_BITS - 1)) - reach)
