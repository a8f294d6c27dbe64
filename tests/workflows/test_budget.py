"""Budgets of disturbances against closed forms and direct computation on the mirror of 18 segments."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.motion import scaled, still
from wavequake.mechanics.disturbances.registry import draw_case
from wavequake.workflows.budgets.budget import budget, open_budget, stored_budget, summed
from wavequake.workflows.budgets.elements import Factors, variants, with_element
from wavequake.workflows.budgets.segments import rings_of
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.study import load_study

STUDY = """
[study]
name = "two"
workflow = "segment-disturbance"
seed = 11
[telescope]
name = "tmt-18"
[optics]
rays_per_segment = 6
[[disturbance]]
name = "coarse"
model = "static-random"
instants = 1
piston_nm = 40.0
[[disturbance]]
name = "fine"
model = "static-random"
instants = 1
piston_nm = 20.0
"""
SHAKE = """
[[disturbance]]
name = "shake"
model = "line-of-sight"
spectrum = "tmt-vibration"
instants = 1
"""


def loaded(tmp_path, text, **keys):
    path = tmp_path / "study.toml"
    path.write_text(text)
    return load_study(path, keys)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return loaded(tmp_path_factory.mktemp("budget"), STUDY)


@pytest.fixture(scope="module")
def found(study):
    return budget(study, 300)


def within(found, name, factor, exact, quantity="wfe_rms_raw"):
    at = {"factor": factor, "quantity": quantity}
    # The rest is what the telescope has without any disturbance.
    exact *= 1 - float(found["rms_rest"].sel(quantity=quantity) / found["rms"].sel(quantity=quantity)) ** 2
    low, high = (float(found[f"{name}{end}"].sel(at)) for end in ("_low", "_high"))
    assert high - low < 0.1
    return low <= exact <= high


def test_independent_pistons_share_the_mean_square_as_their_variances(found):
    # The rms over the glass is that of the pistons about their mean: E[Y^2] is proportional to the sum of
    # the variances of the sources.
    assert within(found, "share", "coarse", 0.8)
    assert within(found, "share", "fine", 0.2)


def test_rings_share_the_mean_square_as_their_glass(study, found):
    # For equal segments E[sum w p^2 - (sum w p)^2] is proportional to the sum of cos^2(incidence).
    bench = bench_of(study.identity_text())
    glass = np.bincount(rings_of(bench.layout), bench.layout.axes[:, 2, 2] ** 2)[1:]
    inner, outer = glass / glass.sum()
    assert found["segments"].sel(factor=["ring 1", "ring 2"]).to_numpy().tolist() == [6, 12]
    assert within(found, "share", "ring 1", inner)
    assert within(found, "share", "ring 2", outer)


def test_every_value_is_that_of_a_direct_computation(study, found):
    bench = bench_of(study.identity_text())
    layout, rings = bench.layout, rings_of(bench.layout)
    pairs, rest = [], float(found["rms_rest"].sel(quantity="wfe_rms_raw"))
    for case in range(20):
        pistons = [
            draw_case(study.disturbance, entry, layout, study.study.seed, case).segment_motion[0, :, 2]
            for entry in study.disturbance
        ]
        both = pistons[0] + pistons[1]
        direct = {
            "all": both,
            "without coarse": pistons[1],
            "without fine": pistons[0],
            "without ring 1": np.where(rings == 1, 0.0, both),
            "without ring 2": np.where(rings == 2, 0.0, both),
        }
        for variant, values in direct.items():
            value = float(found["value"].sel(case=case, variant=variant, quantity="wfe_rms_raw"))
            # A shift d along the normal changes the path by 2 d cos(incidence), added to that at rest.
            path = 2e9 * values * layout.axes[:, 2, 2]
            assert abs(value - path.std()) < rest
            pairs.append((value**2 - rest**2, path.var()))
    traced, direct = np.array(pairs).T
    np.testing.assert_allclose(traced.sum(), direct.sum(), rtol=0.03)


def test_drawing_one_source_again_leaves_the_others_as_they_are(study):
    bench = bench_of(study.identity_text())
    factors = Factors(study.disturbance, rings_of(bench.layout))
    motions = variants(summed(study, None), factors, bench.layout, 11, 3)
    one, other, only_fine, only_coarse = (m.segment_motion[0, :, 2] for m in motions[:4])
    coarse_again, fine_again = (m.segment_motion[0, :, 2] for m in motions[6:8])
    np.testing.assert_allclose(coarse_again - only_fine + fine_again - only_coarse, other, rtol=0, atol=1e-20)
    ring_1_again = motions[8].segment_motion[0, :, 2]
    np.testing.assert_array_equal(ring_1_again, np.where(factors.rings == 1, other, one))
    assert abs(np.corrcoef(one, other)[0, 1]) < 0.6


def test_an_element_that_is_held_neither_moves_nor_deforms_and_the_others_stay():
    shapes = {"rigid": (2, 6), "figure": (2, 11), "grid": (2, 4, 4)}
    shaken = still(
        2, 3, **{key: {name: np.ones(shape) for name in ("M2", "M3")} for key, shape in shapes.items()}
    )
    held = with_element(shaken, scaled(shaken, 0.0), "M2")
    for key in shapes:
        found = getattr(held, key)
        assert (found["M2"].any(), found["M3"].all()) == (False, True), key


def test_variance_of_a_sum_of_pistons_is_mostly_that_of_the_coarse_ones(found):
    assert float(found["first"].sel(factor="coarse", quantity="wfe_rms_raw")) > 0.5
    first, total = (found[name].sel(quantity="wfe_rms_raw").to_numpy() for name in ("first", "total"))
    assert (total + 0.1 > first).all()


def test_rings_that_wind_moves_together_have_no_variance_of_their_own():
    study = load_study("tmt-segments", {"telescope.name": "tmt-18"})
    found = budget(study, 16)
    assert np.isnan(found["first"].sel(factor="ring 1")).all()
    assert np.isfinite(found["share"].sel(factor="ring 1")).all()
    assert found["factor"].to_numpy()[:4].tolist() == ["alignment", "edge-sensors", "wind", "wind-shake"]


def test_rings_are_counted_from_the_axis():
    for name, sizes in (("tmt-18", [6, 12]), ("jwst", [6, 12])):
        text = load_study("tmt-segments", {"telescope.name": name}).identity_text()
        rings = rings_of(bench_of(text).layout)
        assert np.bincount(rings)[1:].tolist() == sizes


def test_pointing_is_no_matter_of_rings(tmp_path):
    found = budget(loaded(tmp_path, STUDY + SHAKE), 16)
    of_los = found["share"].sel(quantity="los")
    assert float(of_los.sel(factor="shake")) > 0.5
    assert float(found["share"].sel(quantity="wfe_rms_raw", factor="shake")) == pytest.approx(0.0, abs=1e-3)


def test_a_budget_is_kept_and_found_again(study, tmp_path):
    made, there = stored_budget(study, tmp_path / "s", 16)
    again, found_again = stored_budget(study, tmp_path / "s", 16)
    assert (there, found_again) == (False, True)
    np.testing.assert_array_equal(made["value"], again["value"])
    np.testing.assert_array_equal(open_budget(tmp_path / "s")["share_low"], made["share_low"])
    assert stored_budget(study, tmp_path / "s", 17)[1] is False


def test_a_budget_that_was_interrupted_goes_on(study, tmp_path):
    def stop(done, total, failed):
        if done >= 10:
            raise KeyboardInterrupt

    whole = budget(study, 40)
    with pytest.raises(KeyboardInterrupt):
        stored_budget(study, tmp_path / "s", 40, progress=stop)
    (kept,) = (tmp_path / "s").glob("budget*")
    kept.write_text(kept.read_text()[:-7])  # the last line is torn
    seen = []
    made, _ = stored_budget(study, tmp_path / "s", 40, progress=lambda done, total, failed: seen.append(done))
    assert 0 < seen[0] < 20
    assert made.drop_attrs().identical(whole.drop_attrs())
    assert [file.name for file in (tmp_path / "s").iterdir()] == ["budget.zarr"]


@pytest.mark.parametrize(
    ("keys", "arguments", "words"),
    [
        ({}, (3,), "A budget of 3 cases says nothing; take at least 16"),
        ({}, (16, "wind"), "There is no combination 'wind' in this study; there is none"),
        ({"disturbance.coarse.tip_nrad": 1e9}, (16,), "16 of 16 cases cannot be traced"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, keys, arguments, words):
    with pytest.raises(UserError, match=words):
        budget(loaded(tmp_path, STUDY, **keys), *arguments)


def test_other_studies_have_no_budget(tmp_path):
    with pytest.raises(
        UserError, match="A budget is of segment-disturbance and system-disturbance studies, not of lens"
    ):
        budget(load_study("lens-experiment"), 16)
    with pytest.raises(UserError, match=r"There is no budget at .*; wavequake budget STUDY computes it"):
        open_budget(tmp_path)


SHAKEN = """
[study]
name = "shaken"
workflow = "segment-disturbance"
seed = 11
[telescope]
name = "tmt-18"
[optics]
rays_per_segment = 6
wavelength_nm = 1000.0
[imaging]
pixels = 48
[[disturbance]]
name = "pistons"
model = "static-random"
instants = 1
piston_nm = 15.0
[[disturbance]]
name = "shake"
model = "vibration-lines"
lines = [{ frequency_hz = 20.0, fwhm_hz = 1.0, rms_mas = 5.0 }]
duration_s = 1.0
instants = 4
"""


def test_the_peak_of_the_exposure_ranks_what_no_strehl_ratio_sees(tmp_path):
    """A shaken line of sight costs the peak, of which a campaign of the combination knows the same."""
    both = '[[disturbance]]\nname = "both"\nmodel = "combine"\nof = ["pistons", "shake"]\n'
    both += "duration_s = 1.0\ninstants = 4\n"
    study = loaded(tmp_path, SHAKEN + both)
    found = budget(study, 16, measure="peak")
    assert found["quantity"].values[0] == "peak"
    assert float(found["share"].sel(quantity="peak", factor="shake")) > 0.7
    assert float(found["share"].sel(quantity="wfe_rms", factor="shake")) < 0.01
    kind = find_kind("segment-disturbance")
    cases = np.arange(3) * 3 + 2  # of the combination
    exposed = kind.compute(study.identity_text(), cases, "auto").arrays["peak"]
    kept = found["value"].sel(quantity="peak", variant="all").values[:3]
    np.testing.assert_allclose(kept, 1.0 - exposed, atol=1e-9)
    still = found["value"].sel(quantity="peak", variant="without shake").values
    assert (still < found["value"].sel(quantity="peak", variant="all").values).all()


def test_a_measure_that_there_is_not_is_refused(study):
    with pytest.raises(UserError, match="A budget has no measure 'peek'; did you mean 'peak'"):
        budget(study, 16, measure="peek")
