"""What a plan proposes for an accuracy, against errors that are known in closed form."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from wavequake.campaign.plugins import load_plugin
from wavequake.errors import UserError
from wavequake.report.answers import accuracy
from wavequake.report.answers.accuracy import accuracy_of, cases_for_quantile, plan_accuracy
from wavequake.workflows.study import load_study


@pytest.fixture
def study(tmp_path):
    load_plugin(Path(__file__).parents[1] / "workflows" / "quadrature.py")
    (tmp_path / "q.toml").write_text(
        '[study]\nname = "q"\nworkflow = "quadrature"\n[campaign]\ncases = 200\n[optics]\nrays = 4\n'
    )
    return load_study(tmp_path / "q.toml")


def test_rays_are_those_that_the_rule_needs(study):
    said = plan_accuracy(study, 1e-4, "mean", ["q.toml", "optics.rays=4"])
    words = said["rays"].split(": ")[1]
    slopes = 1.0 + 0.5 * np.random.default_rng(3).random(1000)[:4]
    rms = {}
    for rays in (int(words), int(words) - 5):
        rule = np.exp(np.outer(slopes, (np.arange(rays) + 0.5) / rays)).mean(axis=1)
        rms[rays] = np.sqrt(np.mean((rule / ((np.exp(slopes) - 1.0) / slopes) - 1.0) ** 2))
    assert rms[int(words)] < 1.15e-4
    assert rms[int(words) - 5] > 1e-4
    assert f"optics.rays={words}" in said["proposal"]
    assert said["proposal"].startswith("wavequake run q.toml optics.rays=")
    assert said["linearisation"] == "optics.light=modal suffices (0 %)"


def test_light_and_cases_are_proposed_where_they_err(study):
    said = plan_accuracy(study, 1e-3, "tilt")
    assert said["linearisation"].startswith("the modal model errs by 0.")
    assert "optics.light=traced" in said["proposal"]
    assert said["rays"] == "optics.rays=4 suffices (0 %)"
    assert "campaign.cases=" in said["proposal"]
    enough = plan_accuracy(study, 0.3, "tilt")
    assert enough["proposal"] == "the study is as accurate as that"
    with pytest.raises(UserError, match="There is no measure 'x' to be accurate; use one of mean, tilt"):
        plan_accuracy(study, 0.1, "x")


def test_every_population_and_point_gets_its_cases(tmp_path):
    """The smaller of two populations needs as many as it would alone; each point of a sweep has them all."""
    shares = "[[disturbance]]\nname = 'a'\nmodel = 'static-random'\npiston_nm = 30.0\nshare = {}\n"
    (tmp_path / "s.toml").write_text(
        "[study]\nname = 's'\nworkflow = 'segment-disturbance'\n[campaign]\ncases = 80\n"
        "[telescope]\nname = 'tmt-18'\n[imaging]\nenabled = false\n"
        + shares.format(3)
        + shares.format(1).replace("'a'", "'b'")
    )
    both = load_study(tmp_path / "s.toml")

    def wanted(study):
        words = plan_accuracy(study, 0.05, "segment_piston_rms")["cases"]
        return int(words.split(": ")[1].split()[0])

    alone = wanted(load_study(tmp_path / "s.toml", {"disturbance.b.share": 0}))
    assert wanted(both) >= 3 * alone
    swept = {"sweep.optics.wavelength_nm": [500.0, 600.0, 700.0], "disturbance.b.share": 0}
    thrice = load_study(tmp_path / "s.toml", swept)
    assert wanted(thrice) == alone
    said = plan_accuracy(thrice, 0.05, "wfe_rms")
    assert said["rays"].startswith("optics.rays_per_segment=18 ")
    # Steps between segments are no sum of few polynomials, and of 90 terms nothing is measured but this.
    assert said["terms"].endswith(": 90, which may not suffice: plan that one again")
    few = load_study(tmp_path / "s.toml", {"sweep.optics.rays_per_segment": [6, 18]})
    assert "rays" not in plan_accuracy(few, 0.05, "wfe_rms")


def test_so_many_cases_know_a_quantile_to_the_accuracy():
    scatter, wanted = 0.4, 0.05
    cases = round(cases_for_quantile(scatter, 0.95, wanted))
    random = np.random.default_rng(5)
    found = np.quantile(np.exp(scatter * random.standard_normal((2000, cases))), 0.95, axis=1)
    exact = np.exp(scatter * 1.6448536269514722)
    inside = np.abs(found / exact - 1.0) <= wanted
    assert 0.93 < inside.mean() < 0.97


def test_the_order_of_a_reduced_model_is_chosen_by_its_error():
    models = ["full", "small", "large"] * 3
    labels = xr.Dataset(
        {}, {"reduction": ("case", models), "realization": ("case", np.repeat(np.arange(3), 3))}
    )
    values = {("wfe", ""): np.tile([1.0, 1.1, 1.001], 3)}
    groups = {name: np.flatnonzero(np.array(models) == name) for name in ("full", "small", "large")}
    levels = {name: {("wfe", ""): 1.0} for name in groups}
    for wanted, words in ((0.01, "large (0.10 %) suffices"), (1e-4, "none suffices; large errs by 0.10 %")):
        (one,) = accuracy._reduced(labels, values, [("wfe", "")], groups, levels, wanted)
        assert one.words.startswith(words)


@pytest.mark.parametrize("text", ["0", "2", "150 %", "x", "-1 %", "nan", ""])
def test_what_is_no_accuracy_is_a_sentence(text):
    with pytest.raises(UserError, match="is no share between 0 and 1; write it as '1 %'"):
        accuracy_of(text)
    assert accuracy_of("1 %") == accuracy_of("0.01") == pytest.approx(0.01)


def test_the_command_proposes_what_to_run(wavequake):
    few = ("telescope.name=tmt-18", "imaging.enabled=false", "optics.rays_per_segment=6", "campaign.cases=8")
    words = ("plan", "tmt-segments", *few)
    code, out, _ = wavequake(*words, "--accuracy", "5 %")
    assert code == 0
    assert "wavequake run tmt-segments telescope.name=tmt-18" in " ".join(out.split())
    code, _, err = wavequake(*words, "--measure", "wfe_rms")
    assert code == 2
    assert "--measure belongs to an accuracy" in err
