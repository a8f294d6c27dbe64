"""`wavequake budget` and `wavequake tail` as a user meets them."""

import pytest

from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study

SMALL = ["telescope.name=tmt-18", "optics.rays_per_segment=6", "imaging.enabled=false"]


def test_a_budget_is_a_table_and_a_figure_of_the_report(tmp_path, wavequake):
    store = tmp_path / "s"
    words = ("budget", "tmt-segments", *SMALL, "--cases", 16, "--store", store)
    code, out, _ = wavequake(*words)
    assert code == 0
    assert "ring 2 (12 segments)" in out
    assert "Written:" in out
    run_study(load_study("tmt-segments", [*SMALL, "campaign.cases=8"]), store, on="serial")
    code, _, _ = wavequake("report", store)
    assert code == 0
    assert 'id="budget"' in (store / "report.html").read_text()
    code, out, _ = wavequake(*words)
    assert "Was there already, nothing was computed" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("tmt-segments", *SMALL, "--cases", "0"), "A budget of 0 cases says nothing"),
        (("lens-experiment",), "A budget is of segment-disturbance and system-disturbance studies"),
        (("tmt-segments", *SMALL, "--of", "x"), "There is no combination 'x' in this study"),
    ],
)
def test_a_budget_that_cannot_be_is_refused_in_one_sentence(tmp_path, wavequake, words, message):
    code, _, err = wavequake("budget", *words, "--store", tmp_path / "s")
    assert code == 2
    assert message in err
    assert not (tmp_path / "s").exists()


@pytest.fixture(scope="module")
def swings(tmp_path_factory):
    """Two thousand cases of pistons by the modal model."""
    store = tmp_path_factory.mktemp("tail") / "s"
    keys = {"telescope.name": "tmt-18", "campaign.cases": 2000, "store.chunk_cases": 1000}
    run_study(load_study("tmt-million", keys), store, on="serial")
    return store


def test_a_tail_says_what_is_hardly_ever_exceeded_and_how_often_a_limit_is(swings, wavequake):
    code, out, _ = wavequake("tail", swings, "--limit", 40, "--statistic", "max")
    assert code == 0
    assert "swing" in out
    assert "generalized Pareto" in out
    assert "share above" in out


def test_a_tail_is_that_of_the_values_of_the_store(swings):
    from wavequake.campaign.statistics.tail import fit_tail, rare_value
    from wavequake.campaign.store.store import open_store
    from wavequake.report.answers.tail import RareQuestion, rare_events

    values = open_store(swings)["wfe_rms_raw"].sel(statistic="rms").to_numpy()
    answer = rare_events(swings, RareQuestion("wfe_rms_raw", "rms", 1e-4))
    (found,), unit = answer.found, answer.unit
    assert found.value == rare_value(fit_tail(values), 1e-4)
    assert unit == "nm"
    (small,) = rare_events(swings, RareQuestion("wfe_rms_raw", "rms", 1e-4, below=True)).found
    assert small.value == rare_value(fit_tail(-values), 1e-4)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--variable", "strel"), "There is no 'strel' to judge; use one of wfe_rms"),
        (("--variable", "zernike_rms"), "a number for each noll; choose one, as zernike_rms[noll=1]."),
        (("--variable", "wfe_rms[controller=FF]"), "wfe_rms has no 'controller'; it has no labels"),
        (("--variable", "wfe rms"), "'wfe rms' names nothing to judge"),
        (("--statistic", "median"), "There is no statistic 'median'; use one of mean, rms"),
        (("--probability", "0"), "The probability 0 is not rare"),
        (("--probability", "nan"), "The probability nan is not rare"),
        (("--threshold", "1e9"), "swing: Only 0 of 2000 cases exceed 1e+09, and a tail needs at least 50"),
        (("--limit", "nan"), "The limit nan is no number"),
    ],
)
def test_a_tail_that_cannot_be_is_refused_in_one_sentence(swings, wavequake, words, message):
    code, _, err = wavequake("tail", swings, *words)
    assert code == 2
    assert message in err


def test_a_budget_is_not_put_into_the_store_of_another_study_nor_into_other_folders(
    swings, tmp_path, wavequake
):
    (tmp_path / "notes.txt").write_text("mine")
    for folder, message in ((swings, "belongs to another study"), (tmp_path, "is not a store")):
        words = ("budget", "tmt-segments", *SMALL, "--cases", 16, "--store", folder)
        code, _, err = wavequake(*words)
        assert code == 2
        assert message in err
        assert not (folder / "budget.zarr").exists()


def test_stores_of_unlike_sampling_are_not_compared(tmp_path, wavequake):
    keys = [*SMALL, "campaign.cases=8", "campaign.replicates=2"]
    for name in ("random", "sobol"):
        study = load_study("tmt-segments", [*keys, f"campaign.sampling={name}"])
        run_study(study, tmp_path / name, on="serial")
    code, _, err = wavequake("compare", tmp_path / "random", tmp_path / "sobol")
    assert code == 2
    assert "have other draws (sampling random there, sampling sobol, replicates 2 here)" in err.replace(
        "replicates 2, sampling sobol", "sampling sobol, replicates 2"
    )
