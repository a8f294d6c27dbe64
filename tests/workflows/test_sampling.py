"""Latin hypercubes and Sobol points: how even they are, and that only study and case decide."""

import numpy as np
import pytest
from scipy.stats import norm

from wavequake.campaign.statistics.quantiles import quantile
from wavequake.campaign.store.store import open_store
from wavequake.chain.sampling import Plan
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.streams import Coordinates
from wavequake.workflows.run import run_study
from wavequake.workflows.segments.disturbance import KIND
from wavequake.workflows.segments.draws import sampling_plan
from wavequake.workflows.study import load_study

SMALL = {"telescope.name": "tmt-18", "imaging.enabled": False, "optics.rays_per_segment": 6}


def plan(method, dimensions, points=0, replicates=1, seed=5):
    points = points if method == "latin-hypercube" else 0
    return Plan(method, seed, replicates, points, (("x", dimensions),))


def drawn(one, count, order=None):
    order = range(count) if order is None else order
    points = np.empty((count, one.dimensions))
    for realization in order:
        points[realization] = one.point(int(realization))
    return points


def test_every_stratum_of_a_latin_hypercube_is_hit_once_in_any_order():
    one = plan("latin-hypercube", 7, points=12, replicates=3)
    points = drawn(one, 36, order=np.random.default_rng(1).permutation(36))
    for replicate in range(3):
        strata = np.floor(points[replicate::3] * 12).astype(int)
        np.testing.assert_array_equal(np.sort(strata, axis=0), np.arange(12)[:, None] + np.zeros((1, 7)))
    assert not np.array_equal(points[0::3], points[1::3])
    np.testing.assert_array_equal(points, drawn(one, 36))


def test_sobol_points_are_balanced_in_every_elementary_interval():
    # Sobol's first two dimensions are a (0, m, 2)-net in base 2 (Sobol 1967), and scrambling keeps that:
    # every box of 2^-a times 2^-(m - a) holds exactly one of 2^m points, in each set of its own.
    one = plan("sobol", 2, replicates=2)
    points = drawn(one, 128, order=np.random.default_rng(2).permutation(128))
    for replicate in range(2):
        mine = points[replicate::2]
        for a in range(7):
            boxes = np.floor(mine * [2**a, 2 ** (6 - a)]).astype(int)
            assert len(np.unique(boxes, axis=0)) == 64
    high = plan("sobol", 40)
    strata = np.floor(drawn(high, 64) * 64).astype(int)
    assert all(len(np.unique(column)) == 64 for column in strata.T)


def test_points_are_never_on_the_faces_of_the_cube():
    for method in ("sobol", "latin-hypercube"):
        points = drawn(plan(method, 50, points=256), 256)
        assert points.min() > 0.0
        assert points.max() < 1.0


@pytest.mark.parametrize("method", ["latin-hypercube", "sobol"])
def test_the_mean_of_a_smooth_function_has_far_less_scatter_than_with_random_points(method):
    # f is nearly additive, with mean 4 (e - 1) + 1/16: the variance of random means is var(f) / n.
    def f(x):
        return np.exp(x).sum(axis=1) + x.prod(axis=1)

    means = [f(drawn(plan(method, 4, points=64, seed=seed), 64)).mean() for seed in range(40)]
    exact = 4 * (np.e - 1) + 1 / 16
    random = 4 * ((np.e**2 - 1) / 2 - (np.e - 1) ** 2) / 64  # without the small product
    assert abs(np.mean(means) - exact) < 4 * np.sqrt(random / 40)
    # Stratified in 64 strata, the additive part has a variance smaller by about 64^2; the product's rest is
    # that of plain sampling: below 4 / 3^4 / 2^4 / 64 (Stein 1987).
    assert np.var(means) < random / 30


def test_the_interval_from_replicates_covers_as_promised_and_is_narrower_than_that_of_random_draws():
    # 400 campaigns of 8 Latin hypercubes of 25 points; the sum of 3 normals has its 0.9 quantile at 2.22.
    truth, covered, widths = norm.ppf(0.9) * np.sqrt(3.0), 0, []
    for seed in range(400):
        points = drawn(plan("latin-hypercube", 3, points=25, replicates=8, seed=seed), 200)
        values = norm.ppf(points).sum(axis=1)
        found = quantile(values, 0.9, sets=np.arange(200) % 8)
        covered += found.low <= truth <= found.high
        widths.append(found.high - found.low)
    assert 0.92 <= covered / 400 <= 0.985
    plain = quantile(np.random.default_rng(3).standard_normal(200) * np.sqrt(3.0), 0.9)
    assert np.median(widths) < 0.8 * (plain.high - plain.low)


def test_one_set_has_no_interval():
    found = quantile(np.arange(100.0), 0.5, sets=np.zeros(100, dtype=np.int64))
    assert (found.value, found.low, found.high) == (49.5, -np.inf, np.inf)


def test_coordinates_become_the_numbers_that_generators_give():
    point = np.array([0.25, 0.5, 0.975, 0.1, 0.9, 0.3])
    taken = Coordinates(point)
    assert taken.random(1) == 0.25
    np.testing.assert_allclose(taken.standard_normal((1, 2)), [[0.0, 1.959963984540054]], rtol=0, atol=1e-15)
    np.testing.assert_allclose(taken.uniform(-1.0, 1.0, 1), [-0.8])
    np.testing.assert_allclose(taken.uniform(np.array([0.0, 2.0]), np.array([1.0, 4.0])), [0.9, 2.6])
    assert taken.taken == 6


@pytest.mark.parametrize("method", ["latin-hypercube", "sobol"])
@pytest.mark.parametrize("optics", ["traced", "modal"])
def test_a_case_depends_on_study_and_id_alone(tmp_path, method, optics):
    keys = {**SMALL, "campaign.sampling": method, "campaign.cases": 40, "campaign.replicates": 2}
    keys |= {"optics.light": optics, "store.chunk_cases": 7}
    study = load_study("tmt-segments", keys)
    store = tmp_path / "shards"
    for shard in ("1/2", "0/2"):
        from wavequake.campaign.engine.driver_lock import shard_of

        run_study(study, store, on="serial", shard=shard_of(shard))
    whole = open_store(store)
    assert whole["replicate"].to_numpy().tolist() == [r // 4 % 2 for r in range(40)]
    text = study.identity_text()
    for case in (39, 0, 17, 18):
        alone = KIND.compute(text, np.array([case]), "auto")
        np.testing.assert_array_equal(alone.arrays["wfe_rms_raw"][0], whole["wfe_rms_raw"][case].to_numpy())


def test_pistons_of_a_study_are_stratified_and_wind_is_as_random_as_before():
    keys = {**SMALL, "campaign.sampling": "latin-hypercube", "campaign.cases": 64, "campaign.replicates": 1}
    from wavequake.mechanics.disturbances.registry import draw_case
    from wavequake.workflows.segments.bench import bench_of
    from wavequake.workflows.segments.draws import draw_realization

    study = load_study("tmt-segments", keys)
    bench = bench_of(study.identity_text())
    alignment, _, wind, _ = study.disturbance
    pistons = [draw_realization(bench, alignment, i).segment_motion[0, :, 2] for i in range(16)]
    strata = np.floor(norm.cdf(np.array(pistons) / 20e-9) * 16).astype(int)
    assert all(len(np.unique(column)) == 16 for column in strata.T)
    gusts = draw_realization(bench, wind, 3).segment_motion
    plain = draw_case(study.disturbance, wind, bench.layout, study.study.seed, 3).segment_motion
    np.testing.assert_array_equal(gusts, plain)
    assert dict(sampling_plan(study.identity_text()).streams) == {"alignment": 126, "wind-shake": 381}


def test_surfaces_of_any_system_are_stratified_too(tmp_path):
    keys = {"campaign.sampling": "sobol", "campaign.cases": 16, "optics.rays": 60, "campaign.replicates": 2}
    keys |= {"imaging.pixels": 8, "system.fields_deg": [[0.0, 5.0]], "disturbance.vibration.instants": 4}
    keys |= {"disturbance.all.instants": 4}
    study = load_study("double-gauss", keys)
    run_study(study, tmp_path / "s", on="serial")
    assert set(open_store(tmp_path / "s")["replicate"].to_numpy()) == {0, 1}


def test_sampling_is_part_of_the_identity_but_random_sampling_changes_none():
    plain = load_study("tmt-segments")
    assert "campaign" not in plain.identity_text()
    sobol = load_study("tmt-segments", {"campaign.sampling": "sobol"})
    more = load_study("tmt-segments", {"campaign.sampling": "sobol", "campaign.cases": 3000})
    assert sobol.identity() == more.identity() != plain.identity()
    cubes = [
        load_study("tmt-segments", {"campaign.sampling": "latin-hypercube", "campaign.cases": cases})
        for cases in (320, 640)
    ]
    assert cubes[0].identity() != cubes[1].identity()


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        (
            {"campaign.cases": 1000},
            "campaign.cases = 1000 does not fill 8 latin hypercubes; take a",
        ),
        (
            {"campaign.cases": 64, "campaign.until": "strehl.p50 ci<=2%"},
            "until cannot stop a latin",
        ),
        ({"campaign.cases": 64, "disturbance.wind.share": 2}, "needs the same share for all disturbances"),
    ],
)
def test_an_incomplete_latin_hypercube_is_refused(keys, words):
    with pytest.raises(UserError, match=words):
        load_study("tmt-segments", {"campaign.sampling": "latin-hypercube", **keys})


def test_too_many_numbers_are_refused():
    keys = {"campaign.sampling": "sobol", "disturbance.alignment.figure_nm": {66: 1.0}}
    with pytest.raises(UserError, match="and Sobol's sequence has 21201 dimensions; take"):
        sampling_plan(load_study("tmt-segments", keys).identity_text())
    keys = {"campaign.sampling": "latin-hypercube", "campaign.cases": 3_200_000, **SMALL}
    with pytest.raises(UserError, match="do not fit into memory"):
        sampling_plan(load_study("tmt-segments", keys).identity_text())


def test_other_workflows_have_no_sampling():
    with pytest.raises(UserError, match="belongs to the workflows segment-disturbance and system-disturb"):
        load_study("tmt-exposure", {"campaign.sampling": "sobol"})


def test_a_campaign_of_sobol_points_stops_by_the_scatter_between_its_sets(tmp_path):
    keys = {**SMALL, "campaign.sampling": "sobol", "campaign.cases": 2000, "disturbance.wind.share": 0}
    keys |= {"disturbance.edge-sensors.share": 0, "disturbance.wind-shake.share": 0}
    keys |= {"campaign.until": "segment_piston_rms.p50 ci<=5%", "disturbance.alignment.instants": 1}
    found = run_study(load_study("tmt-segments", keys), tmp_path / "s", on="serial")
    assert "is met after" in found.goal[0]
    assert open_store(tmp_path / "s").sizes["case"] < 1000


@pytest.mark.parametrize("cases", [1, 4])
def test_few_cases_are_no_trouble(tmp_path, cases):
    keys = {**SMALL, "campaign.sampling": "sobol", "campaign.cases": cases}
    assert run_study(load_study("tmt-segments", keys), tmp_path / "s", on="serial").quarantined == 0
