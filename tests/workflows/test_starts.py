"""Runs that cannot start leave no store; runs that are hindered on the way lose nothing."""

import dataclasses
import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
import toy
from test_faults import workers_of

import wavequake
from wavequake.campaign.contract import StudyKind
from wavequake.campaign.engine import chunks
from wavequake.campaign.engine.driver import run_campaign
from wavequake.campaign.engine.rerun import retry_store
from wavequake.campaign.store import arrays, journal
from wavequake.campaign.store.status import store_status
from wavequake.campaign.store.verify import verify_store
from wavequake.cli import main
from wavequake.errors import UserError


def impossible(text, cases, device):
    raise UserError("no ray meets glass")


@pytest.mark.parametrize("there", [False, True], ids=["new folder", "empty folder"])
@pytest.mark.parametrize(
    ("compute", "where", "words"),
    [
        (toy.compute, {"on": "tcp://127.0.0.1:1"}, "No Dask scheduler answers"),
        (impossible, {"on": "serial"}, "no ray meets glass"),
    ],
    ids=["no scheduler", "impossible"],
)
def test_a_run_that_cannot_start_leaves_no_store(tmp_path, monkeypatch, there, compute, where, words):
    from wavequake.cluster import places

    connected = places.connected
    monkeypatch.setattr(places, "connected", lambda address, **more: connected(address, 0.2, **more))
    path = tmp_path / "s"
    if there:
        path.mkdir()
    workflow = StudyKind("toy", toy.template, toy.case_table, compute)
    with pytest.raises(UserError, match=words):
        run_campaign(workflow, toy.study(), path, cases=20, chunk=10, device="numpy", **where)
    assert path.exists() == there
    assert not there or not list(path.iterdir())
    toy.run(path, cases=20)
    with pytest.raises(UserError, match=words):  # what was there stays
        run_campaign(
            workflow, toy.study(), path, cases=30, chunk=10, device="numpy", allow_mixed=True, **where
        )
    assert toy.run(path, cases=30).done_before == 20


def test_a_store_in_which_something_is_computed_stays(tmp_path):
    def stop(done, total, quarantined):
        if done == 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        toy.run(tmp_path / "s", progress=stop)
    assert toy.run(tmp_path / "s").done_before == 20


@pytest.mark.parametrize(
    ("command", "study"),
    [
        ("run", "tmt18-history"),
        ("sensitivity", "tmt-18"),
        ("budget", "tmt-segments"),
        ("rare", "tmt-rare"),
    ],
)
def test_an_empty_name_of_a_store_is_refused(tmp_path, monkeypatch, capsys, command, study):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["wavequake", command, study, "--store", ""])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    assert capsys.readouterr().err.startswith("Error: --store is empty")
    assert not list(tmp_path.iterdir())


def test_a_disk_without_files_left_loses_nothing(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=9m,nr_inodes=120", "tmpfs", str(disk)]
    if subprocess.run(words, capture_output=True, check=False).returncode:
        pytest.skip("mounting a small disk needs root")
    try:
        with pytest.raises(UserError, match="is full: what is done is kept"):
            toy.run(disk / "s", cases=200, chunk=5)
        report = verify_store(disk / "s")
        assert report.checked > 2
        assert report.damaged == ()
        subprocess.run(["mount", "-o", "remount,nr_inodes=2000", str(disk)], check=True)
        assert toy.run(disk / "s", cases=200, chunk=5).done_before == 5 * report.checked
        assert verify_store(disk / "s").ok
    finally:
        subprocess.run(["umount", "--lazy", str(disk)], check=True)


@pytest.mark.parametrize("what", ["data", "journal"])
def test_a_disk_that_becomes_read_only_ends_the_run_and_loses_nothing(tmp_path, monkeypatch, what):
    put, record = arrays._put, journal.append
    left = [2]

    def fail():
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    def put_or_fail(path, parts):
        if path.name == "c.1":
            fail()
        put(path, parts)

    def record_or_fail(folder, entry):
        fail()
        record(folder, entry)

    if what == "data":
        monkeypatch.setattr(arrays, "_put", put_or_fail)
        left[0] = 0
    else:
        monkeypatch.setattr(journal, "append", record_or_fail)
    with pytest.raises(UserError, match=r"cannot be written \(read-only file system\)"):
        toy.run(tmp_path / "s")
    monkeypatch.undo()
    done = 10 if what == "data" else 20
    assert toy.run(tmp_path / "s").done_before == done
    assert verify_store(tmp_path / "s").ok


@pytest.mark.parametrize("where", [{"on": "serial"}, {"on": "local", "workers": 2}], ids=["serial", "local"])
def test_a_disk_that_is_really_read_only_from_now_on_loses_nothing(tmp_path, where):
    """A mount over the store shows it read-only; what is open stays so, as on a disk that fails."""
    path = tmp_path / "s"
    options = {"sleep_s": 0.02}

    def protect(done, total, quarantined):
        if done == 20:
            for words in (["--bind", path, path], ["-o", "remount,bind,ro", path]):
                subprocess.run(["mount", *map(str, words)], check=True, capture_output=True)

    toy.run(path, options, cases=10)
    try:
        with pytest.raises(UserError, match=r"cannot be written \(read-only file system\)"):
            toy.run(path, options, cases=100, progress=protect, **where)
    except subprocess.CalledProcessError:
        pytest.skip("mounting needs root")
    finally:
        subprocess.run(["umount", "--lazy", str(path)], check=False, capture_output=True)
    assert toy.run(path, options, cases=100).done_before >= 20
    toy.run(tmp_path / "whole", options, cases=100)
    assert toy.digests(path) == toy.digests(tmp_path / "whole")
    assert verify_store(path).ok


def test_a_store_goes_on_with_another_version_if_that_is_allowed(tmp_path):
    """A copy of the package, in which one line of what makes numbers has changed."""
    path, other = tmp_path / "s", tmp_path / "other"
    root = Path(wavequake.__file__).parents[2]
    shutil.copytree(root / "pipeline", other / "pipeline", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("kernels", "workflows", "cluster", "firmware"):
        (other / name).symlink_to(root / name)
    with (other / "pipeline/wavequake/optics/checks.py").open("a") as file:
        file.write("# another version\n")
    toy.run(path, cases=40)

    def resume(allow_mixed):
        script = f"import toy; print(toy.run({str(path)!r}, cases=60, allow_mixed={allow_mixed}).computed)"
        where = os.pathsep.join([str(other / "pipeline"), *sys.path])
        return subprocess.run(
            [sys.executable, "-c", script],
            env={**os.environ, "PYTHONPATH": where},
            capture_output=True,
            text=True,
            check=False,
        )

    assert "was begun by wavequake" in resume(False).stderr
    assert toy.records(path) == 4
    assert resume(True).stdout == "20\n"
    assert sorted(store_status(path).codes.values()) == [2, 4]
    toy.run(tmp_path / "whole", cases=60)
    assert toy.digests(path) == toy.digests(tmp_path / "whole")
    assert verify_store(path).ok


def test_a_clock_that_jumps_back_takes_no_later_result_away(tmp_path, monkeypatch):
    path, append = tmp_path / "s", journal.append
    now = [4e9]
    monkeypatch.setattr(
        chunks.journal,
        "append",
        lambda folder, record: append(folder, dataclasses.replace(record, time=now[0])),
    )
    cured = tmp_path / "cured"

    def compute(text, cases, device):
        if 15 in cases and not cured.exists():
            raise ValueError("not yet")
        return toy.compute(text, cases, device)

    workflow = StudyKind("toy", toy.template, toy.case_table, compute)
    run_campaign(workflow, toy.study(), path, cases=20, chunk=10, device="numpy", on="serial")
    assert store_status(path).quarantined == 1
    cured.touch()
    now[0] = 1e9
    assert retry_store(workflow, path, frozenset({2}), on="serial").quarantined == 0
    assert store_status(path).quarantined == 0
    assert verify_store(path).ok


def test_a_worker_that_is_stopped_for_a_while_goes_on(tmp_path):
    """For 40 s in `make soak`, longer than Dask waits for connections."""
    driver = toy.driver(tmp_path / "s", {"sleep_s": 0.02}, cases=100, on="local", workers=2)
    try:
        toy.wait_for_records(tmp_path / "s", 2)
        workers = workers_of(driver.pid)
        psutil.Process(workers[0].pid).send_signal(signal.SIGSTOP)
        time.sleep(float(os.environ.get("STOPPED_S", "2")))
        psutil.Process(workers[0].pid).send_signal(signal.SIGCONT)
        said, complained = driver.communicate(timeout=120)
        assert (said, complained) == ("100\n", "")
    finally:
        driver.kill()
        driver.communicate()
    toy.run(tmp_path / "whole", {"sleep_s": 0.02}, cases=100)
    assert toy.digests(tmp_path / "s") == toy.digests(tmp_path / "whole")
    assert verify_store(tmp_path / "s").ok
