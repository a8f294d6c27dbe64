"""Control variates against distributions that are known, and against campaigns of many traces."""

import numpy as np
import pytest
from scipy.stats import norm

import wavequake as wq
from wavequake.campaign.statistics.control import sharpened_mean, sharpened_quantile
from wavequake.errors import UserError
from wavequake.report.answers.sharpen import sharpen, sharpen_notes, sharpen_table
from wavequake.workflows.study import load_study, study_with

SEEDS, ENOUGH = 200, 183
MEAN = {"exact": 3.0, "line": 3.16, "noisy": 3.0, "bent": 3.0 + 0.02 * 10.0, "foreign": 0.0}


def drawn(kind, seed, count=50, more=800):
    random = np.random.default_rng(seed)
    x = 3.0 + random.standard_normal(count + more)
    noise = random.standard_normal(count)
    cheap, y = x[:count], x[:count]
    if kind == "line":
        y = 1.02 * cheap + 0.1
    elif kind == "noisy":
        y = cheap + 0.2 * noise
    elif kind == "bent":
        y = cheap + 0.02 * cheap**2
    elif kind == "foreign":
        y = noise
    return y, cheap, x[count:]


def quantile_of(kind, p):
    z = norm.ppf(p)
    return {
        "exact": 3.0 + z,
        "line": 1.02 * (3.0 + z) + 0.1,
        "noisy": 3.0 + z * np.hypot(1.0, 0.2),
        "bent": (3.0 + z) + 0.02 * (3.0 + z) ** 2,  # it rises wherever there are cases
        "foreign": z,
    }[kind]


@pytest.mark.parametrize("kind", MEAN)
def test_intervals_of_means_hold_as_often_as_they_say(kind):
    held, widths = 0, []
    for seed in range(SEEDS):
        found = sharpened_mean(*drawn(kind, seed))
        held += found.value.low <= MEAN[kind] <= found.value.high
        widths.append((found.value.high - found.value.low) / (found.alone.high - found.alone.low))
    assert held >= ENOUGH
    if kind != "foreign":  # as narrow as of 50 + 800 cases, and the noise of 50
        ideal = np.sqrt(50 / 850 + (0.2**2 if kind == "noisy" else 0.0))
        assert np.median(widths) < 1.3 * ideal


@pytest.mark.parametrize("probability", [0.5, 0.95])
@pytest.mark.parametrize("kind", ["line", "noisy", "bent", "foreign"])
def test_intervals_of_quantiles_hold_as_often_as_they_say(kind, probability):
    held, worth = 0, []
    for seed in range(SEEDS):
        found = sharpened_quantile(*drawn(kind, seed), probability, seed)
        held += found.value.low <= quantile_of(kind, probability) <= found.value.high
        worth.append(found.worth)
    assert held >= ENOUGH
    if kind == "foreign":
        assert np.median(worth) == 50.0
    else:
        assert np.median(worth) > 300.0


def test_the_mean_is_that_of_the_regression_in_closed_form():
    y, x, more = drawn("noisy", 1)
    found = sharpened_mean(y, x, more)
    slope = np.cov(x, y)[0, 1] / x.var(ddof=1)
    whole = np.concatenate([x, more]).mean()
    np.testing.assert_allclose(found.value.value, y.mean() + slope * (whole - x.mean()), rtol=1e-12)


STUDY = """
[study]
name = "few"
workflow = "segment-disturbance"
seed = 3
[telescope]
name = "tmt-18"
[optics]
rays_per_segment = 6
[wavefront]
zernike_terms = 10
[imaging]
enabled = false
[campaign]
cases = 100
[[disturbance]]
name = "aligned"
model = "static-random"
piston_nm = 20.0
tip_nrad = 20.0
instants = 2
"""


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    folder = tmp_path_factory.mktemp("control")
    (folder / "few.toml").write_text(STUDY)
    study = load_study(folder / "few.toml")
    wq.run(study, store=folder / "few", on="serial")
    many = wq.run(study_with(study, {"study.seed": 4}), cases=4000, store=folder / "many", on="serial")
    return folder, study, many


def test_a_tenth_of_the_traces_has_the_error_bars_of_all(stores):
    folder, _, many = stores
    rows = {row.measure: row for row in sharpen(folder / "few", 5000)}
    for name in ("wfe_rms_raw", "wfe_rms"):
        values = np.sqrt((many[name] ** 2).mean("time")).to_numpy()
        mean, high = rows[name].found["mean"], rows[name].found["P95"]
        error = 2.0 * values.std() / np.sqrt(len(values))
        assert mean.value.low - error < values.mean() < mean.value.high + error
        assert mean.worth > 1000
        assert high.worth > 1000
        spread = 0.02 * np.quantile(values, 0.95)
        assert high.value.low - spread < np.quantile(values, 0.95) < high.value.high + spread
    assert sharpen_table([*rows.values()]).row_count == 12
    assert any("100 cases are traced, and 4900 more" in line for line in sharpen_notes([*rows.values()]))


def test_what_cannot_be_sharpened_is_a_sentence(stores, tmp_path, wavequake):
    folder, study, _ = stores
    with pytest.raises(UserError, match="has 100 cases; the modal model sharpens them by more"):
        sharpen(folder / "few", 100)
    wq.run(study, cases=8, store=tmp_path / "s", on="serial")
    computed = []
    with pytest.raises(UserError, match=r"'aligned' has 8 traced cases in .*; take at least 20"):
        sharpen(tmp_path / "s", 1000, lambda *done: computed.append(done))
    assert computed == []  # it is said before, not after
    wq.run(study, cases=16, store=tmp_path / "even", on="serial", campaign__sampling="sobol")
    with pytest.raises(UserError, match="are stratified, or share models"):
        sharpen(tmp_path / "even", 1000)
    modal = study_with(study, {"optics.light": "modal"})
    wq.run(modal, cases=30, store=tmp_path / "modal", on="serial")
    code, _, err = wavequake("sharpen", tmp_path / "modal", "--cases", 1000)
    assert code == 2
    assert "is by the modal model already" in err
