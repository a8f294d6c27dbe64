import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from scipy import stats

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.motion import add, still
from wavequake.mechanics.disturbances.registry import (
    Combine,
    Disturbance,
    draw,
    draw_case,
    generator,
    parts,
    time_axis,
)
from wavequake.mechanics.disturbances.sources.static_random import StaticRandom

adapter = TypeAdapter(Disturbance)

FULL = StaticRandom(
    name="polish",
    piston_nm=20,
    tip_nrad=5,
    tilt_nrad=7,
    in_plane_um=3,
    clocking_urad=11,
    figure_nm={4: 30.0, 11: 8.0},
)


def test_time_axis_ends_at_the_duration_and_leaves_out_zero():
    np.testing.assert_allclose(
        time_axis(StaticRandom(name="a", duration_s=0.1, instants=4)), [0.025, 0.05, 0.075, 0.1]
    )


def test_static_random_has_the_rms_of_every_degree_of_freedom(tmt):
    draws = [draw_case([FULL], FULL, tmt, 1, realization) for realization in range(40)]
    rigid = np.array([motion.segment_motion[0] for motion in draws]).reshape(-1, 6)
    expected = np.array([3e-6, 3e-6, 20e-9, 5e-9, 7e-9, 11e-6])
    # 19680 samples: the sampled variance over the true one is chi-square with that many degrees of freedom.
    low, high = stats.chi2.ppf([1e-5, 1 - 1e-5], len(rigid)) / len(rigid)
    ratio = np.mean(rigid**2, axis=0) / expected**2
    assert np.all((low < ratio) & (ratio < high))
    correlation = np.corrcoef(rigid.T) - np.eye(6)
    assert np.abs(correlation).max() < 5 / np.sqrt(len(rigid))
    figure = np.array([motion.segment_figure for motion in draws]).reshape(-1, 11)
    ratio = np.mean(figure[:, [3, 10]] ** 2, axis=0) / np.array([30e-9, 8e-9]) ** 2
    assert np.all((low < ratio) & (ratio < high))
    assert np.all(figure[:, [0, 1, 2, 4, 5, 6, 7, 8, 9]] == 0)


def test_static_random_is_constant_over_the_instants_and_moves_nothing_else(few):
    motion = draw_case([FULL], FULL, few, 1, 0)
    assert motion.segment_motion.shape == (16, 5, 6)
    assert motion.segment_figure.shape == (5, 11)
    assert np.all(motion.segment_motion == motion.segment_motion[0])
    assert not motion.mount.any()
    assert not motion.m2.any()


def test_uniform_piston_is_bounded_and_changes_no_other_draw(tmt):
    uniform = FULL.model_copy(update={"piston_distribution": "uniform"})
    gaussian, motion = draw_case([FULL], FULL, tmt, 1, 0), draw_case([uniform], uniform, tmt, 1, 0)
    piston = motion.segment_motion[0, :, 2]
    assert np.abs(piston).max() <= np.sqrt(3) * 20e-9
    assert stats.kstest(piston / 20e-9, stats.uniform(-np.sqrt(3), 2 * np.sqrt(3)).cdf).pvalue > 1e-4
    others = [0, 1, 3, 4, 5]
    np.testing.assert_array_equal(motion.segment_motion[..., others], gaussian.segment_motion[..., others])
    np.testing.assert_array_equal(motion.segment_figure, gaussian.segment_figure)


def test_one_rms_does_not_change_the_draw_of_another(few):
    without = FULL.model_copy(update={"piston_nm": 0.0})
    a, b = draw_case([FULL], FULL, few, 1, 0), draw_case([without], without, few, 1, 0)
    others = [0, 1, 3, 4, 5]
    np.testing.assert_array_equal(a.segment_motion[..., others], b.segment_motion[..., others])
    assert not b.segment_motion[..., 2].any()


def test_streams_differ_by_name_seed_and_realization_and_repeat():
    first = generator(1, "a", 0).standard_normal(4)
    np.testing.assert_array_equal(first, generator(1, "a", 0).standard_normal(4))
    for other in (generator(2, "a", 0), generator(1, "b", 0), generator(1, "a", 1)):
        assert not np.array_equal(first, other.standard_normal(4))


def test_a_combination_is_the_sum_of_its_parts_in_their_own_random_numbers(few):
    piston = StaticRandom(name="piston", piston_nm=10.0)
    both = Combine(name="both", of=("polish", "piston"))
    study = [FULL, piston, both]
    alone = [draw_case(study, entry, few, 5, 3) for entry in (FULL, piston)]
    total = draw_case(study, both, few, 5, 3)
    np.testing.assert_array_equal(total.segment_motion, alone[0].segment_motion + alone[1].segment_motion)
    np.testing.assert_array_equal(total.segment_figure, alone[0].segment_figure)
    # Another entry, and another order, change nothing.
    reordered = [StaticRandom(name="new"), both, piston, FULL]
    np.testing.assert_array_equal(draw_case(reordered, both, few, 5, 3).segment_motion, total.segment_motion)


def test_combinations_nest_but_never_contain_themselves():
    a, b = StaticRandom(name="a"), StaticRandom(name="b")
    inner, outer = Combine(name="inner", of=("a", "b")), Combine(name="outer", of=("inner", "a"))
    assert [part.name for part in parts([a, b, inner, outer], outer)] == ["a", "b", "a"]
    loop = Combine(name="inner", of=("a", "outer"))
    with pytest.raises(UserError, match="contains itself"):
        parts([a, b, loop, outer], outer)
    with pytest.raises(UserError, match="combines 'wind', but this study has a, b"):
        parts([a, b], Combine(name="all", of=("a", "wind")))


def test_figures_of_different_length_add_up():
    a, b = still(2, 3, 4), still(2, 3, 6)
    a.segment_figure[:] = 1.0
    b.segment_figure[:] = 2.0
    np.testing.assert_array_equal(add([a, b]).segment_figure, np.tile([3, 3, 3, 3, 2, 2], (3, 1)))


def test_a_study_table_validates_and_survives_json():
    entry = adapter.validate_python(
        {"model": "static-random", "name": "polish", "piston_nm": 3, "figure_nm": {"4": 1.5}}
    )
    assert entry.figure_nm == {4: 1.5}
    assert adapter.validate_json(entry.model_dump_json()) == entry


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"piston_nm": -1.0}, "greater than or equal to 0"),
        ({"piston_nm": float("nan")}, "finite"),
        ({"piston_nm": "much"}, "valid number"),
        ({"pistons": 1.0}, "not permitted"),
        ({"figure_nm": {"3": 1.0}}, "greater than or equal to 4"),
        ({"figure_nm": {"4": -1.0}}, "greater than or equal to 0"),
        ({"instants": 0}, "greater than or equal to 1"),
        ({"share": -1}, "greater than or equal to 0"),
        ({"duration_s": 0.0}, "greater than 0"),
        ({"name": "two words"}, "pattern"),
        ({"model": "static"}, "static-random"),
    ],
)
def test_bad_parameters_are_refused(change, complaint):
    with pytest.raises(ValidationError, match=complaint):
        adapter.validate_python({"model": "static-random", "name": "polish"} | change)


def test_layouts_are_equal_by_content(few):
    import dataclasses

    again = dataclasses.replace(few, centers_m=few.centers_m.copy())
    assert again == few
    assert hash(again) == hash(few)
    assert dataclasses.replace(few, centers_m=few.centers_m + 1) != few


def test_draw_alone_is_what_draw_case_does(few):
    alone = draw(FULL, few, time_axis(FULL), lambda name: generator(1, name, 7))
    np.testing.assert_array_equal(alone.segment_motion, draw_case([FULL], FULL, few, 1, 7).segment_motion)
