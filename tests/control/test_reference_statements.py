"""What docs/thesis.md says of the lens bench beside the reference text, where no study shows it."""

import numpy as np
import pytest

from wavequake.control.bench import COMPENSATOR, SENSITIVITIES, bench_model, fitted_bench
from wavequake.control.experiment import Errors, draw_plant
from wavequake.control.linear import (
    bogacki_shampine,
    in_series,
    linear_model,
    second_order_model,
    simulate,
    zero_order_hold,
)
from wavequake.control.loop import commands_of, remaining_image, stage_motion
from wavequake.control.modes import modes
from wavequake.control.plant import swing
from wavequake.control.stage import Stage, all_pass_inverse, stage_model
from wavequake.control.thesis import _target, feed_forward, kalman_filter

BENCH, STAGE = fitted_bench(), Stage()


def hidden(model, state):
    """How well one state shows the mode that it shows least."""
    seen = linear_model(model.a, model.b, np.eye(1, len(model.a), state))
    return min(mode.observability for mode in modes(seen))


def test_every_position_shows_every_mode_of_this_bench_but_coupling_is_not_enough():
    """Störkle 2018, Section 5.3.1: one arbitrary state would do, since all lenses are coupled."""
    shown = [hidden(bench_model(BENCH), position) for position in range(11)]
    assert min(shown) == pytest.approx(0.002, abs=0.001)
    assert shown[3] == pytest.approx(0.085, abs=0.005)
    even = np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 2]])  # three equal bodies in a row
    chain = second_order_model(np.eye(3), 0.01 * even, even, np.eye(3, 1), np.eye(3))
    assert hidden(chain, 0) > 0.1
    assert hidden(chain, 1) < 1e-9


def radius(model, step, order):
    """Spectral radius of an explicit Runge-Kutta step of an order up to 3: a Taylor polynomial."""
    whole = term = np.eye(len(model.a))
    for k in range(1, order + 1):
        term = term @ model.a * step / k
        whole = whole + term
    return np.abs(np.linalg.eigvals(whole)).max()


def test_solvers_of_lower_order_do_not_run_ff_at_longer_steps():
    """Section 5.4.1: ode1 and ode2 do not resolve the issue; FI runs at 8 ms."""
    forward = in_series(_target(kalman_filter(BENCH), 0, 0.002), all_pass_inverse(STAGE))
    assert radius(forward, 0.002, 3) < 1 < radius(forward, 0.003, 3)
    assert [radius(forward, 0.003, order) for order in (1, 2)] == pytest.approx([2.6, 2.9], abs=0.05)
    assert radius(forward, 0.002, 1) == pytest.approx(1.7, abs=0.01)
    assert radius(forward, 0.002, 2) == pytest.approx(1.0, abs=1e-12)  # the stage's zero of 1000 1/s
    ahead = _target(kalman_filter(BENCH, with_force=False), 2, 0.008)
    assert [radius(ahead, 0.008, order) for order in (1, 3)] == pytest.approx([1.166, 0.997], abs=1e-3)


def test_the_stage_goes_the_wrong_way_first():
    """Section 5.2.1: a direction reversal, by zeros in the right half plane."""
    step = simulate(zero_order_hold(stage_model(STAGE), 1e-4), np.ones((1000, 1)))[:, 0]
    assert step.min() == pytest.approx(-0.083, abs=0.001)
    assert step[-1] == pytest.approx(0.97, abs=1e-6)


@pytest.fixture(scope="module")
def plants():
    return [draw_plant(np.random.default_rng([1, k]), BENCH, STAGE, Errors(), 1, 1, 1) for k in range(16)]


@pytest.fixture(scope="module")
def runs(plants):
    """Without any error, and with all of the default ones, over 10 s."""
    return {
        "nominal": (swing([BENCH], np.ones(1), duration=10.0), [STAGE]),
        "plants": (
            swing([one.bench for one in plants], np.ones(16), friction=0.3e-3, duration=10.0),
            [one.stage for one in plants],
        ),
    }


@pytest.mark.parametrize(
    ("which", "left"), [("nominal", {-2: 3.9, 0: 11.5, 2: 20.6}), ("plants", {-2: 10.4, 0: 14.8, 2: 22.6})]
)
def test_an_earlier_stage_would_leave_less_and_a_later_one_more(runs, which, left):
    """Störkle 2018, Fig. 5.31: a shift by 2 ms either way would not help there."""
    free, stages = runs[which]
    commands = commands_of(feed_forward(BENCH, STAGE, ahead=2), free.measured[:, ::2])
    moved = stage_motion(stages, commands, 0.002, 0.001, 1e-3, len(free.time))
    for shift, percent in left.items():
        image = remaining_image(free.image, np.roll(moved, shift, axis=1))[:, 5:-5]
        found = np.median(np.ptp(image, axis=1) / np.ptp(free.image, axis=1))
        assert 100 * found == pytest.approx(percent, abs=0.3)
    if which == "nominal":  # Fig. 5.30
        target = -free.image / SENSITIVITIES[COMPENSATOR]
        missing = [np.std((np.roll(moved, shift, axis=1) - target)[:, 5:-5]) for shift in (0, -2)]
        assert missing / np.std(target) == pytest.approx([0.103, 0.038], abs=0.002)


def estimate(free):
    """Image that the filter without the hammer's force finds, every 2 ms."""
    design = kalman_filter(BENCH, with_force=False)
    sampled = bogacki_shampine(linear_model(design.a, design.b, design.image), 0.002)
    rows = [np.column_stack([row[::2], np.zeros(len(row[::2]))]) for row in free.measured]
    return np.stack([simulate(sampled, row)[:, 0] for row in rows])


def error(found, image, time, span):
    chosen = (time >= span[0]) & (time < span[1])
    return np.median(np.std((found - image)[:, chosen], axis=1) / np.std(image[:, chosen], axis=1))


def test_the_filter_needs_a_second_and_a_half_to_find_the_image(runs):
    """Störkle 2018, Fig. 5.28: half a second there."""
    free = runs["nominal"][0]
    spans = ((0, 0.25), (0.5, 1), (1, 1.5), (1.5, 2), (2, 3))
    found = [error(estimate(free), free.image[:, ::2], free.time[::2], span) for span in spans]
    assert found == pytest.approx([0.77, 0.60, 0.36, 0.19, 0.08], abs=0.01)


def test_the_model_alone_drifts_away_and_the_filter_does_not(runs):
    """Störkle 2018, Fig. 5.29."""
    free, alone = runs["plants"][0], runs["nominal"][0]
    late = (7.0, 8.0)
    assert error(alone.image, free.image, free.time, late) == pytest.approx(1.1, abs=0.05)
    assert error(estimate(free), free.image[:, ::2], free.time[::2], late) == pytest.approx(0.16, abs=0.01)
