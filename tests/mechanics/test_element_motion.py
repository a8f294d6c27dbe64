import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.layout import NO_SEGMENTS
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS
from wavequake.mechanics.disturbances.registry import Combine, draw_case
from wavequake.mechanics.disturbances.sources.line_of_sight import LineOfSight
from wavequake.mechanics.disturbances.sources.surface_random import SurfaceDeformation, SurfaceRandom
from wavequake.mechanics.disturbances.sources.surface_vibration import SurfaceVibration

RANDOM = SurfaceRandom(name="askew", of=("A", "B"), rms={"dx_um": 2.0, "rz_urad": 5.0})
VIBRATION = SurfaceVibration(
    name="hum",
    of=("A",),
    duration_s=0.1,
    instants=200,
    lines=(
        {"frequency_hz": 120.0, "amplitude": {"dy_um": 3.0}},
        {"frequency_hz": 310.0, "amplitude": {"dy_um": 1.0, "ry_urad": 7.0}},
    ),
)
FIGURE = SurfaceDeformation(name="figure", of=("A",), rms_nm={5: 10.0, 8: 4.0})


def test_misalignment_has_the_rms_that_is_asked_for():
    drawn = np.array([draw_case((RANDOM,), RANDOM, NO_SEGMENTS, 1, k).rigid["A"][0] for k in range(2000)])
    rms = np.sqrt(np.mean(drawn**2, axis=0))
    assert rms[[0, 5]] == pytest.approx([2e-6, 5e-6], rel=4 / np.sqrt(2 * len(drawn)))
    assert not drawn[:, 1:5].any()
    assert abs(np.corrcoef(drawn[:, 0], drawn[:, 5])[0, 1]) < 4 / np.sqrt(len(drawn))


def test_vibration_has_its_lines_and_no_others():
    moved = draw_case((VIBRATION,), VIBRATION, NO_SEGMENTS, 1, 0).rigid["A"]
    amplitude = 2.0 * np.abs(np.fft.rfft(moved, axis=0)) / len(moved)  # 10 Hz per bin, whole periods
    expected = np.zeros_like(amplitude)
    expected[12, 1], expected[31, 1], expected[31, 4] = 3e-6, 1e-6, 7e-6
    np.testing.assert_allclose(amplitude, expected, rtol=0, atol=1e-18)


def test_phases_are_uniform():
    phases = []
    for realization in range(400):
        moved = draw_case((VIBRATION,), VIBRATION, NO_SEGMENTS, 1, realization).rigid["A"][:, 1]
        phases.append(np.angle(np.fft.rfft(moved)[12]))
    # Mean of uniform unit phasors: Rayleigh distributed, 4 sigma.
    assert abs(np.mean(np.exp(1j * np.array(phases)))) < 4 / np.sqrt(2 * len(phases))


def test_figures_have_their_terms():
    drawn = np.array([draw_case((FIGURE,), FIGURE, NO_SEGMENTS, 1, k).figure["A"] for k in range(1000)])
    assert drawn.shape == (1000, 8)
    rms = np.sqrt(np.mean(drawn**2, axis=0))
    assert rms[[4, 7]] == pytest.approx([10e-9, 4e-9], rel=0.1)
    assert not drawn[:, [0, 1, 2, 3, 5, 6]].any()


def test_an_elements_draws_are_its_own():
    alone = RANDOM.model_copy(update={"of": ("B",)})
    both = draw_case((RANDOM,), RANDOM, NO_SEGMENTS, 1, 3)
    np.testing.assert_array_equal(draw_case((alone,), alone, NO_SEGMENTS, 1, 3).rigid["B"], both.rigid["B"])
    assert (both.rigid["A"][0, [0, 5]] != both.rigid["B"][0, [0, 5]]).all()
    assert (draw_case((RANDOM,), RANDOM, NO_SEGMENTS, 1, 4).rigid["A"] != both.rigid["A"])[0, 0]
    assert (draw_case((RANDOM,), RANDOM, NO_SEGMENTS, 2, 3).rigid["A"] != both.rigid["A"])[0, 0]


def test_a_combination_is_the_sum_of_its_parts():
    sight = LineOfSight(name="sight", rms_mas=10.0)
    more = SurfaceDeformation(name="more", of=("A", "B"), rms_nm={4: 1.0})
    axis = {"duration_s": 0.1, "instants": 200}
    single = [part.model_copy(update=axis) for part in (RANDOM, VIBRATION, FIGURE, more, sight)]
    whole = Combine(name="all", of=tuple(part.name for part in single), **axis)
    populations = (*single, whole)
    total = draw_case(populations, whole, NO_SEGMENTS, 1, 5)
    parts = [draw_case(populations, part, NO_SEGMENTS, 1, 5) for part in single]
    np.testing.assert_array_equal(total.rigid["A"], parts[0].rigid["A"] + parts[1].rigid["A"])
    np.testing.assert_array_equal(total.rigid["B"], parts[0].rigid["B"])
    assert total.figure["A"][3] == parts[3].figure["A"][3]
    np.testing.assert_array_equal(total.figure["A"][4:], parts[2].figure["A"][4:])
    np.testing.assert_array_equal(total.mount, parts[4].mount)
    assert np.abs(total.mount).max() > RAD_PER_MAS


def test_a_combination_of_itself_is_refused():
    knot = Combine(name="knot", of=("askew", "knot"))
    with pytest.raises(UserError, match="contains itself"):
        draw_case((RANDOM, knot), knot, NO_SEGMENTS, 1, 0)
