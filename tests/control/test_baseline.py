"""What the reference's controllers leave with errors, beside another simulation of the same experiment.

That one shares no code with this package: plants stepped one by one in plain Python, medians of 4 to 6 of
them. The bench is fitted to what it found without errors (test_lens_bench.py); what errors do to it is not.
"""

from functools import cache

import numpy as np
import pytest
from scipy.special import betaincinv

from wavequake.control.bench import fitted_bench
from wavequake.control.camera import CameraError
from wavequake.control.experiment import (
    CONTROLLERS,
    Errors,
    Settings,
    design,
    draw_plant,
    instants_of,
    residuals,
    run_plants,
)
from wavequake.control.linear import LinearModel, simulate
from wavequake.control.loop import (
    commands_of,
    late_deviation,
    peak_to_peak,
    remaining_image,
    stage_motion,
)
from wavequake.control.plant import swing
from wavequake.control.regulator import modal_model, stage_gain
from wavequake.control.sensor import SensorChain, read_positions
from wavequake.control.stage import Stage
from wavequake.control.thesis import feed_forward, future_integration

DURATION, STEP, PLANTS = 7.0, 1e-3, 64
BENCH, STAGE = fitted_bench(), Stage()
NAMES = ("FF", "FI", "FF+FI")

# Range and standard deviation after 1 s, in % of uncontrolled, of FF (2 ms), FI (8 ms, without the hammer's
# force) and FF+FI (2 ms); where a range was told, its middle.
ROWS = {
    "stiffness 1 %": (Errors(0.01, 0, 0, 0), 0.0, [[30, 27.8], [67, 26], [12, 13]]),
    "stiffness 2 %, friction": (Errors(0.02, 0.3e-3, 0, 0), 0.0, [[30, 33.5], [68, 28], [15, 20.5]]),
    "stiffness 3 %": (Errors(0.03, 0, 0, 0), 0.0, [[30.5, 35], [67, 30], [19, 24.5]]),
    "all": (Errors(), 40e-6, [[31, 34], [67.5, 29], [16, 21]]),
}


def controllers(bench):
    return feed_forward(bench, STAGE), future_integration(bench), feed_forward(bench, STAGE, ahead=2)


def left(free, time, commands, one, stages):
    """Return range and deviation (2, c) in % of uncontrolled for free images (c, k) and commands (c, k)."""
    moved = stage_motion(stages, commands, one.sample_time, one.compute_delay, STEP, free.shape[1])
    image = remaining_image(free, moved)
    shares = (
        peak_to_peak(image) / peak_to_peak(free),
        late_deviation(image, time) / late_deviation(free, time),
    )
    return 100 * np.stack(shares)


@cache
def population(name):
    """Return ranges and deviations (controller, 2, plant) of plants with the errors of a row."""
    errors, strip, _ = ROWS[name]
    instants = instants_of(DURATION)
    plants = [
        draw_plant(np.random.default_rng(seed), BENCH, STAGE, errors, 2, instants, 0)
        for seed in range(PLANTS)
    ]
    free = swing([one.bench for one in plants], np.ones(PLANTS), friction=errors.friction, duration=DURATION)
    phases, noise = np.stack([one.phases for one in plants]), np.stack([one.noise[1] for one in plants])
    seen = read_positions(SensorChain(strip_error=strip), free.measured, phases, noise)
    stages = [one.stage for one in plants]
    return np.stack(
        [
            left(
                free.image,
                free.time,
                commands_of(one, seen[:, :: round(one.sample_time / STEP)]),
                one,
                stages,
            )
            for one in controllers(BENCH)
        ]
    )


def interval(name):
    """Return where 95 % of the medians of five plants lie, (controller, 2, 2).

    The median of five is the third of them: its quantile is that of a beta distribution (3, 3) of ranks.
    """
    ends = betaincinv(3, 3, np.array([0.025, 0.975]))
    return np.moveaxis(np.quantile(population(name), ends, axis=-1), 0, -1)


@pytest.mark.parametrize("name", ROWS)
def test_every_row_is_a_median_of_five_of_our_plants(name):
    """Each told figure lies where 95 % of the medians of five of our plants lie."""
    wanted = np.array(ROWS[name][2])
    low, high = np.moveaxis(interval(name), -1, 0)
    outside = (wanted < low) | (wanted > high)
    assert not outside.any(), [
        (NAMES[i], wanted[i, j], low[i, j], high[i, j]) for i, j in np.argwhere(outside)
    ]


@pytest.mark.parametrize("name", ROWS)
def test_our_medians_lie_within_bands_of_the_rows(name):
    """Within 4 percentage points; 2 for the range under FI, which hardly depends on the plant.

    Medians of five plants with the same errors lie up to 10 (FF), 2 and 5 to 10 (deviation of FF+FI) from
    ours: the bands are less than half as wide as chance alone would explain.
    """
    band = np.array([[4, 4], [2, 4], [4, 4]])
    assert (np.abs(np.median(population(name), axis=-1) - ROWS[name][2]) <= band).all()


def test_the_experiment_runs_these_controllers():
    """The experiment and this file's own chain leave the same of one of the plants."""
    errors, strip, _ = ROWS["all"]
    plant = draw_plant(np.random.default_rng(0), BENCH, STAGE, errors, 2, instants_of(DURATION), 1500)
    camera = CameraError(np.array([-1e-2, 1e-2]), np.zeros(2), 20e-6)
    runs = run_plants(
        design(BENCH, STAGE, Settings()), [plant], SensorChain(strip_error=strip), camera,
        friction=errors.friction, duration=DURATION, output_step=STEP,
    )  # fmt: skip
    places = [CONTROLLERS.index(name) for name in NAMES]
    found = np.stack(residuals(runs), axis=-1)[0, places]
    np.testing.assert_allclose(found, population("all")[..., 0], rtol=1e-9)


def test_medians_of_five_tell_rows_apart():
    """The tests above could fail: FF+FI with 3 % is none of 1 %, and none without errors (10.1) of 3 %."""
    three = ROWS["stiffness 3 %"][2][2][1]
    assert three > interval("stiffness 1 %")[2, 1, 1]
    assert interval("stiffness 3 %")[2, 1, 0] > 10.1


def test_the_order_is_that_of_the_reference():
    """Störkle 2018, Fig. 5.33: FF is better at once, FI later; both in a row are better than either."""
    (at_once, later) = np.median(population("all"), axis=-1).T
    assert at_once[2] < at_once[0] < at_once[1] < 100
    assert later[2] < later[1] < later[0] < 100


@pytest.mark.parametrize("place", range(3))
def test_what_is_left_follows_from_transfer_functions(place):
    """A mode e^{λt} of lens 4 becomes a command (C (z - A)⁻¹ B + D) e^{λt}, z = e^{λT}, of a settled filter.

    Hold, delay and stage turn that into motion. Ripples of the held command are beside it; they do not look
    like modes to instants that are close enough.
    """
    one, model = controllers(BENCH)[place], modal_model(BENCH)
    z = np.exp(model.poles * one.sample_time)
    resolvent = np.linalg.solve(z[:, None, None] * np.eye(len(one.a)) - one.a, one.b[:, :1])[..., 0]
    moved = (resolvent @ one.c + one.d[0]) * stage_gain(
        STAGE, model.poles, one.sample_time, one.compute_delay
    )
    expected = model.image + 1.394 * moved
    step = 1e-4
    time = np.arange(30_000) * step
    modes = model.blow * np.exp(np.outer(time, model.poles))
    lens = modes[:: round(one.sample_time / step)].sum(axis=1).real
    sampled = LinearModel(one.a, one.b[:, :1], one.c[None], one.d[None, :1], one.sample_time)
    commands = simulate(sampled, lens, (model.blow @ resolvent).real).T
    stage = stage_motion(STAGE, commands, one.sample_time, one.compute_delay, step, len(time))
    image = remaining_image((modes @ model.image).real, stage[0])
    late = time > 0.1  # the stage has settled
    found = np.linalg.lstsq(np.hstack([modes.real, -modes.imag])[late], image[late])[0]
    scale = np.abs(model.blow)
    np.testing.assert_allclose(
        (found[:11] + 1j * found[11:]) * scale,
        expected * scale,
        rtol=0,
        atol=1e-3 * np.abs(model.image * scale).max(),
    )
    assert np.abs(expected * scale).max() > 0.05 * np.abs(model.image * scale).max()
