import numpy as np
import pytest
from scipy import stats

from wavequake.mechanics.disturbances.motion import counted_generator, piston_rms_nm
from wavequake.mechanics.disturbances.registry import analytic_rms, draw_case, time_axis
from wavequake.mechanics.disturbances.sources.common_history import (
    CommonHistory,
    amplitudes_of_run,
    history,
)

SWING = CommonHistory(name="swing", piston_nm=30.0, instants=10)


def block(parameters, segments, first, cases, seed=3):
    return amplitudes_of_run(parameters, segments, seed, first, cases)


@pytest.mark.parametrize("segments", [1, 4, 18, 491])
@pytest.mark.parametrize("distribution", ["gaussian", "uniform"])
def test_a_realization_has_the_same_bits_in_every_run_of_realizations(segments, distribution):
    parameters = SWING.model_copy(update={"piston_distribution": distribution})
    whole = block(parameters, segments, 0, 40)
    np.testing.assert_array_equal(block(parameters, segments, 17, 23), whole[17:])
    np.testing.assert_array_equal(block(parameters, segments, 39, 1)[0], whole[39])


def test_realizations_names_and_seeds_do_not_share_numbers():
    other = SWING.model_copy(update={"name": "b"})
    whole = np.stack([block(SWING, 18, 0, 50), block(other, 18, 0, 50), block(SWING, 18, 0, 50, seed=4)])
    assert len(np.unique(whole)) == whole.size
    assert block(SWING, 18, 2**40, 1).shape == (1, 18)


@pytest.mark.parametrize(
    ("distribution", "law"),
    [
        ("gaussian", stats.norm(0, 30e-9)),
        ("uniform", stats.uniform(-np.sqrt(3) * 30e-9, np.sqrt(12) * 30e-9)),
    ],
)
def test_amplitudes_follow_their_law_and_are_independent(distribution, law):
    parameters = SWING.model_copy(update={"piston_distribution": distribution})
    drawn = block(parameters, 18, 0, 4000)
    assert stats.kstest(drawn.ravel(), law.cdf).pvalue > 1e-4
    assert np.abs(np.corrcoef(drawn.T) - np.eye(18)).max() < 5 / np.sqrt(4000)
    assert np.abs(np.corrcoef(drawn[:-1].ravel(), drawn[1:].ravel())[0, 1]) < 5 / np.sqrt(drawn.size)


def test_the_counter_walks_through_philox_as_published():
    """First output of Philox4x64-10 for counter 0 and key 0: Random123's known-answer test.

    NumPy counts before it generates: what it gives first belongs to the counter after the given one.
    """
    generator = np.random.Philox(counter=2**256 - 1, key=0)
    assert hex(generator.random_raw()) == "0x16554d9eca36314c"
    ahead = counted_generator(1, "a", 7).bit_generator.random_raw(4)
    np.testing.assert_array_equal(ahead, counted_generator(1, "a", 0).bit_generator.random_raw(32)[28:])


def test_all_segments_follow_one_history_along_their_normals(few):
    motion = draw_case([SWING], SWING, few, 3, 5)
    swing = history(SWING, time_axis(SWING))
    np.testing.assert_array_equal(motion.segment_motion[..., 2], np.outer(swing, block(SWING, 5, 5, 1)[0]))
    assert not motion.segment_motion[..., [0, 1, 3, 4, 5]].any()
    assert not motion.mount.any()


def test_the_history_starts_from_rest_and_swings_as_a_sine():
    time = np.array([0.0, 1e-6, 0.025, 0.03, 0.05])
    swing = history(SWING, time)
    assert swing[0] == 0.0
    assert abs(swing[1]) < 1e-11  # displacement grows with the third power of time
    np.testing.assert_allclose(swing[2:], np.sin(2 * np.pi * 10.0 * time[2:]), rtol=0, atol=1e-15)
    sharp = SWING.model_copy(update={"ramp_s": 0.0})
    np.testing.assert_allclose(history(sharp, time), np.sin(2 * np.pi * 10.0 * time), rtol=0, atol=1e-15)


def test_the_model_rms_is_that_of_many_draws(tmt):
    value, unit = analytic_rms(SWING, tmt)
    drawn = np.sqrt(np.mean([piston_rms_nm(draw_case([SWING], SWING, tmt, 1, r)) ** 2 for r in range(40)]))
    assert unit == "nm"
    assert drawn == pytest.approx(value, rel=5 / np.sqrt(2 * 40 * 492))
