"""Reports of stores without images or instants, on the 18-segment telescope."""

import csv
import io

import numpy as np
import pytest
import xarray as xr
from rich.console import Console

import wavequake as wq
from wavequake.report import populations as of_segments
from wavequake.report.answers.comparison import compare
from wavequake.report.campaign import report_store, summary_table
from wavequake.report.exports.rerun import rerun_stored
from wavequake.report.exports.store import export
from wavequake.report.populations import is_whole
from wavequake.report.segments import report as segment_report
from wavequake.report.table import row_of
from wavequake.report.written import read_answer
from wavequake.workflows.study import load_study

KEYS = {
    "telescope.name": "tmt-18",
    "optics.rays_per_segment": 6,
    "wavefront.zernike_terms": 11,
    "store.chunk_cases": 64,
}
CASES = 120


def made(folder, **keys):
    study = load_study("tmt-million", KEYS | {key.replace("__", "."): value for key, value in keys.items()})
    wq.run(study, cases=CASES, store=folder)
    return folder


def printed(store):
    buffer = io.StringIO()
    Console(file=buffer, width=200, color_system=None).print(summary_table(store))
    return " ".join(buffer.getvalue().split())


def report_rows(store):
    return [row_of(one) for one in segment_report._populations(store, wq.open_store(store))]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return made(tmp_path_factory.mktemp("store") / "summary")


def test_a_summary_has_the_numbers_of_the_arrays_over_time(store, tmp_path):
    whole = made(tmp_path / "whole", store__reduce="none")
    (short,), (long,) = (of_segments.populations(wq.open_store(path)) for path in (store, whole))
    for name in ("wfe_raw", "wfe", "los", "segment_piston"):
        np.testing.assert_allclose(getattr(short, name), getattr(long, name), rtol=1e-12)
        assert getattr(short, name).shape == (CASES,)
    (row,) = report_rows(store)
    assert float(row["segments model (nm)"][0]) == pytest.approx(float(row["segments (nm)"][0]), rel=0.1)


def test_a_store_of_too_many_instants_is_reported_case_by_case(tmp_path, monkeypatch):
    keys = {"imaging.pixels": 16, "optics.rays_per_segment": 6, "wavefront.zernike_terms": 11}
    study = load_study("tmt-segments", keys | {"telescope.name": "tmt-18"})
    wq.run(study, cases=8, store=tmp_path)
    dataset = wq.open_store(tmp_path)
    assert is_whole(dataset)
    monkeypatch.setattr(of_segments, "_MOST_INSTANTS", dataset["wfe_rms"].size - 1)
    assert not is_whole(dataset)
    assert "P99.9" in printed(tmp_path)
    _, path = report_store(tmp_path)
    assert "wind-shake" in path.read_text()


def test_the_table_has_the_quantiles_and_the_certificate(store):
    dataset, text = wq.open_store(store), printed(store)
    raw = dataset["wfe_rms_raw"].sel(statistic="rms").to_numpy()
    for p in (0.5, 0.95):
        assert f"{np.quantile(raw, p):.1f}" in text
    certified = int((dataset["traced"] == 1).sum())
    assert 100 <= certified < CASES
    assert f"Modal model: {CASES} cases, of which {certified} were traced in full" in text
    assert "error; none is beyond its range (second order above 0.1 nm)" in text
    assert "WARNING" not in text


def test_the_report_is_one_page_with_figures_and_definitions(store):
    text = report_store(store)[1].read_text()
    assert text.count("<svg") == 4  # one is the layout
    for words in (
        "WFE on glass",
        "largest error of the modal model",
        "tilt removed",
        "swing: the wavefront error of 95 % of its",
    ):
        assert words in text


def test_errors_above_the_tolerance_are_not_passed_over(tmp_path, monkeypatch):
    """A bound that is far too small: the traces of the sample tell."""
    from wavequake.optics.segments import modal

    monkeypatch.setattr(modal, "error_bound", lambda model, sizes: np.zeros(len(sizes)))
    store = made(tmp_path / "far", disturbance__swing__piston_nm=5e6)
    assert "WARNING: the error of 1" in printed(store)
    assert "above the tolerance" in report_store(store)[1].read_text()


def test_full_traces_without_images_need_no_certificate(tmp_path):
    store = made(tmp_path / "traced", optics__light="traced", store__reduce="none")
    text = printed(store)
    assert "Modal" not in text
    raw = wq.open_store(store)["wfe_rms_raw"].to_numpy()
    assert f"{np.quantile(np.sqrt(np.mean(raw**2, axis=1)), 0.5):.1f}" in text
    assert report_store(store)[1].read_text().count("<svg") == 3


def test_a_case_of_a_summary_is_computed_again_with_its_bits(store, tmp_path):
    found = rerun_stored(store, 7, tmp_path / "case.nc")
    assert not found.differing
    assert not found.trouble
    with xr.open_dataset(tmp_path / "case.nc") as case:
        nm = case["opd"].to_numpy() - case["opd"].to_numpy().mean(axis=1, keepdims=True)
        last = float(case["wfe_rms_raw"][-1])
        assert nm.shape[0] == 10
        assert np.sqrt(np.mean(nm[-1] ** 2)) == pytest.approx(last, rel=1e-2)  # rays weigh nearly alike


def test_summaries_are_compared_by_their_rms(store, tmp_path):
    """Twice the pistons: twice the motion of the segments and of the line of sight."""
    other = made(tmp_path / "twice", disturbance__swing__piston_nm=40.0)
    found = compare(wq.open_store(store), wq.open_store(other), "once", "twice")
    apart = {one.measure: one for one in found}
    for name in ("segment_piston_rms", "los"):
        expected = float(wq.open_store(store)[name].sel(statistic="rms").mean())
        assert apart[name].differences.mean() == pytest.approx(expected, rel=1e-6)


def test_a_csv_file_has_a_column_per_statistic(store, tmp_path):
    with export(wq.open_store(store), tmp_path / "cases.csv").open() as file:
        rows = list(csv.DictReader(file))
    found = wq.open_store(store)["wfe_rms_raw"]
    for name in ("rms", "max", "last"):
        column = [float(row[f"wfe_rms_raw_{name} (nm)"]) for row in rows]
        np.testing.assert_array_equal(column, found.sel(statistic=name).to_numpy())


def test_a_store_near_a_limit_says_that_it_does_not_tell_how_often(tmp_path, store):
    keys = {
        "telescope.name": "tmt-18",
        "optics.rays_per_segment": 6,
        "rare.limit": 100.0,
        "campaign.cases": 3,
    }
    wq.run(load_study("tmt-rare", keys), store=tmp_path / "near", on="serial")
    near, plain = (read_answer(wq.report(path)) for path in (tmp_path / "near", store))
    assert near.endswith("They are drawn near the limit: how often it is exceeded says wavequake rare.")
    assert "near the limit" not in plain
