"""Allowances of lenses and mirrors against closed forms, differences of full traces and plain campaigns."""

import csv

import numpy as np
import pytest
from scipy.stats import binom, chi2, norm

import wavequake as wq
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.mechanics.disturbances.motion import still
from wavequake.optics.derivatives.central import DOFS
from wavequake.report.answers.allow import allow_figure, allow_notes, asked_of
from wavequake.workflows.allow import allowances
from wavequake.workflows.study import load_study, study_with
from wavequake.workflows.systems.allow import system_movable
from wavequake.workflows.systems.bench import system_bench
from wavequake.workflows.systems.measure import measured

SMALL = {"optics.rays": 60, "wavefront.zernike_terms": 15}
DETECTOR = """
[study]
name = "detector"
workflow = "system-disturbance"
[system]
name = "double-gauss"
f_number = 8.0
[optics]
rays = 60
[wavefront]
zernike_terms = 15
[[disturbance]]
name = "detector"
model = "surface-random"
of = ["image"]
rms = {SIZES}
[[disturbance]]
name = "star"
model = "line-of-sight"
share = 0
"""


@pytest.fixture(scope="module")
def euv():
    return load_study("euv-allowances", SMALL)


@pytest.fixture(scope="module")
def lens():
    return load_study("double-gauss", SMALL)


def detector(folder, sizes):
    file = folder / "detector.toml"
    file.write_text(DETECTOR.replace("SIZES", f" {sizes} "))
    return load_study(file)


def test_a_detector_that_shifts_has_the_allowance_of_the_normal_distribution(tmp_path):
    study = detector(tmp_path, "dx_um = 1.0")
    found = allowances(study, "los_mm", 0.05, 0.01, of="detector", cases=100)
    np.testing.assert_allclose(found.rms, [[1e-5 / norm.isf(0.025)]], rtol=1e-6)
    assert found.elements == ("image",)


def test_one_that_shifts_along_two_axes_has_that_of_chi_squared(tmp_path):
    study = detector(tmp_path, "dx_um = 1.0, dy_um = 1.0")
    found = allowances(study, "los_mm", 0.01, 0.01, of="detector", cases=100)
    np.testing.assert_allclose(found.rms, 1e-5 / np.sqrt(chi2.isf(0.01, 2)), rtol=1e-6)
    alone = allowances(study, "los_mm[axis=y]", 0.01, 0.01, of="detector", cases=100)
    np.testing.assert_allclose(alone.rms, [[np.inf], [1e-5 / norm.isf(0.005)]], rtol=1e-6)


def test_shares_cost_alike_by_differences_of_full_traces(euv):
    found = allowances(euv, "wfe_change", 0.05, 0.3, "shares", cases=100)
    bench = system_bench(euv.identity_text())
    for element, axis in ((0, "dx"), (2, "rx"), (5, "dz"), (1, "figure 7")):
        row, name = found.axes.index(axis), found.elements[element]
        sign, size = np.array([1.0, -1.0]), found.rms[row, element]
        motion = still(2)
        if axis in DOFS:
            motion.rigid[name] = np.outer(sign, size * np.eye(6)[DOFS.index(axis)])
        else:
            motion.figure[name] = np.outer(sign, size * np.eye(7)[6])
        numbers, _ = measured(bench, np.zeros(2), motion, NUMPY)
        change = 0.5 * (numbers["zernike"][0] - numbers["zernike"][1])[:, 0, 3:]
        cost = np.mean(np.sum(change**2, axis=1))
        if element == 0:
            first = cost
        np.testing.assert_allclose(cost, first, rtol=1e-4)


def test_costs_share_out_and_rz_does_nothing(euv):
    found = allowances(euv, "wfe_change", 0.05, 0.3, "cost", cases=200)
    assert found.check.low <= 0.3 <= found.check.high
    np.testing.assert_allclose(found.shares.sum(), 1.0, rtol=1e-9)
    limited = [row for row, axis in enumerate(found.axes) if axis != "rz"]
    shares = found.shares[limited] / found.shares[0, 0]
    np.testing.assert_allclose(shares, np.tile([1, 1, 1, 1, 2, 3], (len(limited), 1)), rtol=1e-9)
    assert np.isinf(found.rms[found.axes.index("rz")]).all()
    assert any(
        "Any rz is allowed" in line and "all elements" in line for line in allow_notes(found, "x", 0.3)
    )
    words = [text.get_text() for axes in allow_figure(found, "x").axes for text in axes.get_legend().texts]
    assert "dz" in words
    assert "rz" not in words


def test_what_a_study_has_grown_by_the_factor_exceeds_the_limit_as_often(euv, tmp_path):
    found = allowances(euv, "wfe_change", 0.1, 0.3, "factor", "mirrors", cases=100)
    assert found.exact
    sizes = {key: getattr(euv.disturbance[0].rms, key) for key in ("dx_um", "dy_um", "dz_um", "rx_urad")}
    sizes["ry_urad"] = sizes["rx_urad"]
    grown = {
        "disturbance.mirrors.rms": {key: found.factor * value for key, value in sizes.items()},
        "disturbance.mirrors.share": 1,
        "disturbance.all.share": 0,
    }
    dataset = wq.run(study_with(euv, grown), cases=800, store=tmp_path / "s")
    values = np.sqrt((dataset.wfe_change**2).mean(["time", "field", "wavelength"]))
    above = int((values > 0.3).sum())
    assert binom.ppf(1e-3, 800, 0.1) <= above <= binom.isf(1e-3, 800, 0.1)


def test_a_vibration_grows_until_its_own_draws_exceed_the_limit(lens, tmp_path):
    plain = lens.model_copy(update={"imaging": None})
    fewer = {"system.fields_deg": [[0.0, 0.0], [0.0, 5.0]], "system.wavelengths_nm": [587.6]}
    study = study_with(plain, {"disturbance.vibration.instants": 6, **fewer})
    found = allowances(study, "wfe_change[field=(0, 0) deg]", 0.1, 30.0, "factor", "vibration", cases=100)
    assert not found.exact
    assert any("in 4000 draws" in line for line in allow_notes(found, "x", 30.0))
    lines = [
        {
            "frequency_hz": line.frequency_hz,
            "amplitude": {
                key: found.factor * value for key, value in line.amplitude.model_dump().items() if value
            },
        }
        for line in study.disturbance[1].lines
    ]
    keys = {"disturbance.vibration.lines": lines, "study.seed": 5}  # other draws
    keys |= {f"disturbance.{name}.share": 0 for name in ("assembly", "polishing", "all")}
    dataset = wq.run(study_with(study, keys), cases=300, store=tmp_path / "s")
    light = system_bench(study.identity_text()).system.primary_wavelength
    values = dataset.wfe_change.isel(field=0, wavelength=light)
    above = int((np.sqrt((values**2).mean("time")) > 30.0).sum())
    assert binom.ppf(1e-3, 300, 0.1) <= above <= binom.isf(1e-3, 300, 0.1)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"measure": "wfe_rms", "limit": 0.01}, "At rest wfe_rms is"),
        ({"measure": "strehl"}, "'strehl' has no allowances; use one of wfe_change"),
        ({"of": "x"}, "There is no disturbance 'x'"),
        ({"by": "luck"}, "use shares, cost or factor"),
        ({"cost": {"M7": 2.0}}, r"allow.cost: the disturbance 'all' does not move 'M7'; it moves M1, M2"),
        ({"cost": {}}, "By which cost"),
    ],
)
def test_what_cannot_be_allowed_is_a_sentence(euv, keywords, message):
    words = {"measure": "wfe_change", "probability": 0.05, "limit": 0.3, "by": "cost", **keywords}
    study = study_with(euv, {"allow.cost": words.pop("cost")}) if "cost" in keywords else euv
    with pytest.raises(UserError, match=message):
        allowances(study, **words)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"cost": {"M5": 1e308}}, "cost.M5: input should be less than or equal to 1e"),
        ({"cost": {"M5": 1e-320}}, "cost.M5: input should be greater than or equal to 1e-12"),
        (
            {"spectrum": {"a": {"frequency_hz": [1.0, 5.0], "psd": [1e308, 1e308]}}},
            "psd.0: input should be less",
        ),
        ({"spectrum": {"a": {"frequency_hz": [1.0, 5.0], "psd": [1e-320, 0.0]}}}, "psd is zero everywhere"),
        (
            {"spectrum": {"a": {"frequency_hz": [1e-300, 5.0], "psd": [1.0, 1.0]}}},
            "frequency_hz.0: input should",
        ),
    ],
)
def test_sizes_that_would_overflow_are_refused(euv, asked, message):
    """As "anything is allowed", or levels without end, would be said of them."""
    with pytest.raises(UserError, match=message):
        study_with(euv, {f"allow.{key}": value for key, value in asked.items()})


def test_motions_that_do_nothing_or_belong_to_no_element_are_sentences(euv, tmp_path):
    turning = study_with(euv, {"disturbance.mirrors.rms": {"rz_urad": 1.0}})
    with pytest.raises(UserError, match="does nothing to wfe_change: anything is allowed"):
        allowances(turning, "wfe_change", 0.05, 0.3, of="mirrors")
    study = detector(tmp_path, "dx_um = 1.0")
    with pytest.raises(UserError, match="turns the incoming light"):
        allowances(study, "los_mm", 0.05, 0.01, of="star")


def test_a_study_names_what_is_asked_and_the_command_writes_it(euv, tmp_path, wavequake):
    asked = asked_of(euv, None, None, None)
    assert (asked.name, asked.limit, asked.by) == ("wfe_change", pytest.approx(0.3), "cost")
    assert asked_of(euv, "los_mm.p99", "20 nm", "shares").limit == pytest.approx(2e-5)
    words = [f"{key}={value}" for key, value in SMALL.items()]
    table, figure = tmp_path / "a.csv", tmp_path / "a.svg"
    code, out, _ = wavequake("allow", "euv-allowances", *words, "--cases", 100, "-o", table, "-o", figure)
    assert code == 0
    assert "pm rms" in out
    assert "any" in out
    assert "<svg" in figure.read_text()
    rows = list(csv.DictReader(table.open()))
    assert len(rows) == 6 * 11
    assert {row["rms"] for row in rows if row["axis"] == "rz"} == {"inf"}
    code, _, err = wavequake("allow", "euv-allowances", "-o", tmp_path / "a.txt")
    assert code == 2
    assert "must end in .csv" in err


def test_a_detector_has_no_part_in_allowances(tmp_path):
    text = DETECTOR.replace("{SIZES}", "{ dx_um = 1.0 }").replace('["image"]', '["surface 3"]')
    camera = "[imaging]\npixels = 16\n[detector]\npixel_um = 5.0\nphotons = 1e4\n"
    found = []
    for name, more in (("plain", ""), ("camera", camera)):
        (tmp_path / f"{name}.toml").write_text(text + more)
        study = load_study(tmp_path / f"{name}.toml")
        found.append(system_movable(study, "los_mm", "detector"))
    np.testing.assert_array_equal(found[0].form.square, found[1].form.square)
