"""Rare events of studies against ordinary campaigns of them, and as stores."""

import shutil

import numpy as np
import pytest
from scipy.stats import binom
from small_telescope import TRACED

import wavequake as wq
from wavequake.campaign.rare.certificate import estimated
from wavequake.campaign.rare.splitting import probability
from wavequake.campaign.statistics.tail import fit_tail, rare_value
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.gaussian import NotGaussianError, gaussian_motions
from wavequake.report.answers.accuracy import plan_accuracy
from wavequake.report.answers.errors import store_errors
from wavequake.report.answers.rare import in_unit, rare_answer, rare_notes
from wavequake.report.exports.rerun import rerun_stored
from wavequake.workflows.rare import modal_answer, rare_study
from wavequake.workflows.segments.rare import rare_cases
from wavequake.workflows.study import load_study, study_with

STUDY = (
    TRACED
    + """[[disturbance]]
name = "swing"
model = "common-history"
instants = 4
[[disturbance]]
name = "aligned"
model = "static-random"
piston_nm = 20.0
tip_nrad = 5.0
tilt_nrad = 5.0
figure_nm = { 4 = 5.0 }
instants = 2
[[disturbance]]
name = "noise"
model = "edge-sensor-noise"
instants = 3
share = 0
[[disturbance]]
name = "uniform"
model = "static-random"
piston_nm = 20.0
piston_distribution = "uniform"
share = 0
[[disturbance]]
name = "still"
model = "static-random"
share = 0
[[disturbance]]
name = "gusts"
model = "segment-wind"
share = 0
[[disturbance]]
name = "both"
model = "combine"
of = ["swing", "aligned"]
instants = 4
share = 0
"""
)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "small.toml"
    path.write_text(STUDY)
    return load_study(path)


def share_beyond(study, name, measure, limit, cases, folder):
    """Return how many cases of an ordinary campaign by the modal model exceed a limit."""
    keys = {f"disturbance.{entry.name}.share": int(entry.name == name) for entry in study.disturbance}
    ordinary = study_with(study, {**keys, "optics.light": "modal", "optics.modal_sample": 0.0})
    values = wq.run(ordinary, cases=cases, store=folder)[measure.partition("[")[0]]
    if measure == "zernike[noll=5]":
        values = values.sel(noll=5)
    square = (values**2).sum("axis", skipna=False) if "axis" in values.dims else values**2
    return int((square.mean("time") > limit**2).sum())


@pytest.mark.parametrize(
    ("name", "measure"),
    [
        ("aligned", "wfe_rms"),
        ("aligned", "wfe_rms_raw"),
        ("aligned", "zernike[noll=5]"),
        ("swing", "wfe_rms_raw"),
        ("swing", "los"),
        ("both", "wfe_rms"),
        ("noise", "wfe_rms"),
    ],
)
def test_a_limit_is_exceeded_as_often_as_by_plain_monte_carlo(study, tmp_path, name, measure):
    found = rare_study(study, measure, None, 0.05, name)
    limit = rare_cases(found.identity_text()).limit
    above = share_beyond(study, name, measure, limit, 2000, tmp_path / "s")
    assert binom.ppf(1e-3, 2000, 0.05) <= above <= binom.isf(1e-3, 2000, 0.05)


@pytest.fixture(scope="module")
def proof(study, tmp_path_factory):
    store = tmp_path_factory.mktemp("rare") / "s"
    return rare_answer(study, "wfe_rms", None, 1e-6, of="aligned", traces=400, store=store)


def test_traces_confirm_the_modal_model(proof):
    assert proof.exact == pytest.approx(1e-6, rel=1e-9)
    assert proof.modal.low <= 1e-6 <= proof.modal.high
    assert (proof.modal.high - proof.modal.low) / 2 < 0.1e-6
    assert proof.traced.low <= 1e-6 <= proof.traced.high
    assert proof.difference < 2e-3
    assert proof.correction.more + proof.correction.fewer <= 1
    assert proof.certified.low < 1e-6 < proof.certified.high
    assert any("take --traces" in line for line in rare_notes(proof))
    assert proof.limits.low < proof.limits.value < proof.limits.high


def test_the_store_has_what_undoes_the_draws(proof):
    dataset = wq.open_store(proof.store).load()
    weights = np.exp(dataset.log_weight)
    above = dataset.wfe_rms.mean("time") > proof.limit
    assert 0.3 < float(above.mean()) < 0.7
    assert float((weights * above).mean()) == pytest.approx(proof.traced.value, rel=1e-12)
    np.testing.assert_allclose(dataset.modal_value, dataset.wfe_rms.isel(time=0), atol=2e-3)
    with pytest.raises(UserError, match="drawn near a limit"):
        wq.tail(proof.store, "wfe_rms")
    with pytest.raises(UserError, match="have no errors of their own; take those of wavequake run"):
        store_errors(proof.store)


def test_telemetry_is_not_compared_with_cases_near_a_limit(proof, tmp_path):
    np.savez(
        tmp_path / "a.npz",
        rate_hz=100.0,
        **{"line_of_sight.x_mas": np.random.default_rng(0).normal(size=600)},
    )
    with pytest.raises(UserError, match="drawn near a limit, where all shakes more"):
        wq.agreement(proof.store, tmp_path / "a.npz")


def test_a_plan_measures_cases_that_are_not_near_the_limit(study):
    """Other terms would draw other cases near the limit; those of the study stay what they are."""
    near = rare_study(study, "wfe_rms", None, 1e-3, "aligned")
    assert near.rare is not None
    said = plan_accuracy(near, 0.01, "wfe_rms")
    plain = plan_accuracy(near.model_copy(update={"rare": None}), 0.01, "wfe_rms")
    assert "cases" in plain
    assert "cases" not in said
    assert [said[key] for key in ("rays", "terms")] == [plain[key] for key in ("rays", "terms")]


def test_traces_are_cases_of_a_store_that_goes_on_is_verified_and_computed_again(proof, study, tmp_path):
    store = tmp_path / "s"
    shutil.copytree(proof.store, store)
    assert wq.verify(store).ok
    more = rare_answer(study, "wfe_rms", None, 1e-6, of="aligned", traces=480, store=store)
    assert more.correction.cases == 480
    first = wq.open_store(store).wfe_rms.isel(case=slice(400)).to_numpy()
    np.testing.assert_array_equal(first, wq.open_store(proof.store).wfe_rms.to_numpy())
    assert not rerun_stored(store, 3).differing


def test_where_motions_are_large_the_traces_correct_the_modal_model(study, tmp_path):
    large = study_with(study, {"disturbance.aligned.tip_nrad": 3e6, "disturbance.aligned.tilt_nrad": 3e6})
    found = rare_answer(large, "wfe_rms_raw", None, 1e-4, of="aligned", traces=200, store=tmp_path / "s")
    assert found.correction.more > 0
    assert found.correction.low > 0.0
    assert found.certified.low <= found.traced.high
    assert found.certified.high >= found.traced.low
    assert any(line.startswith("WARNING Full traces do not confirm") for line in rare_notes(found))


def test_the_alignment_of_the_tmt_to_ten_percent_by_two_ways_that_share_no_weights():
    made = rare_study(load_study("tmt-segments"), "wfe_rms", None, 1e-6, "alignment")
    cases, drawn = modal_answer(made)
    form = cases.tilt.form
    assert drawn.high - drawn.low < 0.2 * drawn.value
    hits = [estimated(cases.tilt, cases.limit**2, seed, 10_000) for seed in range(200)]
    assert sum(one.low <= 1e-6 <= one.high for one in hits) >= 183
    split = probability(form.along, len(form.slopes), cases.limit**2)
    assert split.low <= 1e-6 <= split.high
    assert split.high - split.low < 0.2 * split.value


def test_tails_of_normal_cases_sit_low(study):
    """The fitted tail against the exact limit: within its interval, or below it."""
    cases = rare_cases(rare_study(study, "zernike[noll=5]", None, 1e-4, "swing").identity_text())
    form = cases.tilt.form
    below = 0
    for seed in range(10):
        y = np.random.default_rng(seed).standard_normal((2000, len(form.slopes)))
        found = rare_value(fit_tail(np.sqrt(np.maximum(form.along(y), 0.0))), 1e-4)
        below += found.value < cases.limit
        assert found.low < cases.limit * 1.02
    assert below >= 5


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"limit": "1 nm"}, "is exceeded by 100 % of the cases, which is no rare event; half of them"),
        ({"limit": "9 mm"}, "is exceeded by less than 1e-280 of the cases"),
        ({"limit": "1 mas"}, "has the unit 'mas'; use one of pm, nm"),
        ({"limit": "much"}, "is no positive number with a unit, as '120 nm'"),
        ({"limit": "-3 nm"}, "is no positive number"),
        ({}, "What is rare"),
        ({"limit": "60 nm", "probability": 1e-6}, "not both"),
        ({"limit": "1e99 nm"}, "is exceeded by less than 1e-280 of the cases"),
        ({"limit": "1e300 nm"}, "between 1e-100 and 1e.100"),
        ({"probability": 0.9}, "0.9 must be between 1e-200 and 0.5"),
        ({"probability": 1e-300}, "1e-300 must be between 1e-200 and 0.5"),
        ({"probability": 1e-6, "measure": "strehl"}, "'strehl' is not among what is known of rare cases"),
        ({"probability": 1e-6, "measure": "wfe"}, "There is no 'wfe' to judge"),
        ({"probability": 1e-6, "measure": "zernike"}, "has a number for each noll"),
        ({"probability": 1e-6, "of": None}, "choose one with --of: swing, aligned"),
        ({"probability": 1e-6, "of": "x"}, "There is no disturbance 'x'"),
        ({"probability": 1e-6, "of": "uniform"}, "are no sums of Gaussian numbers"),
        ({"probability": 1e-6, "of": "gusts"}, "are no sums of Gaussian numbers"),
        ({"probability": 1e-6, "of": "still"}, "moves nothing"),
        ({"probability": 1e-6, "traces": 3}, "take at least 50"),
    ],
)
def test_what_cannot_be_judged_is_a_sentence(study, tmp_path, keywords, message):
    with pytest.raises(UserError, match=message):
        rare_answer(study, **{"of": "aligned", "traces": 50, "store": tmp_path / "s", **keywords})
    assert not (tmp_path / "s").exists()


def test_what_is_no_sum_is_refused_before_it_is_drawn_with_each_of_its_numbers():
    calls = []

    def rows(streams, time):
        calls.append(1)
        return np.sin(streams("x").standard_normal(500).sum() + time)[:, None]

    with pytest.raises(UserError, match="no sums of Gaussian numbers"):
        gaussian_motions("phases", rows, np.linspace(0.0, 1.0, 5))
    assert len(calls) < 10


@pytest.mark.parametrize(
    ("bent", "said"),
    [(np.abs, "tail` takes any disturbance"), (np.positive, "draws 131072 numbers for 5 instants, too many")],
)
def test_of_very_many_numbers_it_is_said_first_whether_they_are_sums(bent, said):
    """Fewer instants would not help gusts, whose frequencies are random."""

    def rows(streams, time):
        drawn = streams("x").standard_normal(2**17)[: len(time) * 600]
        return bent(drawn).reshape(len(time), 600)

    with pytest.raises(NotGaussianError, match=said):
        gaussian_motions("many", rows, np.linspace(0.0, 1.0, 5))


def test_other_studies_are_refused():
    with pytest.raises(UserError, match="Rare events are of segment-disturbance studies, not of lens-exp"):
        rare_study(load_study("lens-experiment"), limit=1.0)


def test_a_study_that_names_its_limit_has_one_store_for_run_and_rare():
    own = load_study("tmt-rare")
    made = rare_study(own)
    assert made.identity() == own.identity()
    assert made.cases == own.cases
    assert rare_study(own, traces=60).cases == 60
    assert rare_study(own, limit=21.0).identity() != own.identity()


def test_limits_have_units():
    assert in_unit("0.12 um", "nm") == pytest.approx(120.0)
    assert in_unit(5, "mas") == 5.0
    assert in_unit("1urad", "mas") == pytest.approx(206.264806)


def test_the_command_prints_the_answer_and_where_the_traces_are(tmp_path, wavequake):
    words = ["tmt-segments", "telescope.name=tmt-18", "optics.rays_per_segment=6", "--of", "alignment"]
    store = tmp_path / "s"
    code, out, _ = wavequake("rare", *words, "--limit", "104 nm", "--traces", 60, "--store", store)
    assert code == 0
    assert "certified" in out
    assert "correction by full traces" in out
    assert str(store) in out.replace("\n", "")
    code, _, err = wavequake("rare", *words, "--limit", "0.1 nm")
    assert code == 2
    assert "no rare event" in err
