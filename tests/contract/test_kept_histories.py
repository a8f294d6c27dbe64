"""What stores of every workflow keep, against NumPy's statistics of stores that keep everything."""

import numpy as np
import pytest
import toy
from small_kinds import SMALL

from wavequake.campaign.contract import DIVERGED, DONE, StudyKind, Template, Variable
from wavequake.campaign.engine.chunks import computed_alone, computed_chunk, opened_store
from wavequake.campaign.statistics.judged import judged_in
from wavequake.campaign.statistics.until import goal_of, quantiles_of
from wavequake.campaign.store.retention import STATISTICS, kept_template, retention_of, stored_template
from wavequake.campaign.store.store import create_store, open_store
from wavequake.errors import UserError
from wavequake.report.answers.comparison import compare
from wavequake.report.answers.tail import per_case
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.study import load_study, study_with

pytestmark = pytest.mark.usefixtures("mirror_models")


@pytest.fixture
def small(kept_stores):
    """Return the study of a workflow, and what its store keeps under some keys, as functions."""
    study_of, store_of = kept_stores
    return study_of, lambda name, **keys: open_store(store_of(name, **keys)).load()


def over_time(dataset):
    return [name for name in dataset.variables if "time" in dataset[name].dims]


@pytest.mark.parametrize("name", SMALL)
def test_decimated_stores_hold_the_same_bits_at_every_other_instant(small, name):
    _, dataset = small
    whole, short = dataset(name), dataset(name, every=2)
    assert set(whole.variables) == set(short.variables)
    assert (short["status"] == DONE).all()
    assert len(over_time(whole)) > 2
    for key in whole.variables:
        if key == "seconds" or key == "reduce_seconds":
            continue
        expected = whole[key].isel(time=slice(1, None, 2)) if "time" in whole[key].dims else whole[key]
        np.testing.assert_array_equal(short[key].to_numpy(), expected.to_numpy(), err_msg=key)
        assert short[key].attrs == whole[key].attrs


@pytest.mark.parametrize("name", SMALL)
def test_summaries_are_the_statistics_of_the_histories(small, name):
    _, dataset = small
    whole, short = dataset(name), dataset(name, reduce="summary")
    assert "time" not in short.dims
    assert tuple(short["statistic"].to_numpy()) == STATISTICS
    for key in whole.data_vars:
        values = whole[key]
        if "time" not in values.dims:
            if key != "seconds" and key != "reduce_seconds":
                np.testing.assert_array_equal(short[key].to_numpy(), values.to_numpy())
            continue
        if "case" not in values.dims:  # the hammer's force
            assert key not in short
            continue
        for case in range(whole.sizes["case"]):
            # One history after the other, in NumPy's own words.
            one = values.isel(case=case).transpose("time", ...).to_numpy().astype(np.float64)
            if "time_s" in whole:
                one = one[np.isfinite(whole["time_s"].isel(case=case).to_numpy())]
            if "noll" in values.dims:
                found = short[f"{key}_rms"].isel(case=case)
                assert found.dims == tuple(dim for dim in values.dims if dim not in ("case", "time"))
                np.testing.assert_allclose(found, np.sqrt((one**2).mean(0)), rtol=1e-12, err_msg=key)
                continue
            if "axis" in values.dims:
                one = np.hypot(one[..., 0], one[..., 1])
            found = short[key].isel(case=case).transpose("statistic", ...).to_numpy()
            for place in np.ndindex(one.shape[1:]):
                history = one[(slice(None), *place)]
                expected = [
                    np.mean(history),
                    np.sqrt(np.mean(history * history)),
                    min(history),
                    max(history),
                    np.percentile(history, 95),
                    history[-1],
                ]
                np.testing.assert_allclose(
                    found[(slice(None), *place)], expected, rtol=1e-12, atol=0.0, err_msg=key
                )
        assert short[key if key in short else f"{key}_rms"].attrs["units"] == values.attrs["units"]
    small_bytes = sum(short[key].nbytes for key in short.data_vars if "statistic" in short[key].dims)
    assert small_bytes < sum(whole[key].nbytes for key in over_time(whole))


def test_the_identity_changes_with_what_is_kept_only(small):
    study_of, _ = small
    for name in SMALL:
        study = study_of(name)
        assert study.identity() == study_with(study, {"store.every": 1, "store.reduce": "none"}).identity()
        kept = [
            study_with(study, {key: value})
            for key, value in (("store.every", 2), ("store.reduce", "summary"))
        ]
        assert len({study.identity(), *(one.identity() for one in kept)}) == 3
        assert retention_of(kept[0].identity_text()).every == 2
    plain = study_of("system-disturbance").identity_text()
    assert '"store":{}' in plain  # as before there was anything to choose


@pytest.mark.parametrize("statistic", ["mean", "rms", "min", "max", "last"])
def test_rare_events_are_judged_alike_by_histories_and_by_summaries(small, statistic):
    _, dataset = small
    whole, short = dataset("system-disturbance"), dataset("system-disturbance", reduce="summary")
    judged = judged_in("los_mm", whole)
    assert judged == judged_in("los_mm", short)
    (found,) = per_case(whole.chunk(case=2), judged, statistic).values()
    np.testing.assert_allclose(per_case(short, judged, statistic)[""], found, rtol=1e-12)
    one = whole["los_mm"].isel(case=1).to_numpy()[:3]  # the second population has three instants
    lengths = np.hypot(one[..., 0], one[..., 1])
    by_hand = {"rms": np.sqrt((lengths**2).mean(0)), "last": lengths[-1], "mean": lengths.mean(0)}
    by_hand |= {"min": lengths.min(0), "max": lengths.max(0)}
    assert found[1] == pytest.approx(by_hand[statistic].max(), rel=1e-12)


def test_a_campaign_of_an_optical_system_stops_when_its_worst_field_is_known(small):
    study_of, dataset = small
    for name, keys in (("none", {}), ("summary", {"reduce": "summary"})):
        study = study_with(study_of("system-disturbance"), {"store.reduce": name})
        text = study.identity_text()
        goal = goal_of("wfe_rms.p50 ci<=5%", stored_template(find_kind("system-disturbance"), text))
        found = quantiles_of(goal, dataset("system-disturbance", **keys))
        whole = dataset("system-disturbance")
        for case, label in ((slice(0, None, 2), "hum"), (slice(1, None, 2), "sight")):
            mine = whole["wfe_rms"].isel(case=case).to_numpy()
            largest = np.nanmax(mine.reshape(*mine.shape[:2], 4), axis=2, initial=0.0)
            largest = np.where(np.isfinite(mine[:, :, 0, 0]), largest, np.nan)
            expected = np.nanmedian(largest)
            if keys:
                expected = np.median(np.sqrt(np.nanmean(mine**2, axis=1)).max(axis=(1, 2)))
            assert found[label].value == pytest.approx(expected, rel=1e-12)
    mirror = stored_template(find_kind("mirror-mor"), study_of("mirror-mor").identity_text())
    with pytest.raises(UserError, match="There is no 'wfe' to judge; use one of order"):
        goal_of("wfe.p50 ci<=5%", mirror)


def test_stores_that_keep_other_things_are_compared_where_they_can(small):
    _, dataset = small
    whole, short = dataset("system-disturbance"), dataset("system-disturbance", reduce="summary")
    found = compare(whole, short, "whole", "short")
    names = {one.measure for one in found}
    assert {"wfe_rms", "los_mm", "spot_rms", "strehl", "marechal"} <= names
    for one in found:
        np.testing.assert_allclose(one.differences, 0.0, rtol=0, atol=1e-9 * max(1e-6, abs(one.each).max()))


@pytest.mark.parametrize("name", SMALL)
def test_what_does_not_fit_is_refused(small, name):
    study_of, _ = small
    study = study_of(name)
    with pytest.raises(UserError, match=r"'summary' keeps nothing over time; leave store.every out"):
        study_with(study, {"store.reduce": "summary", "store.every": 2})
    with pytest.raises(UserError, match=r"store.every is 5000, but there are cases of \d+ instants"):
        study_with(study, {"store.every": 5000})
    with pytest.raises(UserError, match=r"store.every: .* greater than or equal to 1"):
        study_with(study, {"store.every": 0})
    with pytest.raises(UserError, match=r"store.reduce: .*'none' or 'summary'"):
        study_with(study, {"store.reduce": "all"})


def test_a_workflow_without_histories_has_nothing_to_thin_out():
    for keys in ({"store.every": 2}, {"store.reduce": "summary"}):
        with pytest.raises(UserError, match=r"lens-passive stores nothing over time"):
            load_study("lens-passive", keys)


def toy_store(tmp_path, **options):
    text = toy.study(**options)
    create_store(tmp_path / "s", toy.TOY, text, 6, 6, "numpy", {})
    return toy.job(tmp_path / "s"), text


@pytest.mark.parametrize("store", [{"every": 4}, {"reduce": "summary"}])
def test_a_case_that_blows_up_between_kept_instants_is_found(tmp_path, store):
    """Case 2 is infinite at the third instant of four, and no number at the last."""
    job, _ = toy_store(tmp_path, store=store, blow=[2])
    result, _ = computed_chunk(job, 0, 6)
    assert [int(code) for code in result.status] == [DONE, DONE, DIVERGED, DONE, DONE, DONE]
    assert result.messages[2] == "zernike is not finite from instant 2 on"


def test_a_case_that_fails_has_no_statistics(tmp_path):
    job, _ = toy_store(tmp_path, store={"reduce": "summary"}, reasons=[1], poison=[4])
    result, _ = computed_chunk(job, 0, 6)
    lost = np.isnan(result.arrays["zernike_rms"]).all(axis=1)
    assert np.flatnonzero(lost).tolist() == [1, 4]
    expected = np.sqrt((toy.numbers(3) ** 2).mean(axis=0))
    np.testing.assert_allclose(result.arrays["zernike_rms"][3], expected, rtol=1e-14)
    opened = opened_store(job.workflow, job.path, job.run)
    alone = computed_alone(job, opened, 3).arrays
    np.testing.assert_array_equal(alone["zernike_rms"][0], result.arrays["zernike_rms"][3])


def test_a_template_says_what_is_computed_at_a_time():
    """A summary of 1000 instants is small, but the chunk that makes it is not."""
    attrs = {"units": "nm", "long_name": "history"}
    history = Variable(("controller", "time", "axis"), (2, 1000, 2), attrs, dtype="float32")
    fixed = {"time": (("time",), np.arange(1000.0), {}), "axis": (("axis",), np.array(["x", "y"]), {})}
    computed = Template({"los": history}, fixed, working_bytes=10)
    kept = kept_template(retention_of('{"store": {"reduce": "summary"}}'), computed)
    assert (kept.per_case["los"].dims, kept.per_case["los"].shape) == (("controller", "statistic"), (2, 6))
    assert kept.per_case["los"].dtype == "float64"
    assert kept.working_bytes == 2 * 1000 * 2 * 4
    assert set(kept.fixed) == {"axis", "statistic"}
    third = kept_template(retention_of('{"store": {"every": 3}}'), computed)
    assert third.per_case["los"].shape == (2, 333, 2)
    np.testing.assert_array_equal(third.fixed["time"][1], np.arange(2.0, 999.0, 3.0))
    workflow = StudyKind("w", lambda text: computed, toy.case_table, toy.compute)
    assert kept_template(retention_of("{}"), workflow.template("{}")) is computed
