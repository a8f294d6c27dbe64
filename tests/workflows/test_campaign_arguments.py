"""What `wavequake.run` takes: numbers of NumPy, folders that are none, and titles."""

import dataclasses
import threading

import numpy as np
import pytest

import wavequake as wq
from wavequake.campaign.contract import Template, Variable
from wavequake.campaign.engine.chunk_size import default_chunk
from wavequake.campaign.store.store import read_manifest
from wavequake.errors import UserError
from wavequake.prepared import prepared, preparing
from wavequake.workflows.planning import plan as campaign
from wavequake.workflows.planning.plan import plan
from wavequake.workflows.run import chunk_of
from wavequake.workflows.study import load_study

SMALL = {
    "telescope__name": "tmt-18",
    "optics__rays_per_segment": 6,
    "imaging__pixels": 16,
    "wavefront__zernike_terms": 6,
    "store__chunk_cases": 2,
    "campaign__device": "numpy",
}


def test_counts_may_be_numpys_and_stores_keep_the_title(tmp_path):
    titled = {**SMALL, "study__title": "18 segments <in the wind>"}
    store = tmp_path / "store"
    found = wq.run("tmt-segments", cases=np.int64(2), store=store, **titled)
    assert found.sizes["case"] == 2
    assert found.attrs["study_title"] == "18 segments <in the wind>"
    # The title is no part of the identity: the store goes on under another one.
    again = wq.run("tmt-segments", cases=np.int64(2), store=str(store), **SMALL)
    assert again.attrs["study_sha256"] == found.attrs["study_sha256"]


@pytest.mark.parametrize("store", [3, 2.5, ["runs"], b"runs", True])
def test_a_store_that_is_no_path_is_refused(store):
    with pytest.raises(UserError, match="it must be the path of a folder"):
        wq.run("tmt-segments", cases=2, store=store, **SMALL)
    with pytest.raises(UserError, match="it must be the path of a folder"):
        wq.sensitivity("tmt-segments", store=store, **SMALL)


def test_a_count_that_is_no_whole_number_is_refused():
    with pytest.raises(UserError, match="cases"):
        wq.run("tmt-segments", cases=np.float64(2.5), **SMALL)


@pytest.mark.parametrize(
    ("cases", "chunk"),
    [
        (1, 20),
        (160, 20),
        (161, 21),
        (640, 80),
        (1000, 125),
        (2000, 200),
        (8000, 200),
        (8001, 201),
        (10**6, 400),
    ],
)
def test_a_chunk_is_an_eighth_or_a_fortieth_of_the_cases_within_limits(cases, chunk):
    keys = {"telescope.name": "tmt-18", "campaign.cases": cases}
    assert chunk_of(load_study("tmt-segments", keys)) == chunk
    assert chunk_of(load_study("tmt-segments", {**keys, "store.chunk_cases": 7})) == 7


@pytest.mark.parametrize(
    ("stored", "working", "chunk"),
    [(1, 0, 400), (2**20, 0, 256), (2**20, 2**22, 64), (2**22, 2**20, 64), (2**30, 0, 1), (0, 0, 400)],
)
def test_a_chunk_fits_in_memory(stored, working, chunk):
    per_case = {
        "numbers": Variable(("time",), (stored // 8,), {}),
        "flag": Variable((), (stored % 8,), {}, dtype="int8"),
    }
    assert default_chunk(10**6, Template(per_case, working_bytes=working)) == chunk


def test_cases_of_many_instants_share_a_chunk_with_few_whatever_is_kept():
    """492 segments of 6 motions in float64, at 4000 instants, are 94 MB of 268."""
    keys = {
        "imaging.enabled": False,
        "store.reduce": "summary",
        "campaign.cases": 10**5,
        "disturbance.wind.instants": 4000,
    }
    assert chunk_of(load_study("tmt-segments", keys)) == 2


def test_a_store_keeps_its_chunk_when_it_grows(tmp_path):
    keys = {name: value for name, value in SMALL.items() if name != "store__chunk_cases"}
    wq.run("tmt-segments", cases=3, store=tmp_path / "s", **keys)
    study = load_study("tmt-segments", {"campaign.cases": 640})
    assert (chunk_of(study, tmp_path / "s"), chunk_of(study, tmp_path / "other")) == (20, 80)
    wq.run("tmt-segments", cases=21, store=tmp_path / "s", store__chunk_cases=5, **keys)
    assert read_manifest(tmp_path / "s").chunk == 20


@pytest.mark.parametrize(
    ("seconds", "chunk", "cases", "words"),
    [
        (0.01, 20, 10_000, "0.2 s; the store takes a smaller share with store.chunk_cases=200"),
        (0.01, 20, 100, "0.2 s"),  # all of it takes a second
        (0.1, 40, 10_000, "4 s"),
        (3.0, 20, 60, "60 s; a crash costs less with store.chunk_cases=3"),
        (30.0, 20, 60, "600 s; a crash costs less with store.chunk_cases=1"),
        (30.0, 1, 60, "30 s"),
    ],
)
def test_a_plan_says_which_chunk_would_suit_better(monkeypatch, seconds, chunk, cases, words):
    def clock(now=[0.0]):  # noqa: B006 (a clock)
        return now[0]

    def compute(text, ids, device):
        clock.__defaults__[0][0] += seconds * len(ids)

    study = load_study("tmt18-history", {"campaign.cases": cases, "store.chunk_cases": chunk})
    workflow = dataclasses.replace(campaign.kind_of(study), compute=compute)
    monkeypatch.setattr(campaign, "kind_of", lambda study: workflow)
    monkeypatch.setattr(campaign.time, "perf_counter", clock)
    assert plan(study)["one chunk"] == words


@pytest.mark.parametrize(
    ("seconds", "whole", "flights"),
    [
        (0.001, 1000, [1, 1000]),  # a whole chunk is over soon
        (0.01, 1000, [1, 8]),  # that is enough to tell
        (0.003, 1000, [1, 8, 64]),
        (1.0, 20, [1, 2]),
        (3.0, 20, [1]),  # nothing is computed twice
        (0.01, 1, [1]),
        (0.0, 20, [1, 20]),  # less than the clock can tell
    ],
)
def test_a_plan_flies_no_more_than_it_takes_to_tell_a_case_s_time(monkeypatch, seconds, whole, flights):
    """Models, tables and kernels, half a minute in the first flight, are no part of a case's time."""
    now, flown = [0.0], []

    @prepared(maxsize=1)
    def prepare():
        now[0] += 20.0

    def fly(cases):
        with preparing():
            prepare()
            now[0] += 0.0 if flown else 10.0
        now[0] += seconds * cases
        flown.append(cases)

    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    each, pilot = campaign._time_case(fly, whole)
    assert (flown, pilot) == (flights, flights[-1])
    assert each == pytest.approx(seconds, rel=1e-9, abs=1e-9)


def test_what_other_threads_prepare_is_no_part_of_this_one_s_time(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])

    def other():
        with preparing():
            now[0] += 5.0

    def fly(cases):
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        now[0] += 1.0

    assert campaign._time_case(fly, 1) == (6.0, 1)


@pytest.mark.parametrize("until", ["wfe_rms.p95 ci<=-2%", "nonsense", "", "phase.p95 ci<=2%"])
def test_a_plan_refuses_a_goal_that_a_run_would_refuse(until):
    keys = {"telescope.name": "tmt-18", "campaign.device": "numpy", "campaign.until": until}
    with pytest.raises(UserError, match=r"campaign\.until"):
        plan(load_study("tmt-segments", keys))
