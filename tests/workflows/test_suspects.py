"""Cases that hang, take all memory or diverge, and busy disks: the guilty are named, the others are kept."""

import errno
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import toy
from threadpoolctl import threadpool_limits

from wavequake.campaign import provenance
from wavequake.campaign.engine import chunks, isolation
from wavequake.campaign.engine.chunks import compute_chunk
from wavequake.campaign.engine.stream import limit_of
from wavequake.campaign.store import arrays, journal
from wavequake.campaign.store.status import store_status
from wavequake.campaign.store.store import create_store, open_store, read_manifest
from wavequake.campaign.store.verify import verify_store
from wavequake.cluster import local
from wavequake.errors import UserError


def others_are_kept(stored, guilty):
    others = stored.isel(case=~np.isin(stored.case, guilty))
    np.testing.assert_array_equal(others.status, 1)
    np.testing.assert_array_equal(others.zernike, [toy.numbers(case) for case in others.case.values])


def test_a_case_that_hangs_is_ended_and_quarantined_alone(tmp_path):
    summary = toy.run(tmp_path / "s", {"hang": [13]}, on="local", workers=2, timeout_s=2.0)
    assert (summary.computed, summary.quarantined) == (40, 1)
    stored = open_store(tmp_path / "s").load()
    assert stored.status.sel(case=13) == 4
    assert stored.message.sel(case=13).item() == "it took longer than 2 s (campaign.timeout_s)"
    others_are_kept(stored, [13])
    assert verify_store(tmp_path / "s").ok
    (log,) = (tmp_path / "s" / "log").glob("*.log")
    assert "cases 10 to 20 ran for too long on tls://127.0.0.1:" in log.read_text()


def test_a_case_that_hangs_in_a_serial_run_is_quarantined_alone(tmp_path):
    with threadpool_limits(2):
        summary = toy.run(tmp_path / "s", {"wait": [13, 19]}, timeout_s=1.0)
        assert toy.blas_threads() == {2}
    assert (summary.computed, summary.quarantined) == (40, 2)
    stored = open_store(tmp_path / "s").load()
    assert stored.status.sel(case=[13, 19]).values.tolist() == [4, 4]
    assert stored.message.sel(case=13).item() == "it took longer than 1 s (campaign.timeout_s)"
    others_are_kept(stored, [13, 19])
    assert verify_store(tmp_path / "s").ok
    (log,) = (tmp_path / "s" / "log").glob("*.log")
    assert "cases 10 to 20 ran for too long and are given up for now" in log.read_text()


SERIAL = """
import toy, wavequake.campaign.engine.series as series
series._GRACE_S = 0.5
toy.run({path!r}, {options!r}, timeout_s=1.0)
"""
GUARDED = """
import toy, wavequake.campaign.engine.series as series
series._GRACE_S = 0.5
if __name__ == "__main__":
    print(toy.run({path!r}, {options!r}, timeout_s=1.0).quarantined)
"""


def ran(tmp_path, text, **options):
    script = tmp_path / "script.py"
    script.write_text(text.format(path=str(tmp_path / "s"), options=options))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(
        [sys.executable, script], env=environment, capture_output=True, text=True, timeout=60, check=False
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"hang": [13]}, "Timeout (0:00:01.500000)!"),  # a traceback follows, of where it hangs
        ({"wait": [13]}, "The process that tries cases 10 to 19 alone does not start: a script that starts"),
    ],
)
def test_what_ends_a_serial_run_says_why_and_keeps_what_is_done(tmp_path, options, words):
    done = ran(tmp_path, SERIAL, **options)
    assert done.returncode == 1
    assert words in done.stderr
    assert "toy.py" in done.stderr or "wait" in options
    assert (0, 10) in toy.digests(tmp_path / "s")


@pytest.mark.parametrize(
    ("options", "code", "status"), [({"hang": [13]}, 1, 4), ({"crash": [13]}, -signal.SIGSEGV, 3)]
)
def test_a_case_that_ends_a_serial_run_is_quarantined_by_the_next(tmp_path, options, code, status):
    assert ran(tmp_path, GUARDED, **options).returncode == code
    assert [mark.name for mark in (tmp_path / "s" / "done").glob("*.open")] == ["10-20.open"]
    again = ran(tmp_path, GUARDED, **options)
    assert (again.returncode, again.stdout, again.stderr) == (0, "1\n", "")
    stored = open_store(tmp_path / "s").load()
    assert stored.status.sel(case=13) == status
    others_are_kept(stored, [13])
    assert verify_store(tmp_path / "s").ok
    assert not list((tmp_path / "s" / "done").glob("*.open"))
    logs = sorted((tmp_path / "s" / "log").glob("*.log"), key=os.path.getmtime)
    assert "the run before died in cases 10 to 19: each is tried alone" in logs[-1].read_text()


def test_a_serial_script_that_was_killed_goes_on_although_it_cannot_start_processes(tmp_path):
    options = {"once": [13], "folder": str(tmp_path)}  # a kill, of which no case is guilty
    assert ran(tmp_path, SERIAL, **options).returncode == -signal.SIGKILL
    again = ran(tmp_path, SERIAL, **options)
    assert (again.returncode, again.stderr) == (0, "")
    others_are_kept(open_store(tmp_path / "s").load(), [])
    assert not list((tmp_path / "s" / "done").glob("*.open"))


def test_a_case_that_takes_all_memory_is_quarantined_alone(tmp_path, monkeypatch):
    for module in (local, isolation):
        monkeypatch.setattr(module, "memory_limit", lambda: 600 * 2**20)
    summary = toy.run(tmp_path / "s", {"hoard": [3]}, cases=20, on="local", workers=1)
    assert (summary.computed, summary.quarantined) == (20, 1)
    stored = open_store(tmp_path / "s").load()
    assert stored.status.sel(case=3) == 2
    assert "MemoryError: Unable to allocate" in stored.message.sel(case=3).item()
    others_are_kept(stored, [3])


def killed_at_first(connection, job, cases, memory, environment):
    """Serve as a process of its own does, but for the first ones, which somebody kills before they begin."""
    flags = Path(environment["FLAGS"])
    if len(before := list(flags.iterdir())) < 2:
        (flags / str(len(before))).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    isolation._serve(connection, job, cases, memory, environment)


def test_a_process_that_is_killed_before_it_begins_says_nothing_of_a_case(tmp_path, monkeypatch):
    (tmp_path / "flags").mkdir()
    monkeypatch.setenv("FLAGS", str(tmp_path / "flags"))
    monkeypatch.setattr(isolation, "_serve", killed_at_first)
    summary = toy.run(tmp_path / "s", {"crash": [13]}, cases=20, on="local", workers=1)
    assert (summary.computed, summary.quarantined) == (20, 1)
    assert len(list((tmp_path / "flags").iterdir())) == 2
    others_are_kept(open_store(tmp_path / "s").load(), [13])


def test_the_usual_time_of_a_chunk_says_when_one_hangs():
    assert limit_of(7.5, [100.0] * 5) == 7.5
    assert limit_of(None, []) == 3 * 3600
    assert limit_of(None, [1.0, 2.0, 500.0]) == 1800
    assert limit_of(None, [100.0, 300.0, 200.0]) == 4000


def test_a_case_that_is_not_finite_has_diverged_and_keeps_its_numbers(tmp_path):
    summary = toy.run(tmp_path / "s", {"blow": [12], "reasons": [15]})
    assert summary.quarantined == 2
    stored = open_store(tmp_path / "s").load()
    assert stored.status.sel(case=[12, 15]).values.tolist() == [5, 2]
    assert stored.message.sel(case=12).item() == "zernike is not finite from instant 2 on"
    np.testing.assert_array_equal(stored.zernike.sel(case=12)[:2], toy.numbers(12)[:2])
    others_are_kept(stored, [12, 15])


@pytest.mark.parametrize(("unknown", "quarantined"), [(0, 10), (1, 1)])
def test_what_is_unknown_by_intent_does_not_diverge(tmp_path, unknown, quarantined):
    """The piston of ray slopes is no number; another term that is none is a fault."""

    def slopes(text):
        made = toy.template(text)
        zernike = replace(made.per_case["zernike"], unknown=unknown)
        return replace(made, per_case={**made.per_case, "zernike": zernike})

    def without_piston(*arguments):
        result = toy.compute(*arguments)
        result.arrays["zernike"][..., 0] = np.nan
        result.arrays["zernike"][3, 1, 1] = np.nan
        return result

    create_store(tmp_path / "s", toy.TOY, toy.study(), 10, 10, "numpy", {})
    workflow = toy.StudyKind("toy", slopes, toy.case_table, without_piston)
    found = compute_chunk(toy.job(tmp_path / "s", workflow), 0, 10)
    assert found.quarantined == quarantined


def test_instants_that_a_case_does_not_have_do_not_diverge(tmp_path):
    def shorter(*arguments):
        result = toy.compute(*arguments)
        for name in ("time_s", "zernike"):
            result.arrays[name][:, 3:] = np.nan
        result.arrays["strehl"][:] = np.inf  # no series: this may mean something
        return result

    create_store(tmp_path / "s", toy.TOY, toy.study(), 10, 10, "numpy", {})
    short = toy.StudyKind("toy", toy.template, toy.case_table, shorter)
    assert compute_chunk(toy.job(tmp_path / "s", short), 0, 10).quarantined == 0


@pytest.mark.parametrize("times", [1, 3, 4])
def test_a_disk_that_is_busy_for_a_while_is_waited_for(tmp_path, monkeypatch, times):
    monkeypatch.setattr(chunks, "_PAUSES_S", (0.0, 0.0, 0.0))
    failures = {"data": times, "journal": times}
    put, record = arrays._put, journal.append

    def fail(what):
        if failures[what]:
            failures[what] -= 1
            raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))

    def busy(path, parts):
        if path.name.startswith("c."):
            fail("data")
        put(path, parts)

    def busy_journal(folder, entry):
        fail("journal")
        record(folder, entry)

    create_store(tmp_path / "s", toy.TOY, toy.study(), 40, 10, "numpy", {})
    monkeypatch.setattr(arrays, "_put", busy)
    monkeypatch.setattr(journal, "append", busy_journal)
    if times > 3:
        with pytest.raises(OSError, match=r"[Ss]tale"):
            toy.run(tmp_path / "s")
        monkeypatch.undo()
    toy.run(tmp_path / "s")
    toy.run(tmp_path / "whole")
    assert toy.digests(tmp_path / "s") == toy.digests(tmp_path / "whole")
    assert toy.records(tmp_path / "s") == 4


def test_another_version_of_the_code_is_refused_unless_allowed_and_then_recorded(tmp_path, monkeypatch):
    toy.run(tmp_path / "s")
    one = provenance.code()
    monkeypatch.setattr(provenance, "code", lambda: "wavequake 9.9 (feed)")
    with pytest.raises(
        UserError, match=r"was begun by wavequake .*; this is wavequake 9\.9 \(feed\).*--allow-m"
    ):
        toy.run(tmp_path / "s", cases=60, allow_mixed=False)
    assert toy.run(tmp_path / "s", allow_mixed=False).computed == 0  # what is done is done
    assert toy.run(tmp_path / "s", cases=60, allow_mixed=True).computed == 20
    found = store_status(tmp_path / "s")
    assert found.codes == {one: 4, "wavequake 9.9 (feed)": 2}
    assert "  2 chunks by wavequake 9.9 (feed)" in found.lines()


def test_a_store_that_another_version_made_and_never_used_is_made_anew(tmp_path, monkeypatch):
    other = toy.study(seed=8)  # what a key that the new version adds does to the identity
    create_store(tmp_path / "s", toy.TOY, other, 60, 10, "numpy", {"code": "wavequake 0.1 (feed)"})
    assert toy.run(tmp_path / "s", allow_mixed=False).computed == 40
    found = read_manifest(tmp_path / "s")
    assert (found.study, found.provenance["code"]) == (toy.study(), provenance.code())
    assert verify_store(tmp_path / "s").ok
    monkeypatch.setattr(provenance, "code", lambda: "wavequake 9.9 (feed)")
    with pytest.raises(UserError, match="another study"):  # now there is something to lose
        toy.run(tmp_path / "s", {"seed": 8}, allow_mixed=False)


def test_a_blank_store_of_this_version_keeps_its_study(tmp_path):
    create_store(tmp_path / "s", toy.TOY, toy.study(seed=8), 40, 10, "numpy", {"code": provenance.code()})
    with pytest.raises(UserError, match="another study"):
        toy.run(tmp_path / "s")


def test_a_worker_with_other_code_refuses(tmp_path):
    toy.run(tmp_path / "s")
    with pytest.raises(
        UserError, match=r"A worker computes with wavequake .* the driver with wavequake 9: inst"
    ):
        compute_chunk(toy.job(tmp_path / "s", code="wavequake 9"), 0, 10)


def test_every_run_that_computes_leaves_a_log(tmp_path):
    toy.run(tmp_path / "s", {"reasons": [15]})
    toy.run(tmp_path / "s", {"reasons": [15]})
    (log,) = (tmp_path / "s" / "log").glob("*.log")
    lines = log.read_text().splitlines()
    assert "wavequake" in lines[0]
    assert "on=serial" in lines[0]
    assert sum("cases " in line and "computed in" in line for line in lines) == 4
    assert "cases 10 to 19: computed in" in lines[3]
    assert lines[3].endswith("1 quarantined")
    assert lines[-1].endswith("the run is complete")


def test_the_log_keeps_what_ended_a_run(tmp_path):
    def stop(done, total, quarantined):
        if done == 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        toy.run(tmp_path / "s", progress=stop)
    (log,) = (tmp_path / "s" / "log").glob("*.log")
    assert "WARNING interrupted; what is done is kept" in log.read_text()


def test_the_dashboard_is_announced(tmp_path):
    links = []
    toy.run(tmp_path / "s", on="local", workers=1, dashboard=links.append)
    assert links[0].startswith("http://127.0.0.1:")
    assert links[0].endswith("/status")
