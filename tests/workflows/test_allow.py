"""Allowances against ordinary campaigns, and against sensitivities that know nothing of the modal model."""

import csv

import numpy as np
import pytest
from scipy.stats import binom, chi2
from small_telescope import TRACED

import wavequake as wq
from wavequake.campaign.rare.quadratic import largest_factor, quadratic_form
from wavequake.errors import UserError
from wavequake.report.answers.allow import allow_notes, goal_of, write_allowances
from wavequake.workflows.allow import allowances
from wavequake.workflows.study import load_study, study_with

STUDY = (
    TRACED
    + """[[disturbance]]
name = "aligned"
model = "static-random"
piston_nm = 20.0
tip_nrad = 5.0
tilt_nrad = 5.0
figure_nm = { 4 = 5.0 }
instants = 2
"""
)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "small.toml"
    path.write_text(STUDY)
    return load_study(path)


def test_a_factor_is_that_of_chi_squared():
    form = quadratic_form(2.0, np.zeros(5), np.eye(5))
    found = largest_factor(form, 3.0, 0.05)
    np.testing.assert_allclose(found**2 * chi2.isf(0.05, 5), 1.0, rtol=1e-10)
    with pytest.raises(UserError, match="exceeded at rest"):
        largest_factor(form, 1.0, 0.05)


def test_what_a_study_has_grown_by_the_factor_meets_the_limit(study, tmp_path):
    found = allowances(study, "wfe_rms", 0.05, 60.0, "factor", "aligned", cases=200)
    assert found.axes == ("dz", "rx", "ry", "figure 4")
    np.testing.assert_allclose(found.rms[0], found.factor * 20e-9, rtol=1e-12)
    np.testing.assert_allclose(found.rms[1], found.factor * 5e-9, rtol=1e-12)
    np.testing.assert_allclose(found.shares.sum(), 1.0, rtol=1e-9)
    assert found.check.low <= 60.0 <= found.check.high
    sizes = {"piston_nm": 20.0, "tip_nrad": 5.0, "tilt_nrad": 5.0}
    keys = {f"disturbance.aligned.{key}": found.factor * value for key, value in sizes.items()}
    keys["disturbance.aligned.figure_nm"] = {"4": found.factor * 5.0}
    grown = study_with(study, {**keys, "optics.light": "modal", "optics.modal_sample": 0.0})
    values = wq.run(grown, cases=2000, store=tmp_path / "s").wfe_rms.isel(time=0)
    above = int((values > 60.0).sum())
    assert binom.ppf(1e-3, 2000, 0.05) <= above <= binom.isf(1e-3, 2000, 0.05)


def test_equal_shares_are_equal_by_the_sensitivities(study, tmp_path):
    found = allowances(study, "wfe_rms", 0.05, 60.0, "shares", "aligned", cases=200)
    np.testing.assert_allclose(found.shares, found.shares[0, 0], rtol=1e-9)
    np.testing.assert_allclose(found.shares.sum(), 1.0, rtol=1e-9)
    assert found.check.low <= 60.0 <= found.check.high
    known = wq.sensitivity(study, store=tmp_path / "s").sensitivity_zernike_segment
    columns = known.sel(noll=slice(4, None)).transpose("dof", "segment", "noll")
    sizes = np.linalg.norm(columns.sel(dof=["dz", "rx", "ry"]).to_numpy(), axis=2)
    costs = found.rms[:3] * sizes
    np.testing.assert_allclose(costs, costs[0, 0], rtol=1e-5)


def test_segments_have_costs_and_kinds_of_their_own(study):
    keys = {"allow.limit": "60 nm", "allow.cost": {"1": 4.0, "1?": 2.0, "dz": 3.0, "2 dz": 1.0}}
    found = allowances(study_with(study, keys), "wfe_rms", 0.05, 60.0, "cost", "aligned", cases=100)
    shares = found.shares / found.shares[1, 1]  # 2 rx
    np.testing.assert_allclose(shares[0, :3], [3.0, 1.0, 3.0], rtol=1e-9)
    np.testing.assert_allclose(shares[1, :3], [4.0, 1.0, 1.0], rtol=1e-9)
    np.testing.assert_allclose(shares[3, 8:11], [1.0, 2.0, 2.0], rtol=1e-9)
    assert found.check.low <= 60.0 <= found.check.high
    shaken = study_with(study, {**keys, "allow.kind": {"dz": "rms", "rx": "rms"}, "allow.cost": {}})
    moving = allowances(shaken, "wfe_rms", 0.05, 60.0, "shares", "aligned", cases=100)
    static = allowances(study, "wfe_rms", 0.05, 60.0, "shares", "aligned", cases=100)
    assert (moving.rms > static.rms).all()  # two instants of a case average
    assert moving.check.low <= 60.0 <= moving.check.high
    bent = study_with(shaken, {"allow.kind": {"figure 4": "rms"}})
    with pytest.raises(UserError, match="figures of segments do not change during a case"):
        allowances(bent, "wfe_rms", 0.05, 60.0, "shares", "aligned", cases=100)
    with pytest.raises(UserError, match="allow belongs to the workflow segment-disturbance"):
        load_study("tmt-exposure", {"allow.limit": "60 nm"})


def test_every_allowance_stands_in_the_file(study, tmp_path):
    found = allowances(study, "wfe_rms_raw", 0.01, 80.0, "shares", "aligned", cases=200)
    file = tmp_path / "a.csv"
    write_allowances(found, file)
    rows = list(csv.DictReader(file.open()))
    assert len(rows) == 4 * 18
    assert rows[0]["axis"] == "dz"
    assert float(rows[0]["rms"]) == found.rms[0, 0]
    assert any("traced in full" in line for line in allow_notes(found, "wfe_rms_raw.p99", 80.0))
    with pytest.raises(UserError, match="cannot be written"):
        write_allowances(found, tmp_path / "no" / "a.csv")


def test_what_does_nothing_is_allowed_anything(study):
    found = allowances(study, "zernike[noll=5]", 0.05, 60.0, "shares", "aligned", cases=100)
    idle = np.isinf(found.rms)  # where sin 2 theta is none
    assert 0 < idle.sum() < idle.size
    assert not found.shares[idle].any()
    np.testing.assert_allclose(found.shares[~idle], found.shares.max(), rtol=1e-9)
    assert any("does nothing to" in line for line in allow_notes(found, "zernike[noll=5].p95", 60.0))


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"limit": 1e-9}, "At rest wfe_rms is"),
        ({"measure": "strehl"}, "'strehl' has no allowances"),
        ({"of": "x"}, "There is no disturbance 'x'"),
        ({"cases": 10}, "take at least 100"),
        ({"cases": 10**12}, "are too many; 1000000 are enough, and all that is possible"),
    ],
)
def test_what_cannot_be_allowed_is_a_sentence(study, keywords, message):
    words = {"measure": "wfe_rms", "probability": 0.05, "limit": 60.0, "of": "aligned", **keywords}
    with pytest.raises(UserError, match=message):
        allowances(study, **words)


def test_other_studies_and_goals_are_refused():
    with pytest.raises(UserError, match="Allowances are of segment-disturbance and system"):
        allowances(load_study("lens-experiment"), "wfe_rms", 0.05, 60.0)
    for limit in ("1e300", "1e-300 nm"):
        with pytest.raises(UserError, match=f"'{limit}' is no positive .* between 1e-100 and 1e.100"):
            goal_of("wfe_rms.p95", limit)
    for words in ("wfe_rms", "wfe_rms.p5", "wfe_rms.p100"):
        with pytest.raises(UserError, match=r"write it as wfe_rms\.p95"):
            goal_of(words, "60 nm")
    assert goal_of("wfe_rms.p99.9", "0.06 um") == ("wfe_rms", pytest.approx(1e-3), pytest.approx(60.0))


def test_the_command_prints_and_writes_allowances(tmp_path, wavequake):
    words = ["tmt-segments", "telescope.name=tmt-18", "optics.rays_per_segment=6", "--of", "alignment"]
    file = tmp_path / "a.csv"
    code, out, _ = wavequake("allow", *words, "--limit", "60 nm", "--cases", 100, "-o", file)
    assert code == 0
    assert "nrad rms" in out
    assert file.exists()
    code, _, err = wavequake("allow", *words, "--limit", "60 nm", "--by", "cost")
    assert code == 2
    assert "By which cost?" in err
    code, _, err = wavequake("allow", *words)
    assert code == 2
    assert "Give a limit" in err
