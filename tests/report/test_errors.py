"""Errors of stored numbers against quadratures, series and models whose errors are known."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import wavequake as wq
from wavequake.campaign.engine.pool import Place
from wavequake.campaign.plugins import load_plugin
from wavequake.campaign.statistics.refinement import refinement_error
from wavequake.errors import UserError
from wavequake.report.answers.errors import open_errors, reduction_errors, spread_ids, store_errors
from wavequake.report.answers.errors_shown import errors_notes, errors_table, number_errors, with_errors
from wavequake.report.answers.errors_shown import pictures as errors_pictures
from wavequake.report.plain import Row
from wavequake.report.statistics import quantile
from wavequake.workflows.refinements import refinements
from wavequake.workflows.study import load_study, study_with

STUDY = """
[study]
name = "q"
workflow = "quadrature"
[campaign]
cases = 200
"""


@pytest.mark.parametrize("order", [0.5, 1.0, 2.0, 4.0])
def test_an_error_that_falls_with_a_power_is_found_from_three_steps(order):
    constants = np.array([3.0, -1.0, 2.0])
    for counts in ((10, 20, 40), (18, 36, 72), (6, 18, 36)):
        values = 5.0 + np.outer(np.array(counts, dtype=float) ** -order, constants)
        for base in range(3):
            found = refinement_error(counts, values, base)
            exact = np.sqrt(np.mean((constants * counts[base] ** -order) ** 2))
            np.testing.assert_allclose(found.error, exact, rtol=1e-6)
            np.testing.assert_allclose(found.order, order, rtol=1e-6)
            assert found.settled


def test_steps_that_do_not_converge_have_their_spread():
    found = refinement_error((1, 2, 4), np.array([[1.0], [1.1], [0.8]]))
    assert not found.settled
    np.testing.assert_allclose(found.error, 0.3, rtol=1e-12)
    assert refinement_error((1, 2, 4), np.ones((3, 5))).error == 0.0
    np.testing.assert_allclose(refinement_error((1, 2), np.array([[1.0], [1.5]])).error, 0.5)


def test_cases_are_spread_over_members_alone():
    members = np.arange(100) % 3 == 1
    found = spread_ids(members, 5)
    assert members[found].all()
    assert len(found) == 5
    assert np.ptp(found) > 70
    assert spread_ids(members, 1000).tolist() == np.flatnonzero(members).tolist()


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    load_plugin(Path(__file__).parents[1] / "workflows" / "quadrature.py")
    folder = tmp_path_factory.mktemp("errors")
    (folder / "q.toml").write_text(STUDY)
    wq.run(folder / "q.toml", store=folder / "s", on="serial")
    return folder / "s"


def test_a_quadrature_and_a_linear_model_have_the_errors_of_closed_forms(store):
    found = store_errors(store, 20)
    slopes = 1.0 + 0.5 * np.random.default_rng(3).random(1000)[:100]
    exact = (np.exp(slopes) - 1.0) / slopes
    ids = spread_ids(np.arange(200) % 2 == 0, 20) // 2
    rule = np.array([np.exp(np.outer(slopes, (np.arange(10) + 0.5) / 10)).mean(axis=1)])[0]
    rays = np.sqrt(np.mean((rule - exact)[ids] ** 2))
    one = found.sel(population="even")
    names = one["name"].to_numpy().tolist()
    mean, tilt = (one.isel(measure=names.index(name)) for name in ("mean", "tilt"))
    np.testing.assert_allclose(float(mean["error"].sel(origin="rays")), rays, rtol=1e-3)
    np.testing.assert_allclose(float(mean["order"].sel(origin="rays")), 2.0, rtol=1e-2)
    linear = np.sqrt(np.mean((0.1 * slopes - np.sin(0.1 * slopes))[ids] ** 2))
    np.testing.assert_allclose(float(tilt["error"].sel(origin="linearisation")), linear, rtol=1e-9)
    assert float(tilt["error"].sel(origin="rays")) == 0.0
    level = quantile(rule, 0.5)
    np.testing.assert_allclose(float(mean["level"][0]), level.value, rtol=1e-12)
    np.testing.assert_allclose(float(mean["sampling"][0]), 0.5 * (level.high - level.low), rtol=1e-12)
    kept = open_errors(store)
    np.testing.assert_array_equal(kept["error"], found["error"])
    assert kept["name"].to_numpy().tolist() == names
    again = store_errors(store, 20, Place("local", 2))
    np.testing.assert_array_equal(again["error"], found["error"])


def test_tables_show_the_errors_that_matter(store):
    found = store_errors(store, 20)
    errors = number_errors(found, 0)
    assert errors["mean"].most == "sampling"
    assert errors["tilt"].shares["linearisation"] == pytest.approx(0.1**2 * 1.25**2 / 6.0, rel=0.1)
    row = {"cases of": ("even", ""), "mean P50 (nm)": ("1.9", "1.8–2.0"), "tilt P50 (mas)": ("0.12", "")}
    sharp = found.copy(deep=True)
    sharp["sampling"][:] = 1e-9
    (shown,) = with_errors(sharp, [row])
    assert shown["mean P50 (nm)"][1].startswith("1.8–2.0; rays ± ")
    assert shown["tilt P50 (mas)"][1].startswith("linearisation ± 0.2")
    (calm,) = with_errors(found, [row])
    assert calm == row
    assert errors_table(found).row_count == 4
    assert any("optics.rays=10; optics.rays=20; optics.rays=40" in line for line in errors_notes(found))


def test_what_has_no_error_has_no_row_in_the_figure_and_nothing_no_figure(store):
    found = store_errors(store, 20).copy(deep=True)
    assert "tilt</text>" in errors_pictures(found)[0].svg
    tilt = found["name"].to_numpy() == "tilt"
    for key in ("error", "sampling"):
        found[key] = found[key].where(xr.DataArray(~tilt, dims="measure"), np.inf)
    (one,) = errors_pictures(found)
    assert "mean</text>" in one.svg
    assert "tilt</text>" not in one.svg
    for key in ("error", "sampling"):
        found[key] = xr.full_like(found[key], np.inf)
    assert errors_pictures(found) == []


def test_models_beside_each_other_are_no_draws_and_have_no_error_by_sampling(store, monkeypatch):
    draws = store_errors(store, 20)
    module = "wavequake.report.answers.errors"
    monkeypatch.setattr(
        f"{module}.populations_of", lambda dataset, compared: dataset["case"].astype(str).values
    )
    found = store_errors(store, 20)
    assert np.isnan(found["sampling"]).all()
    np.testing.assert_array_equal(found["error"], draws["error"])
    assert number_errors(found, 0)["mean"].most == "rays"
    assert [*errors_table(found).columns[-2].cells] == ["–, –"] * 4


def test_a_store_that_cannot_be_written_is_refused_before_anything_is_computed(store, monkeypatch):
    monkeypatch.setattr("os.access", lambda path, mode: False)
    monkeypatch.setattr("wavequake.report.answers.errors.cases_again", None)
    with pytest.raises(UserError, match="cannot be written, and keeps its errors: copy it"):
        store_errors(store)


def test_the_report_has_the_errors_of_its_store(store, wavequake):
    code, out, _ = wavequake("errors", store, "--cases", 4)
    assert code == 0
    assert "linearisation" in out
    code, _, _ = wavequake("report", store)
    assert code == 0
    assert 'id="errors"' in (store / "report.html").read_text()
    code, _, err = wavequake("errors", store, "--cases", 1)
    assert (code, "take at least 2" in err) == (2, True)
    code, _, err = wavequake("errors", store / "none")
    assert code == 2
    assert "Traceback" not in err


def test_the_modal_model_errs_by_what_full_traces_say(tmp_path):
    keys = {"telescope.name": "tmt-18", "campaign.cases": 140, "store.chunk_cases": 70}
    dataset = wq.run(load_study("tmt-million", keys), store=tmp_path / "s", on="serial")
    found = store_errors(tmp_path / "s", 4)
    ids = spread_ids(dataset["status"].to_numpy() == 1, 4)
    study = load_study("tmt-million", {**keys, "optics.light": "traced"})
    full = wq.run(study, store=tmp_path / "t", on="serial")
    apart = [
        np.sqrt((one.wfe_rms_raw.isel(case=ids) ** 2).mean("time"))
        if "time" in one.wfe_rms_raw.dims
        else one.wfe_rms_raw.sel(statistic="rms").isel(case=ids)
        for one in (dataset, full)
    ]
    exact = float(np.sqrt(((apart[0] - apart[1]) ** 2).mean()))
    names = found["name"].to_numpy().tolist()
    error = float(found["error"].sel(origin="linearisation").isel(measure=names.index("wfe_rms_raw"))[0])
    np.testing.assert_allclose(error, exact, rtol=1e-6, atol=1e-12)


def test_studies_say_what_may_be_computed_finer():
    def origins(name, **keys):
        return {one.origin: one for one in refinements(load_study(name, keys))}

    segments = origins("tmt-segments", **{"optics.rays_per_segment": 36})
    assert segments["rays"].counts == (18, 36, 72)
    assert segments["rays"].base == 1
    assert segments["terms"].steps[1] == {"wavefront.zernike_terms": 90, "optics.rays_per_segment": 72}
    assert set(origins("tmt-million")) == {"rays", "terms", "linearisation"}
    assert set(origins("double-gauss")) == {"rays", "terms"}
    assert set(origins("lens-passive")) <= {"rays", "terms"}


def test_a_reduced_model_errs_by_what_the_full_one_says_of_the_same_draw():
    models = ["full", "small", "full", "small", "small", "full"]
    labels = {"disturbance": ["a", "a", "a", "a", "b", "b"], "realization": [0, 0, 1, 1, 0, 0]}
    coordinates = {name: ("case", values) for name, values in {"reduction": models, **labels}.items()}
    dataset = xr.Dataset({}, {"case": np.arange(6), **coordinates})
    row = Row("wfe", "", "nm", np.array([1.0, 1.3, 2.0, 2.4, np.inf, 7.0]))
    error = reduction_errors(dataset, [row])["wfe", ""]
    small = np.array(models) == "small"
    np.testing.assert_allclose(error(small), np.sqrt((0.3**2 + 0.4**2) / 2.0), rtol=1e-12)
    assert error(~small) == 0.0
    assert np.isnan(error(small & (np.array(labels["disturbance"]) == "b")))
    assert reduction_errors(dataset.drop_vars("reduction"), [row]) == {}


def test_bodies_that_are_reduced_are_refined_together():
    keys = {"body.primary.mirror.reduced": "craigb36", "body.secondary.mirror.reduced": "modal30"}
    study = load_study("telescope-structure", keys)
    study = study.model_copy(update={"reduction": None})
    (one,) = (each for each in refinements(study) if each.origin == "reduction")
    assert one.counts == (1.0, 2.0, np.inf)
    assert one.steps[1] == {
        "body.primary.mirror.reduced": "craigb72",
        "body.secondary.mirror.reduced": "modal60",
    }
    assert study_with(study, one.steps[2]).body[0].mirror.reduced == "full"


def test_a_store_without_cases_has_no_errors(tmp_path, monkeypatch):
    def stop(done, total, failed):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        wq.run("double-gauss", cases=2, store=tmp_path / "s", on="serial", progress=stop)
    if (tmp_path / "s" / "manifest.json").exists():
        with pytest.raises(UserError, match="is done, and none has an error"):
            store_errors(tmp_path / "s")
