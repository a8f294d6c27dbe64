"""The modal regulator against the swinging bench, and its designs against what makes them impossible."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.control.bench import bench_modes, fitted_bench
from wavequake.control.loop import commands_of, late_deviation, peak_to_peak, remaining_image, stage_motion
from wavequake.control.plant import swing
from wavequake.control.regulator import (
    first_steps,
    modal_model,
    modal_regulator,
    side_by_side,
    stage_gain,
)
from wavequake.control.sampled.regulator import answer
from wavequake.control.stage import Stage
from wavequake.errors import UserError

BENCH = fitted_bench()


def test_modal_model_swings_as_the_bench():
    model = modal_model(BENCH)
    runs = swing([BENCH], np.ones(1), duration=2.0, step=2.5e-4)
    late = runs.time > 0.02
    states = model.blow[:, None] * np.exp(np.outer(model.poles, runs.time[late]))
    np.testing.assert_allclose(states.sum(axis=0).real, runs.measured[0, late], rtol=0, atol=3e-7)
    np.testing.assert_allclose((model.image @ states).real, runs.image[0, late], rtol=0, atol=3e-7)


@pytest.mark.parametrize("late", [0.0, 0.0013])
def test_steps_of_the_blow_add_up_to_it(late):
    model = modal_model(BENCH)
    start = first_steps(model, 0.002, late=late)
    state = np.zeros(11, dtype=complex)
    for k, added in enumerate(start):
        state = state * np.exp(model.poles * 0.002) if k else state
        state = state + added
    expected = model.blow * np.exp(model.poles * (0.002 * (len(start) - 1) + late))
    np.testing.assert_allclose(state, expected, rtol=1e-9)
    # During the blow, too, lens 4 is where the bench has it.
    runs = swing([BENCH], np.ones(1), duration=0.05, step=1e-4)
    state = np.zeros(11, dtype=complex)
    for k in range(len(start)):
        state = state * np.exp(model.poles * 0.002) + start[k]
        assert state.real.sum() == pytest.approx(runs.measured[0, 20 * k + round(late / 1e-4)], abs=1e-7)


def test_stage_gain_is_what_held_late_commands_do():
    stage, pole = Stage(), -0.4 + 44j
    count, step, delay = 1500, 0.004, 0.0012
    sampled = np.exp(pole * step * np.arange(count))[None]
    moved = stage_motion(stage, 5e-3 * sampled.real, step, delay, 1e-3, 4 * count - 8)[0]
    time = 1e-3 * np.arange(len(moved))
    gain = stage_gain(stage, np.array([pole]), step, delay)[0]
    expected = 5e-3 * (gain * np.exp(pole * time)).real
    late = slice(400, 1400)
    # Between samples the hold's images remain; averaged over a step they vanish.
    smooth = lambda signal: np.convolve(signal, np.ones(4) / 4, "valid")  # noqa: E731
    error = smooth(moved)[late] - smooth(expected)[late]
    assert np.abs(error).max() < 0.01 * np.abs(expected[late]).max()


@pytest.mark.parametrize(("sample_time", "limit"), [(0.008, 4.0), (0.002, 1.2), (0.001, 0.8)])
def test_image_stands_still_if_the_model_is_perfect(sample_time, limit):
    """Residuals in % of the uncontrolled image for any sample time, with only a converter in the way."""
    runs = swing([BENCH], np.ones(1), duration=4.0)
    regulator = modal_regulator(modal_model(BENCH), Stage(), sample_time)
    measured = runs.measured[:, :: round(sample_time / 1e-3)]
    commands = commands_of(regulator, measured)
    stage = stage_motion(Stage(), commands, sample_time, regulator.compute_delay, 1e-3, runs.image.shape[1])
    left = remaining_image(runs.image, stage)
    assert 100 * peak_to_peak(left)[0] < limit * peak_to_peak(runs.image)[0]
    assert 100 * late_deviation(left, runs.time)[0] < limit * late_deviation(runs.image, runs.time)[0]


def test_rows_of_a_batch_are_independent():
    regulator = modal_regulator(modal_model(BENCH), Stage())
    other = modal_regulator(modal_model(BENCH), Stage(), process_noise=0.01)
    measured = np.random.default_rng(1).normal(size=(3, 40)) * 1e-3
    together = answer(side_by_side([regulator, other, regulator]), measured.T[:, None])[:, 0].T
    np.testing.assert_array_equal(commands_of(other, measured[1:2])[0], together[1])
    np.testing.assert_array_equal(commands_of(regulator, measured)[::2], together[::2])
    assert np.abs(commands_of(regulator, measured)[1] - together[1]).max() > 1e-6


def test_observer_forgets_a_wrong_start():
    regulator = modal_regulator(modal_model(BENCH), Stage())
    a = np.diag(np.repeat(regulator.step, 1))
    # The error obeys e := step (1 - gain c) e; in reals its largest eigenvalue is below that of the modes.
    count = len(regulator.step)
    real = np.zeros((2 * count, 2 * count))
    for j in range(count):
        for i in range(count):
            one = (i == j) * np.array([1.0, 1j]) - regulator.gain[j] * np.array([1.0, 0.0])
            value = regulator.step[j] * one
            real[2 * j : 2 * j + 2, 2 * i : 2 * i + 2] = [value.real, value.imag]
    assert np.abs(np.linalg.eigvals(real)).max() < np.abs(a).max() < 1


def test_impossible_designs_are_refused():
    model = modal_model(BENCH)
    springs = BENCH.lens_springs.copy()
    springs[5] = 0.0
    with pytest.raises(UserError, match=r"lens 4 does not see mode 1 \(6\.26\d rad/s"):
        modal_model(replace(BENCH, lens_springs=springs))
    poles = model.poles.copy()
    poles[1] = 0.1 + 24j
    with pytest.raises(UserError, match=r"mode 2 \(24 rad/s\) does not decay, real part 0\.1"):
        modal_regulator(replace(model, poles=poles), Stage())
    blow = model.blow.copy()
    blow[2] = 0.0
    with pytest.raises(UserError, match="lens 4 does not see mode 3"):
        modal_regulator(replace(model, blow=blow), Stage())


def test_frequencies_are_those_of_the_bench():
    np.testing.assert_allclose(np.abs(modal_model(BENCH).poles), bench_modes(BENCH).omega)
