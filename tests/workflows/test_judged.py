"""Labels at which campaigns are judged: by `campaign.until` and by `wavequake tail`."""

import re
import tracemalloc

import dask
import dask.array as da
import numpy as np
import pytest
import toy
import xarray as xr

from wavequake.campaign.statistics import pooled
from wavequake.campaign.statistics.blocks import blocks
from wavequake.campaign.statistics.judged import judged_in, judged_of_template, populations_of, selected
from wavequake.campaign.statistics.quantiles import quantile
from wavequake.campaign.statistics.until import Goal, goal_of, is_met, quantiles_of
from wavequake.campaign.store.retention import stored_template
from wavequake.campaign.store.store import open_store
from wavequake.errors import UserError
from wavequake.report.answers.tail import RareQuestion, per_case, rare_events
from wavequake.workflows.kinds import find_kind
from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study, study_with

pytestmark = pytest.mark.usefixtures("mirror_models")

LENS = {"time.duration_s": 2.0, "time.step_ms": 20.0, "bench.springs": ["initial", "changed"]}


@pytest.fixture(scope="module")
def lens(tmp_path_factory):
    """Twenty-four runs of the lens bench: two configurations of springs, six controllers."""
    path = tmp_path_factory.mktemp("lens") / "s"
    study = load_study("lens-experiment", {**LENS, "campaign.cases": 24})
    run_study(study, path, on="serial")
    return study, path


def labelled(values):
    """A store's dataset: instants in two fields, under two controllers, with tilts."""
    return xr.Dataset(
        {
            "x": (("case", "controller", "time", "field"), values),
            "tilt": (("case", "controller", "time", "axis"), values),
            "power": (("case", "noll"), values[:, 0, 0]),
            "own": (("case", "mode"), values[:, 0, 0]),
            "image": (("case", "y", "x_"), values[:, 0]),
            "status": ("case", np.ones(len(values), dtype=np.int8)),
        },
        {
            "controller": np.array(["off", "FF+FI"], dtype=object),
            "field": np.array(["(0, 0) deg", "(0.1, 0) deg"], dtype=object),
            "axis": np.array(["x", "y"], dtype=object),
            "noll": [4, 11],
        },
    )


VALUES = np.random.default_rng(4).standard_normal((300, 2, 5, 2))


def one(text, dataset):
    judged = judged_in(text, dataset)
    ((cases, found),) = selected(judged, dataset[judged.variable])
    assert cases == slice(0, 300)
    return {label: values.to_numpy() for label, values in found.items()}


def test_labels_are_chosen_or_judged_one_by_one():
    data = labelled(VALUES)
    np.testing.assert_array_equal(one("x[controller=FF+FI]", data)[""], VALUES[:, 1])
    assert list(one("x", data)) == ["off", "FF+FI"]
    np.testing.assert_array_equal(one("x", data)["off"], VALUES[:, 0])
    np.testing.assert_array_equal(one("x[field=(0.1, 0) deg, controller=off]", data)[""], VALUES[:, 0, :, 1])
    np.testing.assert_array_equal(one("tilt[axis=y]", data)["FF+FI"], VALUES[:, 1, :, 1])
    np.testing.assert_allclose(one("tilt", data)["off"], np.hypot(*np.moveaxis(VALUES[:, 0], -1, 0)))
    np.testing.assert_array_equal(one(" power [ noll = 11 ] ", data)[""], VALUES[:, 0, 0, 1])
    np.testing.assert_array_equal(one("power[noll=4.0]", data)[""], VALUES[:, 0, 0, 0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x[controller=fi]", r"^x\[controller=fi\]: there is no controller 'fi'; use one of off, FF\+FI\.$"),
        ("x[springs=soft]", "x has no 'springs'; it has controller, field"),
        ("x[time=3]", "x has no 'time'; it has controller, field"),
        ("x[controller]", r"'controller' is no choice; write dimension=label\.$"),
        ("x[controller=]", "'controller=' is no choice"),
        ("power[ ]", r"^power\[\]: there is no choice in the brackets; choose one, as power\[noll=4\]\.$"),
        (
            "x[controller=off] [field=(0, 0) deg]",
            r"all choices stand in one pair of brackets; write x\[controller=off, field=\(0, 0\) deg\]\.$",
        ),
        ("x[controller=off, controller=off]", "controller is chosen twice; give one label"),
        ("power", r"'power' has a number for each noll; choose one, as power\[noll=4\]\.$"),
        ("power[noll=5]", "there is no noll '5'; use one of 4, 11"),
        ("power[noll=nan]", "there is no noll 'nan'"),
        ("own", "There is no 'own' to judge; use one of x, tilt, power"),
        ("status", "There is no 'status' to judge"),
        ("", "'' names nothing to judge"),
        ("x[controller=off", "names nothing to judge; write a variable, or"),
    ],
)
def test_what_names_nothing_is_refused_in_one_sentence(text, message):
    with pytest.raises(UserError, match=message):
        judged_in(text, labelled(VALUES))
    with pytest.raises(UserError, match="Nothing here is one number per case"):
        judged_in("x", labelled(VALUES)[["image"]])


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_every_label_that_is_offered_is_taken(dtype):
    random = np.random.default_rng(3)
    lines = [486.1327, 587.5618, 656.2725, 1 / 3, 1e-7 / 3, 2e9 / 3, 0.0, -1.5, *random.random(4)]
    names = ["(0, 0) deg", "(0, 0.1) deg", "(0, 1/3) deg"]
    data = xr.Dataset(
        {"x": (("case", "wavelength", "field", "mode"), np.zeros((1, 12, 3, 2)))},
        {"wavelength": np.array(lines, dtype=dtype), "field": np.array(names, dtype=object)},
    ).assign_coords(mode=np.array([1234567.25, 2.0], dtype=dtype))
    with pytest.raises(UserError) as refused:
        judged_in("x", data)
    (example,) = re.findall(r"as (x\[mode=.*\])\.$", str(refused.value))
    assert judged_in(example, data).chosen == {"mode": 0}
    for dim, separator, count in (("wavelength", ", ", 12), ("field", r", (?=\()", 3)):
        with pytest.raises(UserError) as refused:
            judged_in(f"x[mode=2, {dim}=nothing]", data)
        (offered,) = re.findall(r"use one of (.*)\.$", str(refused.value))
        chosen = [
            judged_in(f"x[mode=2, {dim}={label}]", data).chosen[dim] for label in re.split(separator, offered)
        ]
        assert chosen == list(range(count))


def test_a_goal_may_choose_and_is_met_by_every_label_that_it_leaves():
    constant = np.where(np.arange(2)[:, None, None] == 0, 5.0, VALUES)
    data = labelled(constant)
    found = quantiles_of(goal_of_text("x[controller=off]"), data)
    assert list(found) == ["all cases"]
    assert is_met(Goal("x", 0.5, 0.1), found)
    found = quantiles_of(goal_of_text("x"), data)
    assert list(found) == ["all cases, off", "all cases, FF+FI"]
    assert not is_met(Goal("x", 0.5, 0.1), found)
    pooled_values = np.sort(VALUES[:, 1].max(axis=-1), axis=None)
    assert found["all cases, FF+FI"].value == np.median(pooled_values)


def goal_of_text(variable):
    return Goal(variable, 0.5, 0.1)


def test_goals_are_read_with_their_labels(lens):
    study, _ = lens
    template = stored_template(find_kind("lens-experiment"), study.identity_text())
    assert goal_of("deviation[controller=FF+FI].p95 ci<=5%", template) == Goal(
        "deviation[controller=FF+FI]", 0.95, 0.05
    )
    with pytest.raises(
        UserError, match=r"^campaign.until: deviation\[controller=F\]: there is no controller"
    ):
        goal_of("deviation[controller=F].p95 ci<=5%", template)
    with pytest.raises(UserError, match=r"'zernike' has a number for each noll"):
        goal_of("zernike.p95 ci<=5%", toy.template(toy.study()))
    assert goal_of("zernike[noll=2].p95 ci<=5%", toy.template(toy.study())).variable == "zernike[noll=2]"


def test_lens_experiments_are_judged_per_controller_and_springs(lens):
    study, path = lens
    dataset = open_store(path)
    text = "deviation[controller=FF].p50 ci<=5%"
    template = stored_template(find_kind("lens-experiment"), study.identity_text())
    assert judged_of_template("deviation", template) == judged_in("deviation", dataset)
    found = quantiles_of(goal_of(text, template), dataset)
    assert list(found) == sorted(study.bench.springs)
    stored = dataset["deviation"].sel(controller="FF").to_numpy()
    for springs, known in found.items():
        mine = stored[dataset["springs"].to_numpy() == springs]
        assert len(mine) == 12
        assert known == quantile(mine, 0.5)
    every = quantiles_of(Goal("deviation", 0.5, 0.05), dataset)
    assert len(every) == 2 * 6
    assert every["initial, FF"] == found["initial"]
    assert set(populations_of(dataset)) == {"initial", "changed"}


def test_a_lens_campaign_stops_when_one_controller_is_known(tmp_path):
    keys = {"bench.springs": ["initial"], "store.chunk_cases": 4, "campaign.cases": 8}
    study = study_with(load_study("lens-experiment", LENS), keys)
    study = study_with(study, {"campaign.until": "deviation[controller=uncontrolled].p50 ci<=900%"})
    summary = run_study(study, tmp_path / "s", on="serial")
    assert summary.goal[0].startswith("deviation[controller=uncontrolled].p50 ci<=900% is met")
    assert summary.goal[1].startswith("deviation[controller=uncontrolled].p50 of initial: ")


def test_the_worst_field_is_the_smallest_where_small_values_are_judged(monkeypatch):
    random = np.random.default_rng(9)
    strehl = 1.0 - random.exponential([0.01, 0.1], (400, 3, 2))  # of two fields, the second is the worse one
    data = xr.Dataset(
        {"strehl": (("case", "time", "field"), strehl), "status": ("case", np.ones(400, dtype=np.int8))}
    )
    poor, good = strehl.min(axis=-1), strehl.max(axis=-1)
    for probability, worst in ((0.05, poor), (0.49, poor), (0.5, good), (0.95, good)):
        found = quantiles_of(Goal("strehl", probability, 0.01), data)["all cases"]
        np.testing.assert_allclose(found.value, np.quantile(worst, probability), rtol=1e-12)
    monkeypatch.setattr("wavequake.report.answers.tail.open_store", lambda path: data)
    (low,) = rare_events("s", RareQuestion("strehl", "mean", 1e-3, below=True)).found
    np.testing.assert_allclose(low.tail.values, np.sort(-strehl.mean(axis=1).min(axis=-1)), rtol=1e-14)
    (high,) = rare_events("s", RareQuestion("strehl", "mean", 1e-3)).found
    np.testing.assert_allclose(high.tail.values, np.sort(strehl.mean(axis=1).max(axis=-1)), rtol=1e-14)


@pytest.fixture(scope="module")
def many(tmp_path_factory):
    """A dataset of a store of 400 cases under two controllers."""
    return labelled(np.random.default_rng(5).standard_exponential((400, 2, 3, 2)))


def test_tails_are_judged_per_controller(many, monkeypatch, wavequake):
    monkeypatch.setattr("wavequake.report.answers.tail.open_store", lambda path: many)
    question = RareQuestion("x", "max", 1e-3)
    found = rare_events("s", question).found
    assert [tail.name for tail in found] == ["all cases, off", "all cases, FF+FI"]
    (chosen,) = rare_events("s", RareQuestion("x[controller=FF+FI]", "max", 1e-3)).found
    assert (chosen.name, chosen.value) == ("all cases", found[1].value)
    np.testing.assert_array_equal(chosen.tail.values, np.sort(many["x"].to_numpy()[:, 1].max(axis=(1, 2))))
    code, out, _ = wavequake("tail", "s", "--variable", "x[controller=FF+FI]", "--statistic", "max")
    assert code == 0
    assert "x[controller=FF+FI] (1)," in out
    code, _, err = wavequake("tail", "s")
    assert code == 2
    assert "holds no wavefront error on the glass" in err
    assert "name one of x, tilt, power (--variable NAME)." in err
    code, _, err = wavequake("tail", "s", "--variable", "x[controller=F]")
    assert (code, "there is no controller 'F'; use one of off, FF+FI." in err) == (2, True)


def test_what_has_no_tail_keeps_others_from_nothing(many, monkeypatch, wavequake):
    constant = many.assign(x=many["x"].where(many["controller"] != "off", 7.0))
    monkeypatch.setattr("wavequake.report.answers.tail.open_store", lambda path: constant)
    answer = rare_events("s", RareQuestion("x", "max", 1e-3))
    assert [tail.name for tail in answer.found] == ["all cases, FF+FI"]
    assert answer.reasons == ("all cases, off: Only 0 of 400 cases exceed 7, and a tail needs at least 50; "
                              "take more cases or a lower threshold.",)  # fmt: skip
    code, out, _ = wavequake("tail", "s", "--variable", "x")
    assert code == 0
    assert "Not judged: all cases, off: Only 0 of 400 cases exceed 7" in out
    code, _, err = wavequake("tail", "s", "--variable", "x[controller=off]")
    assert code == 2
    assert "Error: all cases: Only 0 of 400 cases exceed 7" in err


def lazily(reads):
    """A store's dataset of 38 MB in chunks of 150 cases, which notes what is read of it."""

    def part(block_info):
        (case, *_), (_, controller, *_) = (
            block_info[None][key] for key in ("array-location", "chunk-location")
        )
        reads.append((case[0], controller))
        shape = block_info[None]["chunk-shape"]
        return np.random.default_rng((case[0], controller)).standard_exponential(shape)

    chunks = ((150,) * 16, (1, 1), (500,), (2,))
    values = da.map_blocks(part, chunks=chunks, dtype=float, meta=np.empty((0,) * 4))
    return xr.Dataset(
        {
            "x": (("case", "controller", "time", "field"), values),
            "status": ("case", np.ones(2400, dtype=np.int8)),
        },
        {"controller": np.array(["off", "FF"], dtype=object)},
    )


@pytest.mark.parametrize(("text", "asked"), [("x", ["off", "FF"]), ("x[controller=FF]", ["FF"])])
def test_what_is_judged_is_read_once_and_a_part_of_it_held(monkeypatch, text, asked):
    reads = []
    data = lazily(reads)
    whole = data["x"].to_numpy()[:, -len(asked) :]
    monkeypatch.setattr("wavequake.campaign.statistics.blocks.BLOCK_BYTES", 2**22)
    reads.clear()
    with dask.config.set(scheduler="synchronous"):
        tracemalloc.start()
        found = per_case(data, judged_in(text, data), "rms")
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    places = range(2 - len(asked), 2)
    once = [(150 * block, place) for block in range(16) for place in places]
    assert sorted(reads) == once
    assert data["x"].nbytes == 38_400_000
    assert peak < 15e6
    rms = np.sqrt((whole**2).mean(axis=2)).max(axis=-1)
    np.testing.assert_allclose(np.stack([*found.values()], axis=1), rms, rtol=1e-13)
    reads.clear()
    known = quantiles_of(Goal(text, 0.05, 0.1), data)
    assert sorted(reads) == once
    assert [*known.values()] == [
        quantile(whole[:, place].min(axis=-1), 0.05, 2400) for place in range(len(asked))
    ]


STREAMED = {
    "normal": np.random.default_rng(6).standard_normal((500, 7)),
    "ties": np.round(np.random.default_rng(7).standard_normal((500, 3)), 1),
    "constant": np.zeros((300, 2)),
    "infinite": np.where(np.arange(900).reshape(300, 3) % 3 == 2, np.inf, 1.0),
    "negative": -np.random.default_rng(8).pareto(0.3, (200, 5)),
    "few": np.array([[1.0, 2.0], [np.nan, np.nan]]),
    "none": np.full((3, 2), np.nan),
    "tiny": np.array([[5e-324], [-5e-324], [0.0], [1e308]]),
}


@pytest.mark.parametrize("stratified", [False, True])
@pytest.mark.parametrize("probability", [0.005, 0.5, 0.95, 0.999])
def test_quantiles_of_what_memory_does_not_hold_have_the_same_bits(monkeypatch, probability, stratified):
    gaps = {name: values.copy() for name, values in STREAMED.items()}
    gaps["normal"][::3, 5:] = np.nan  # populations of fewer instants
    gaps["normal"][7] = np.nan
    sets = {name: np.arange(len(values)) % 5 for name, values in gaps.items()}

    def parts():
        for first in range(0, 500, 64):
            for name, values in gaps.items():
                some = slice(first, first + 64)
                yield name, values[some], sets[name][some] if stratified else None

    held = pooled.pooled_quantiles(parts, probability)
    monkeypatch.setattr(pooled, "HELD", 20)
    streamed = pooled.pooled_quantiles(parts, probability)
    assert held.keys() == streamed.keys() == gaps.keys()
    for name, values in gaps.items():
        np.testing.assert_array_equal(
            [streamed[name].value, streamed[name].low, streamed[name].high],
            [held[name].value, held[name].low, held[name].high],
            err_msg=name,
        )
        finite = values[~np.isnan(values)]
        if finite.size and not stratified:
            assert held[name] == quantile(finite, probability, min(len(values), finite.size))
            if np.isfinite(finite).all():
                within = np.clip(np.quantile(finite, probability), held[name].low, held[name].high)
                np.testing.assert_allclose(held[name].value, within, 1e-12, 1e-320)


def test_order_statistics_are_those_of_sorting():
    scaled = STREAMED["normal"].ravel() * np.logspace(-300, 300, 3500)
    values = np.concatenate([scaled, [-np.inf, np.inf]])
    places = [0, 1, 17, 1750, 3500, 3501]
    found = pooled.order_statistics(
        lambda: [("a", part, None) for part in np.split(values, 2)], {"a": places}
    )
    assert [found["a"][place] for place in places] == np.sort(values)[places].tolist()


def test_goals_are_judged_by_blocks_with_the_same_answer(lens, monkeypatch):
    _, path = lens
    dataset, goal = open_store(path), Goal("image", 0.9, 0.1)
    whole = quantiles_of(goal, dataset)
    monkeypatch.setattr("wavequake.campaign.statistics.blocks.BLOCK_BYTES", 20_000)
    assert len(list(blocks([dataset["image"].variable]))) >= 3
    assert quantiles_of(goal, dataset) == whole
    monkeypatch.setattr(pooled, "HELD", 1000)
    assert quantiles_of(goal, dataset) == whole
    values = dataset["image"].to_numpy()[dataset["springs"].to_numpy() == "initial", 1]
    assert whole["initial, FF"] == quantile(values.astype(np.float64), 0.9, 12)
