"""Campaigns that stop by themselves."""

import numpy as np
import pytest
import toy
import xarray as xr
from scipy.stats import norm

from wavequake.campaign.statistics.until import Goal, goal_of, is_met, looks, quantiles_of
from wavequake.campaign.store.status import store_status
from wavequake.errors import UserError
from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study

TEMPLATE = toy.template(toy.study())


def test_a_goal_is_read():
    assert goal_of("strehl.p95 ci<=2%", TEMPLATE) == Goal("strehl", 0.95, 0.02)
    assert goal_of(" strehl.p97.5  ci <= 0.5 % ", TEMPLATE) == Goal("strehl", 0.975, 0.005)


@pytest.mark.parametrize(
    "text", ["strehl", "strehl.p95", "strehl.p0 ci<=2%", "strehl.p95 ci<=0%", "strehl.p95 ci<=2"]
)
def test_what_is_no_goal_is_refused_with_an_example(text):
    with pytest.raises(UserError, match=r"is no goal; write VARIABLE\.pPERCENT ci<=WIDTH%"):
        goal_of(text, TEMPLATE)


@pytest.mark.parametrize("name", ["names", "count", "time_s", "strel"])
def test_a_variable_without_one_number_per_case_or_instant_is_refused(name):
    with pytest.raises(
        UserError, match=f"^campaign.until: There is no {name!r} to judge; use one of zernike, strehl"
    ):
        goal_of(f"{name}.p50 ci<=2%", TEMPLATE)


def test_looks_are_whole_chunks_that_grow_by_half_and_end_at_the_limit():
    assert list(looks(1000, 20)) == [100, 160, 240, 340, 520, 760, 1000]
    assert list(looks(50, 20)) == [50]
    assert list(looks(3000, 1000)) == [1000, 2000, 3000]


def dataset(values, status=1):
    count = len(values)
    return xr.Dataset(
        {"x": ("case", values), "status": ("case", np.broadcast_to(status, count))},
        {"disturbance": ("case", np.array(["wind", "random"] * (count // 2), dtype=object))},
    )


def test_the_interval_of_a_quantile_shrinks_as_theory_says():
    # The standard error of a sample quantile is sqrt(p (1 - p) / n) / density (Cramer 1946, section 28.5).
    draws, probability = 200_000, 0.9
    values = 10.0 + np.random.default_rng(1).standard_normal(draws)
    found = quantiles_of(Goal("x", probability, 0.1), dataset(values))
    point = norm.ppf(probability)
    error = np.sqrt(probability * (1 - probability) / (draws / 2)) / norm.pdf(point)
    for one in found.values():
        np.testing.assert_allclose((one.high - one.low) / 2, 1.96 * error, rtol=0.1)
    half = 1.96 * error / (10 + point)
    assert is_met(Goal("x", probability, 1.3 * half), found)
    assert not is_met(Goal("x", probability, 0.7 * half), found)


def test_every_population_must_be_known_and_failed_cases_do_not_count():
    values = np.where(np.arange(400) % 2, 5.0, np.random.default_rng(2).uniform(1.0, 9.0, 400))
    goal = Goal("x", 0.5, 0.05)
    assert not is_met(goal, quantiles_of(goal, dataset(values)))
    assert is_met(goal, quantiles_of(goal, dataset(np.full(400, 5.0))))
    assert not is_met(goal, quantiles_of(goal, dataset(np.full(400, 5.0), status=2)))


def test_a_campaign_stops_when_it_knows_enough_and_stays_there(tmp_path):
    keys = {
        "campaign.cases": 900,
        "campaign.until": "segment_piston_rms.p50 ci<=20%",
        "imaging.pixels": 16,
        "store.chunk_cases": 20,
    }
    study = load_study("tmt18-history", keys)
    first = run_study(study, tmp_path / "s", on="serial")
    assert first.goal[0] == "segment_piston_rms.p50 ci<=20% is met after 100 cases"
    assert store_status(tmp_path / "s").counts[1] == 100
    again = run_study(study, tmp_path / "s", on="serial")
    assert again.computed == 0
    assert again.goal == first.goal
