"""The workflow segment-mor on coarse segments of tmt-18: its arrays, errors and refusals."""

import numpy as np
import pytest
from small_segments import text_of

from wavequake.campaign.contract import DONE, RAISED
from wavequake.errors import UserError
from wavequake.workflows.segments.mor import KIND

pytestmark = pytest.mark.usefixtures("mirror_models")


@pytest.fixture(scope="module")
def results():
    text = text_of()
    return KIND.compute(text, np.arange(10), "auto")


def rows_of(text):
    table = KIND.case_table(text, 0, 10)
    return list(zip(table["model"], table["variant"], strict=True))


def test_every_array_is_as_the_template_says(results):
    expected = KIND.template(text_of())
    assert set(results.arrays) == set(expected.per_case)
    for name, variable in expected.per_case.items():
        assert results.arrays[name].shape == (10, *variable.shape)
        assert np.isfinite(results.arrays[name][results.status == DONE]).all(), name
    assert expected.fixed["spot_error"][1].max() < 1e-6
    assert "intermediate" in KIND.describe(text_of())["segment"]


def test_a_variant_that_cannot_be_is_left_out_with_the_reason(results):
    for row, (_, variant) in enumerate(rows_of(text_of())):
        assert results.status[row] == (RAISED if variant == "craigb4" else DONE)
        assert ("9" in results.messages[row]) == (variant == "craigb4")


def test_the_reference_has_no_error_and_small_variants_have_one(results):
    for row, (_, variant) in enumerate(rows_of(text_of())):
        if variant == "craigb4":
            continue
        for name in ("eps_mech", "eps_opt", "wfe_error", "los_error", "image_error"):
            assert (results.arrays[name][row].max() == 0.0) == (variant == "full"), (name, variant)


def test_a_variant_can_be_the_reference():
    text = text_of("reduction.reference=modal12", "segments.disturbed=['one']")
    assert list(KIND.case_table(text, 0, 4)["variant"]) == ["modal12", "guyan9", "craigb18", "craigb4"]
    found = KIND.compute(text, np.array([0, 1]), "auto").arrays
    assert found["order"][0] == 12
    assert found["wfe_error"][0].max() == 0.0 < found["wfe_error"][1].max()


def test_errors_are_differences_of_wavefronts(results):
    # ||a - b|| lies between | ||a|| - ||b|| | and ||a|| + ||b||.
    wfe, error = results.arrays["wfe_rms"], results.arrays["wfe_error"]
    for first in (0, 5):
        for row in range(first + 1, first + 5):
            if results.status[row] == DONE:
                assert (error[row] >= np.abs(wfe[row] - wfe[first]) - 1e-6).all()
                assert (error[row] <= wfe[row] + wfe[first]).all()


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (['reduction.variants=["craigb9000"]'], "craigb9000 is above the [0-9]+ degrees of freedom"),
        (["segments.name=Z9"], "segments.name is 'Z9', but the segments of tmt-18 are called 1 to 18"),
        (["telescope.name=tmt-thesis"], "not hexagons that lie alike"),
        (["segments.figure_terms=66", "model.divisions=2"], "do not determine 66 Zernike terms"),
        (["model.mount_radius_m=9.0"], "lie outside the mirror"),
        (
            ["model.divisions=3", "model.mount_radius_m=3.0"],
            "take a finer mesh, or mounts farther from its edge",
        ),
        (["excitation.floor.high_hz=900.0"], "take a smaller time step"),
        (["excitation.sine.interfaces=[3]"], "acts at interface node 3"),
    ],
)
def test_studies_that_cannot_work_say_so(overrides, words):
    with pytest.raises(UserError, match=words):
        KIND.check(text_of('reduction.variants=["guyan9"]', *overrides))


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["model.support=rigid", "excitation.sine.acts=force"], "choose model.support = 'springs'"),
        (["excitation.sine.others=free"], "but springs hold them"),
        (["model.spring_n_m=[5e6, 0.0, 5e6]"], "three positive spring constants"),
        (["segments.disturbed=['one', 'one']"], "listed twice"),
        (["criterion.excitations=['wind']"], "names 'wind'; there are sine, floor"),
        (["segments.nome=8"], "nearest valid key is 'name'"),
        (["reduction.variants=['craig']"], "craig"),
        (["segments.figure_terms=2"], "figure_terms"),
    ],
)
def test_studies_that_are_wrong_are_refused(overrides, words):
    with pytest.raises(UserError, match=words):
        text_of(*overrides)


def test_segments_may_be_named_by_numbers():
    assert text_of("segments.name=8") == text_of("segments.name='8'")


def test_motions_that_take_a_segment_out_of_the_beam_are_left_out_with_the_reason():
    found = KIND.compute(text_of("excitation.sine.amplitude=1.0"), np.array([0]), "auto")
    assert found.status[0] == RAISED
    assert "rays are lost" in found.messages[0]
