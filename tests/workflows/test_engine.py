import os
import subprocess
import sys

import numpy as np
import pytest
import toy
from threadpoolctl import threadpool_limits

from wavequake.campaign.contract import ChunkResult, StudyKind
from wavequake.campaign.engine import driver
from wavequake.campaign.engine.chunks import BrokenWorkflowError
from wavequake.campaign.engine.driver import run_campaign
from wavequake.campaign.store.store import open_store, read_manifest
from wavequake.cluster import places
from wavequake.errors import UserError


def test_a_serial_run_stores_what_the_workflow_computes(tmp_path):
    calls = []
    summary = toy.run(tmp_path / "s", cases=43, progress=lambda *counts: calls.append(counts))
    assert (summary.done_before, summary.computed, summary.quarantined, summary.chunks) == (0, 43, 0, 5)
    assert calls == [(n, 43, 0) for n in (0, 10, 20, 30, 40, 43)]
    stored = open_store(tmp_path / "s").load()
    np.testing.assert_array_equal(stored.zernike, [toy.numbers(case) for case in range(43)])
    np.testing.assert_array_equal(stored["count"], 3 * np.arange(43))
    assert summary.seconds > summary.compute_seconds + summary.write_seconds > 0


def test_a_second_run_computes_nothing(tmp_path):
    toy.run(tmp_path / "s")
    before = toy.digests(tmp_path / "s")
    summary = toy.run(tmp_path / "s")
    assert (summary.done_before, summary.computed, summary.chunks) == (40, 0, 0)
    assert toy.digests(tmp_path / "s") == before
    assert toy.records(tmp_path / "s") == 4


def test_bits_do_not_depend_on_the_chunk_or_where_it_runs(tmp_path):
    toy.run(tmp_path / "alone", cases=23, chunk=1)
    toy.run(tmp_path / "short", cases=23, chunk=10)
    toy.run(tmp_path / "one", cases=23, chunk=100)
    toy.run(tmp_path / "local", cases=23, chunk=10, on="local", workers=2)
    reference = open_store(tmp_path / "alone").load()
    for name in ("short", "one", "local"):
        other = open_store(tmp_path / name).load()
        for variable in reference.data_vars:
            assert (
                other[variable].values.tobytes() == reference[variable].values.tobytes()
                or variable == "message"
            )
    assert toy.digests(tmp_path / "local") == toy.digests(tmp_path / "short")


@pytest.mark.parametrize("cases", [40, 43])
def test_an_extension_computes_only_what_is_new(tmp_path, cases):
    toy.run(tmp_path / "s", cases=cases)
    before, numbers = toy.digests(tmp_path / "s"), open_store(tmp_path / "s").zernike.load()
    summary = toy.run(tmp_path / "s", cases=80)
    assert (summary.done_before, summary.computed) == (40, 40)  # a short last chunk is computed again
    toy.run(tmp_path / "whole", cases=80)
    after = toy.digests(tmp_path / "s")
    assert {chunk: after[chunk] for chunk in toy.digests(tmp_path / "whole")} == toy.digests(
        tmp_path / "whole"
    )
    whole = {chunk: digests for chunk, digests in before.items() if chunk[1] <= 40}
    assert {chunk: after[chunk] for chunk in whole} == whole
    # The record of a short last chunk is void once its file is written anew; its cases keep their bits.
    np.testing.assert_array_equal(open_store(tmp_path / "s").zernike[:cases], numbers)
    assert sorted(after) == [(first, first + 10) for first in range(0, 80, 10)]


def test_fewer_cases_than_the_store_has_are_its_first_ones(tmp_path):
    toy.run(tmp_path / "s", cases=20)
    summary = toy.run(tmp_path / "s", cases=5, chunk=3)
    assert (summary.done_before, summary.computed) == (10, 0)
    assert read_manifest(tmp_path / "s").cases == 20
    assert read_manifest(tmp_path / "s").chunk == 10


def test_only_the_guilty_cases_are_quarantined(tmp_path):
    summary = toy.run(tmp_path / "s", {"poison": [12, 17], "reasons": [15, 33]})
    assert (summary.computed, summary.quarantined) == (40, 4)
    stored = open_store(tmp_path / "s").load()
    bad = np.isin(stored.case, [12, 15, 17, 33])
    np.testing.assert_array_equal(stored.status, np.where(bad, 2, 1))
    np.testing.assert_array_equal(np.isnan(stored.zernike).all(("time", "noll")), bad)
    assert stored.message.sel(case=[11, 12, 15]).values.tolist() == [
        "",
        "ValueError: the segment broke",
        "case 15 loses a segment",
    ]
    good = stored.isel(case=~bad)
    np.testing.assert_array_equal(good.zernike, [toy.numbers(case) for case in good.case.values])
    assert toy.run(tmp_path / "s", {"poison": [12, 17], "reasons": [15, 33]}).quarantined == 4


def campaign(path, compute, **keywords):
    workflow = StudyKind("toy", toy.template, toy.case_table, compute)
    return run_campaign(
        workflow, toy.study(), path, cases=4, chunk=2, device="numpy", on="serial", **keywords
    )


def test_a_workflow_that_finds_the_study_impossible_ends_the_run(tmp_path):
    def impossible(text, cases, device):
        raise UserError("no ray meets glass")

    with pytest.raises(UserError, match="no ray meets glass"):
        campaign(tmp_path / "s", impossible)
    campaign(tmp_path / "s", toy.compute)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: ChunkResult({**r.arrays, "extra": r.status}, r.status, r.messages), "instead of"),
        (lambda r: ChunkResult(r.arrays, r.status * 0, r.messages), "status of 1 to 5"),
        (lambda r: ChunkResult(r.arrays, r.status, ("",) * 7), "message and a status"),
        (
            lambda r: ChunkResult({**r.arrays, "strehl": r.arrays["time_s"]}, r.status, r.messages),
            "'strehl' the shape",
        ),
    ],
)
def test_a_workflow_that_breaks_its_contract_is_a_bug_and_no_failed_case(tmp_path, change, words):
    with pytest.raises(BrokenWorkflowError, match=words):
        campaign(tmp_path / "s", lambda *arguments: change(toy.compute(*arguments)))


def test_there_is_one_blas_thread_in_a_chunk(tmp_path):
    threads = []

    def watch(*arguments):
        threads.append(toy.blas_threads())
        return toy.compute(*arguments)

    with threadpool_limits(2):
        campaign(tmp_path / "s", watch)
        watch(toy.study(), np.arange(2), "numpy")
    assert threads == [{1}, {1}, {2}]


def test_a_second_driver_is_refused(tmp_path):
    toy.run(tmp_path / "s")
    refusals = []

    def meanwhile(*counts):
        with pytest.raises(UserError, match=r"is in use by process \d+ on ") as refused:
            toy.run(tmp_path / "s")
        refusals.append(str(refused.value))

    toy.run(tmp_path / "s", cases=50, progress=meanwhile)
    assert len(refusals) == 2
    toy.run(tmp_path / "s")


def test_an_unknown_place_to_run_is_refused_before_anything_is_made(tmp_path):
    with pytest.raises(UserError, match="on='slurmm' is unknown; use serial, local, slurm, ssh"):
        toy.run(tmp_path / "s", on="slurmm")
    assert not (tmp_path / "s").exists()


def test_a_scheduler_elsewhere_does_the_same(tmp_path, monkeypatch):
    from distributed import LocalCluster

    toy.run(tmp_path / "serial", cases=25)
    with LocalCluster(1, threads_per_worker=1, dashboard_address=None) as cluster:
        summary = toy.run(tmp_path / "s", cases=25, on=cluster.scheduler_address)
        toy.run(tmp_path / "s", cases=35, on=cluster.scheduler_address)  # its workers see the extended store
    assert summary.computed == 25
    toy.run(tmp_path / "serial", cases=35)
    assert toy.digests(tmp_path / "s") == toy.digests(tmp_path / "serial")
    assert len(toy.digests(tmp_path / "s")) == 4
    monkeypatch.setattr(places, "connected", lambda *arguments, **keywords: pytest.fail("not needed"))
    toy.run(tmp_path / "s", cases=35, on="tcp://nowhere:1")


def test_workers_of_a_store_that_is_continued_are_forked_from_what_has_loaded_their_tasks(
    tmp_path, monkeypatch
):
    asked = []
    monkeypatch.setattr(driver, "prepare_workers", lambda *modules: asked.append(modules))
    toy.run(tmp_path / "s", cases=10)
    assert asked == []
    assert toy.run(tmp_path / "s", cases=20, on="local", workers=1).computed == 10
    assert asked == [("wavequake.campaign.engine.chunks", "toy")]


def test_a_script_without_a_main_guard_is_told_so(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(f"import toy\ntoy.run({str(tmp_path / 's')!r}, on='local', workers=1)\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, script], env=environment, capture_output=True, text=True, timeout=60
    )
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("wavequake.errors.NoWorkersError: The worker processes do not start")
    assert '`if __name__ == "__main__":`' in last
    assert done.stderr.count("Traceback") == 1
