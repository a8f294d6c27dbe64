"""Which cases count, and what a population reduces to."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.report.populations import (
    Excluded,
    excluded,
    histories_of,
    left_out,
    nothing_known,
    populations,
    representatives,
)


def test_failed_and_missing_cases_are_counted_and_left_out(campaign):
    wind, shake, empty = populations(campaign)
    assert [wind.name, shake.name, empty.name] == ["wind", "shake", "empty"]
    assert wind.cases.tolist() == [0, 2, 4]
    assert (wind.quarantined, wind.todo, len(wind.incomplete)) == (1, 0, 0)
    assert shake.cases.tolist() == [1, 3]
    assert (shake.quarantined, shake.todo) == (1, 1)
    assert (len(empty.cases), empty.todo) == (0, 2)


def test_instants_beyond_a_population_are_no_instants(campaign):
    wind, shake, _ = populations(campaign)
    found = histories_of(campaign, shake)
    assert wind.strehl.shape == (3, 4)
    assert shake.strehl.shape == found.time_s.shape == found.wfe_raw.shape == (2, 2)
    assert np.isfinite(found.los).all()


def test_a_done_case_without_all_its_numbers_is_told(campaign):
    campaign["strehl"][2, 1] = np.nan
    campaign["time_s"][4, 3] = np.nan
    found = populations(campaign)
    assert found[0].cases.tolist() == [0]
    assert found[0].incomplete.tolist() == [2, 4]
    assert {item.case: item.reason for item in excluded(campaign, found)} == {
        2: "a number is missing",
        4: "a number is missing",
        5: "timed out",
        6: "raised",
    }


def test_excluded_cases_say_why(campaign):
    timed_out, raised = excluded(campaign, populations(campaign))
    assert (timed_out.case, timed_out.disturbance, timed_out.realization) == (5, "shake", 2)
    assert timed_out.message == "no answer after 600 s"
    assert raised.message == "segment S1 lost all its rays"


def test_quantiles_of_a_hand_made_population(campaign):
    wind, shake, empty = populations(campaign)
    assert wind.quantile(wind.wfe_raw, 0.5).value == 20.0
    assert wind.quantile(wind.wfe_raw, 0.95).value == pytest.approx(29.0)
    assert wind.quantile(wind.wfe, 0.5).value == 10.0
    strehl = wind.quantile(wind.strehl, 0.5)
    assert strehl.value == pytest.approx(0.65)
    assert (strehl.low, strehl.high) == (-np.inf, np.inf)  # 3 draws, however many instants
    assert wind.quantile(wind.ee80, 0.5).value == 1.25
    assert wind.quantile(wind.peak, 0.05).value == 0.75
    assert shake.los.tolist() == pytest.approx([np.hypot(103.0, 4.0), np.hypot(97.0, 4.0)])  # from rest
    assert wind.los_jitter.radial == 0.0
    assert shake.los_jitter.radial == pytest.approx(5.0 * np.sqrt(2.0))  # of two still cases, N - 1
    assert shake.centroid_jitter.radial == pytest.approx(0.5 * np.sqrt(2.0))
    assert shake.quantile(shake.ee80, 0.5).value == np.inf
    assert len(empty.cases) == 0
    assert np.isnan(empty.quantile(empty.wfe_raw, 0.5).value)
    assert np.isnan(empty.los_jitter.radial)


def test_representatives_are_the_median_and_the_worst_case(campaign):
    assert representatives(populations(campaign)) == {"wind": (2, 4), "shake": (1, 3)}


def test_cases_are_ranked_by_line_of_sight_where_their_wavefronts_are_alike(campaign):
    campaign["wfe_rms_raw"][:] = 10.0
    campaign["los"][0, :, 0] = 7.0
    wind = populations(campaign)[0]
    assert wind.ranked_by == "LOS"
    # Means 7/3: case 0 lies 14/3 from it, cases 2 and 4 lie 7/3.
    np.testing.assert_allclose(wind.severity, [14 / 3, 7 / 3, 7 / 3])
    assert (wind.worst_index, wind.median_index) == (0, 2)
    campaign["los"][:] = 0.0
    assert populations(campaign)[0].ranked_by == "WFE on glass"


def test_case_ids_need_not_be_rows(campaign):
    shifted = campaign.assign_coords(case=campaign["case"] + 100)
    assert representatives(populations(shifted))["wind"] == (102, 104)


def test_another_dataset_is_refused_by_the_name_that_it_lacks(campaign):
    with pytest.raises(UserError, match="no 'strehl'"):
        populations(campaign.drop_vars("strehl"))


@pytest.mark.parametrize("first", [0, 4])
def test_what_is_left_out_is_named_wherever_it_stands(campaign, first):
    part = campaign.isel(case=slice(first, None))
    expected = [
        Excluded(5, "shake", 2, "timed out", "no answer after 600 s"),
        Excluded(6, "wind", 3, "raised", "segment S1 lost all its rays"),
    ]
    assert left_out(part) == expected
    assert left_out(part, most=1) == expected[:1]
    assert [one.disturbance for one in left_out(part, "case")] == ["5", "6"]


def test_disturbances_of_which_every_case_failed_come_first():
    assert nothing_known({"wind": 2}) == "Of wind nothing is known: all 2 of its cases failed. "
    assert nothing_known({"wind": 1, "noise": 0}) == "Of wind nothing is known: its only case failed. "
    words = "Of wind and noise nothing is known: all 5 of their cases failed. "
    assert nothing_known({"wind": 2, "noise": 3}) == words
    assert nothing_known({}) == ""
