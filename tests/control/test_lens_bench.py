"""The default bench against what it was fitted to, and the told figures that it was not fitted to."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
import pytest

from wavequake.control.bench import SENSITIVITIES, bench_modes, fitted_bench
from wavequake.control.hammer import HAMMER, equivalent_force
from wavequake.control.linear import (
    LinearModel,
    bogacki_shampine,
    linear_model,
    simulate,
    zero_order_hold,
)
from wavequake.control.loop import commands_of, late_deviation, peak_to_peak, remaining_image, stage_motion
from wavequake.control.plant import swing
from wavequake.control.regulator import modal_model, modal_regulator
from wavequake.control.sensor import SensorChain, read_positions
from wavequake.control.stage import Stage
from wavequake.control.thesis import (
    SampledController,
    estimator_only,
    feed_forward,
    future_integration,
    kalman_filter,
)

BENCH, STAGE = fitted_bench(), Stage()
STEP = 5e-4
FREE = swing([BENCH], np.ones(1), duration=7.0, step=STEP)
SEEN = read_positions(
    SensorChain(strip_error=0.0),
    FREE.measured,
    np.zeros((1, 2)),
    np.random.default_rng(0).standard_normal(FREE.measured.shape),
)


def left(commands, sample_time, compute_delay):
    """Return range and deviation in % of uncontrolled."""
    moved = stage_motion(STAGE, commands, sample_time, compute_delay, STEP, FREE.image.shape[1])
    image = remaining_image(FREE.image, moved)
    ratios = (
        peak_to_peak(image) / peak_to_peak(FREE.image),
        late_deviation(image, FREE.time) / late_deviation(FREE.image, FREE.time),
    )
    return 100 * np.ravel(ratios)


def left_by(controller):
    seen = SEEN[:, :: round(controller.sample_time / STEP)]
    return left(commands_of(controller, seen), controller.sample_time, controller.compute_delay)


def test_frequencies_are_the_told_ones():
    wanted = [20, 24, 28, 32.9, 37.9, 44, 51, 58, 65.1, 72, 80]
    np.testing.assert_allclose(bench_modes(BENCH).omega, wanted, rtol=0.03)
    passive = bench_modes(fitted_bench(active=False)).omega
    np.testing.assert_allclose(passive[[0, -1]], [15.6, 80.3], rtol=0.01)


def test_amplitudes_and_speeds_are_the_told_ones():
    """Image -3.00 to 3.99 mm, lens 4 up to 2.94 mm, stage 123 mm/s over 5.0 mm, lens 4 148 mm/s."""
    image, lens = 1e3 * FREE.image[0], 1e3 * FREE.measured[0]
    speeds = [np.abs(np.gradient(one, STEP)).max() for one in (image / 1.394, lens)]
    found = [image.min(), image.max(), np.abs(lens).max(), *speeds, np.ptp(image) / 1.394]
    np.testing.assert_allclose(found, [-3, 3.99, 2.94, 123, 148, 5.0], rtol=0.01)


def test_housing_moves_as_told_and_every_mode_shows():
    modes = bench_modes(BENCH)
    free = modes.shapes[-1] ** 2 / modes.poles.imag  # of an impulse of 1 N s, m
    time = 0.003 + 1e-3 * np.arange(1000)
    housing = 0.0752e3 * np.abs((free * np.exp(np.outer(time, modes.poles)).imag).sum(axis=1)).max()
    assert housing == pytest.approx(1.5, rel=0.05)
    sizes = np.abs(modal_model(BENCH).blow)
    assert sizes.min() >= 0.03 * sizes.max()


def test_masses_and_springs_are_alike():
    """Nobody would build lenses or springs of one kind that differ by more than a factor of four."""
    for name in ("lens_kg", "ring_kg", "lens_springs", "ring_springs", "couplings"):
        values = getattr(BENCH, name)
        assert 0 < values.max() < 4 * values.min()


@pytest.mark.parametrize(
    ("controller", "wanted"),
    [
        (feed_forward(BENCH, STAGE), [31.8, 25.5]),
        (future_integration(BENCH), [67, 25]),
        (feed_forward(BENCH, STAGE, ahead=2), [11.5, 10.1]),
        (estimator_only(BENCH), [48, 39]),
    ],
    ids=["FF", "FI", "FF+FI", "filter alone"],
)
def test_without_errors_controllers_leave_what_the_other_simulation_found(controller, wanted):
    np.testing.assert_allclose(left_by(controller), wanted, rtol=0, atol=0.6)


@pytest.mark.parametrize(
    ("sample_time", "wanted"),
    [(0.008, [2.5, 1.1]), (0.004, [1.7, 0.5]), (0.002, [0.7, 0.3]), (0.0005, [0.2, 0.14])],
)
def test_a_perfect_modal_regulator_leaves_no_more_than_told(sample_time, wanted):
    """Not fitted: at 8 ms the hold between samples decides, below it what converters round."""
    one = modal_regulator(modal_model(BENCH), STAGE, sample_time)
    found = left_by(one)
    assert (found <= np.array(wanted) + 0.2).all()
    if sample_time == 0.008:
        np.testing.assert_allclose(found, wanted, rtol=0, atol=0.2)


@pytest.mark.parametrize(
    ("density", "with_force", "wanted"), [(5e-8, True, 13.8), (5e-7, False, 21.5)], ids=["force", "noise"]
)
def test_other_tunings_of_fi_settle_as_told(density, with_force, wanted):
    """Not fitted: FI that knows the force, or trusts the sensor more; only what the blow hardly changes.

    Ranges are not reproduced (17.8 and 67 % for 23 and 54 %): how that program gave the force is not told.
    """
    step, estimator = 0.008, kalman_filter(BENCH, q=density, with_force=with_force)
    ahead = zero_order_hold(linear_model(estimator.a, estimator.b, estimator.image), step)
    driven = (ahead.a + np.eye(22)) @ ahead.b
    row = -estimator.image / SENSITIVITIES[4]
    one = bogacki_shampine(
        linear_model(estimator.a, estimator.b, row @ ahead.a @ ahead.a, row @ driven), step
    )
    controller = SampledController("FI", step, 0.003, one.a, one.b, one.c[0], one.d[0])
    assert left_by(controller)[1] == pytest.approx(wanted, abs=1.0)


def test_a_constant_force_covers_for_a_part_of_the_delay():
    """That of Eq. 5.14 hands momentum over 0.8 ms before the hammer does: 2 points less of the range."""
    one = feed_forward(BENCH, STAGE)
    seen = SEEN[0, :: round(one.sample_time / STEP)]
    force = np.where(np.arange(len(seen)) < 2, equivalent_force(HAMMER), 0.0)
    model = LinearModel(one.a, one.b, one.c[None], one.d[None], one.sample_time)
    commands = simulate(model, np.stack([seen, force], axis=1)).T
    less = left_by(one) - left(commands, one.sample_time, one.compute_delay)
    assert 1.5 < less[0] < 3.0
    assert 0.0 < less[1] < 0.5


def test_the_fit_is_about_this_bench():
    """What docs/make_lens_bench.py minimizes is small here, and its controllers are those of the package."""
    path = Path(__file__).parents[2] / "docs" / "make_lens_bench.py"
    script = module_from_spec(spec_from_file_location("make_lens_bench", path))
    script.__spec__.loader.exec_module(script)
    factors = script.factors_of(BENCH)
    np.testing.assert_allclose(script.bench_of(factors).couplings, BENCH.couplings, rtol=1e-12)

    assert 0.5 * np.sum(script.residual(factors, script.LAST) ** 2) < 50
    image, lens, _ = script.swing(BENCH).T
    np.testing.assert_allclose(
        script.left(script.controllers(BENCH)[2], image, lens),
        left_by(feed_forward(BENCH, STAGE, ahead=2)),
        rtol=0,
        atol=0.2,
    )
