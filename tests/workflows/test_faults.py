"""Processes are killed in the middle of a campaign: nothing is lost, and no bit changes."""

import os
import shlex
import signal
import subprocess
import sys
import time

import numpy as np
import psutil
import pytest
import toy

from wavequake.campaign.store.store import create_store, open_store
from wavequake.campaign.store.verify import verify_store
from wavequake.errors import UserError

SLOW = {"sleep_s": 0.03}


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """Digests of the same cases computed in peace."""
    path = tmp_path_factory.mktemp("reference") / "s"
    toy.run(path, cases=100)
    return toy.digests(path)


def children_of(pid):
    return psutil.Process(pid).children(recursive=True)


def workers_of(pid):
    """Return the worker processes of a run, which the process that it has started forked."""
    servers = [one for one in psutil.Process(pid).children() if "forkserver" in " ".join(one.cmdline())]
    return [worker for one in servers for worker in one.children()]


def still_there(processes):
    _, alive = psutil.wait_procs(processes, timeout=5)
    return [process for process in alive if process.status() != psutil.STATUS_ZOMBIE]


def test_a_killed_worker_costs_nothing(tmp_path, reference):
    once = {"once": [25], "folder": str(tmp_path)}
    summary = toy.run(tmp_path / "s", once, on="local", workers=2)
    assert (tmp_path / "died-25").exists()
    assert (summary.computed, summary.quarantined) == (40, 0)
    assert (
        toy.records(tmp_path / "s") <= 5
    )  # the worker may take one result with it that it had not handed over
    found = toy.digests(tmp_path / "s")
    assert found == {chunk: reference[chunk] for chunk in found}


def test_a_killed_driver_leaves_no_workers_and_the_next_run_completes(tmp_path, reference):
    """What is begun twice was lost: a chunk of ten cases per worker at most."""
    begun = tmp_path / "begun"
    options = {**SLOW, "count": str(begun)}
    driver = toy.driver(tmp_path / "s", options, cases=100, on="local", workers=2)
    toy.wait_for_records(tmp_path / "s", 3)
    children = children_of(driver.pid)
    driver.kill()
    driver.communicate()
    assert not still_there(children)
    before = toy.records(tmp_path / "s")
    assert 3 <= before < 10
    summary = toy.run(tmp_path / "s", options, cases=100, on="local", workers=2)
    assert summary.done_before == 10 * before
    assert len(begun.read_text().split()) <= 100 + 10 * 2
    assert toy.records(tmp_path / "s") == 10  # no chunk has two records
    assert toy.digests(tmp_path / "s") == reference
    assert verify_store(tmp_path / "s").ok
    assert verify_store(tmp_path / "s").extra == ()


@pytest.mark.parametrize(
    ("keys", "place"),
    [({"reduce": "summary"}, {"on": "local", "workers": 2}), ({"every": 3}, {"on": "serial"})],
    ids=["summary, local", "every third, serial"],
)
def test_a_killed_campaign_that_keeps_less_goes_on_with_the_same_bits(tmp_path, keys, place):
    """Four instants: a summary of them, or the third alone; killed when three of ten chunks are recorded."""
    options = {**SLOW, "store": keys}
    driver = toy.driver(tmp_path / "killed", options, cases=100, **place)
    toy.wait_for_records(tmp_path / "killed", 3)
    driver.kill()
    driver.communicate()
    before = toy.records(tmp_path / "killed")
    assert 3 <= before < 10
    assert toy.run(tmp_path / "killed", options, cases=100, **place).done_before == 10 * before
    toy.run(tmp_path / "whole", {"store": keys}, cases=100)
    assert toy.digests(tmp_path / "killed") == toy.digests(tmp_path / "whole")
    report = verify_store(tmp_path / "killed")
    assert (report.ok, report.extra) == (True, ())
    killed, whole = open_store(tmp_path / "killed").load(), open_store(tmp_path / "whole").load()
    assert killed.drop_attrs().identical(whole.drop_attrs())
    draws = np.stack([toy.numbers(case) for case in range(100)])
    if "every" in keys:
        np.testing.assert_array_equal(killed["zernike"], draws[:, 2:3])
    else:
        expected = np.sqrt((draws**2).mean(axis=1))
        np.testing.assert_allclose(killed["zernike_rms"], expected, rtol=1e-14)


@pytest.mark.parametrize("whole_group", [True, False], ids=["terminal", "driver"])
def test_ctrl_c_ends_at_once_and_quietly_and_the_next_run_completes(tmp_path, reference, whole_group):
    driver = toy.driver(tmp_path / "s", SLOW, cases=100, on="local", workers=2)
    toy.wait_for_records(tmp_path / "s", 3)
    children = children_of(driver.pid)
    (os.killpg if whole_group else os.kill)(driver.pid, signal.SIGINT)
    said, complained = driver.communicate(timeout=20)
    assert (said, complained, driver.returncode) == ("interrupted\n", "", 0)
    assert not still_there(children)
    summary = toy.run(tmp_path / "s", SLOW, cases=100)
    assert 30 <= summary.done_before < 100
    assert toy.records(tmp_path / "s") == 10
    assert toy.digests(tmp_path / "s") == reference


def test_a_case_that_kills_its_process_is_quarantined_alone(tmp_path, reference):
    guilty = {"crash": [13], "poison": [15]}
    summary = toy.run(tmp_path / "s", guilty, on="local", workers=2)
    assert (summary.computed, summary.quarantined) == (40, 2)
    stored = open_store(tmp_path / "s").load()
    np.testing.assert_array_equal(stored.status, np.select([stored.case == 13, stored.case == 15], [3, 2], 1))
    assert stored.message.sel(case=13).item() == "the process that computed it was killed by SIGSEGV"
    assert np.isnan(stored.zernike.sel(case=13)).all()
    innocent = stored.isel(case=(stored.status == 1).values)
    np.testing.assert_array_equal(innocent.zernike, [toy.numbers(case) for case in innocent.case.values])
    found = toy.digests(tmp_path / "s")
    assert all(found[chunk] == reference[chunk] for chunk in found if chunk != (10, 20))


def test_a_torn_record_is_computed_again(tmp_path, reference):
    toy.run(tmp_path / "s")
    (file,) = (tmp_path / "s" / "done").glob("*.jsonl")
    file.write_text(file.read_text().rstrip("\n")[:-40])
    summary = toy.run(tmp_path / "s")
    assert (summary.done_before, summary.computed) == (30, 10)
    found = toy.digests(tmp_path / "s")
    assert found == {chunk: reference[chunk] for chunk in found}


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 3 MB."""
    (tmp_path / "disk").mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(tmp_path / "disk")]
    if subprocess.run(words, capture_output=True, check=False).returncode:
        pytest.skip("mounting a small disk needs root")
    yield tmp_path / "disk"
    subprocess.run(["umount", "--lazy", str(tmp_path / "disk")], check=True)


def test_a_disk_that_is_really_full_loses_nothing(tmp_path, small_disk):
    path, size = small_disk / "s", {"cases": 200, "chunk": 5}
    create_store(path, toy.TOY, toy.study(), 200, 5, "numpy", {})
    there = os.statvfs(small_disk)
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(there.f_bavail * there.f_frsize - 300_000))
    for where in ({"on": "local", "workers": 1}, {"on": "serial"}):
        with pytest.raises(UserError, match="is full: what is done is kept"):
            toy.run(path, **size, **where)
    report = verify_store(path)
    assert 5 < report.checked < 20
    assert report.damaged == ()
    ballast.unlink()
    assert toy.run(path, **size).done_before == 5 * report.checked
    toy.run(tmp_path / "whole", **size)
    assert toy.digests(path) == toy.digests(tmp_path / "whole")
    assert verify_store(path).ok


def test_what_workers_print_is_in_the_log_alone(tmp_path):
    """Case 3 kills its worker twice, and then a process of its own; case 35 kills its worker once.

    The driver says nothing but its result. A worker that is killed may hold a chunk that is done and not yet
    handed in: that one speaks again.
    """
    begun = tmp_path / "begun"
    options = {"say": [14, 27], "crash": [3], "once": [35], "folder": str(tmp_path), "count": str(begun)}
    driver = toy.driver(tmp_path / "s", options, on="local", workers=2)
    assert driver.communicate(timeout=180) == ("40\n", "")
    (file,) = (tmp_path / "s" / "log").iterdir()
    log = file.read_text()
    assert (tmp_path / "died-35").exists()
    times = sum(case in ("14", "27") for case in begun.read_text().split())
    assert times >= 2
    for words in ("a sentence of Python", r"\x1b[2Jlast words of C"):
        assert log.count(f"a worker said: {words}\n") == times, words
    assert "UserWarning: a warning of Python\n" in log  # once in each process
    assert log.count("ZeroDivisionError: division by zero") == times
    assert log.count("Fatal Python error: Segmentation fault") >= 3
    assert 'toy.py", line' in log
    assert log.endswith("the run is complete\n")


def test_words_of_a_killed_process_are_kept(tmp_path):
    """A worker that ends slowly is killed, and so is its buffer of what Python printed."""
    words = "from wavequake.cluster.output import redirect; redirect(); print('alive'); "
    words += "import os; os.kill(os.getpid(), 9)"
    environment = {**os.environ, "WAVEQUAKE_WORKER_OUTPUT": str(tmp_path)}
    subprocess.run([sys.executable, "-c", words], env=environment)
    (said,) = tmp_path.iterdir()
    assert said.read_text() == "alive\n"


@pytest.mark.parametrize("workers", [1, 2])
def test_a_scheduler_that_dies_ends_the_run_with_one_sentence(tmp_path, reference, workers):
    """What is begun twice was lost: a chunk of ten cases per worker at most."""
    host = (
        "import time\n"
        "from distributed import LocalCluster\n"
        "if __name__ == '__main__':\n"
        f"    with LocalCluster(n_workers={workers}, threads_per_worker=1, dashboard_address=None) as it:\n"
        "        print(it.scheduler_address, flush=True)\n"
        "        time.sleep(60)\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(
        [sys.executable, "-c", host], env=environment, stdout=subprocess.PIPE, text=True
    )
    address = process.stdout.readline().strip()
    begun = tmp_path / "begun"
    options = {**SLOW, "count": str(begun)}

    def kill(done, total, quarantined):
        if done == 20:
            process.kill()

    with pytest.raises(UserError, match="scheduler went away; what is done is kept"):
        toy.run(tmp_path / "s", options, cases=100, on=address, progress=kill)
    process.communicate()
    assert toy.run(tmp_path / "s", options, cases=100).done_before >= 20
    assert toy.digests(tmp_path / "s") == reference
    assert len(begun.read_text().split()) <= 100 + 10 * workers


@pytest.mark.parametrize(
    ("on", "sent"),
    [("local", (signal.SIGINT,) * 3), ("serial", (signal.SIGHUP,)), ("serial", (signal.SIGTERM,))],
    ids=["Ctrl-C thrice", "terminal closed", "job ended"],
)
def test_a_command_that_is_interrupted_says_how_to_resume(tmp_path, on, sent):
    words = ["run", "tmt18-history", "campaign.cases=5000", "optics.rays=300", "store.chunk_cases=4"]
    words += ["--on", on, "--workers", "1", "--store", str(tmp_path / "s")]
    process = subprocess.Popen(
        # SIGTERM comes through where a shell has made us ignore Ctrl-C.
        [
            "env",
            *(["--ignore-signal=INT"] * (signal.SIGTERM in sent)),
            sys.executable,
            "-m",
            "wavequake",
            *words,
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    toy.wait_for_records(tmp_path / "s", 1)
    children = children_of(process.pid)
    for number in sent:
        os.killpg(process.pid, number)
        time.sleep(0.05)
    _, complained = process.communicate(timeout=30)
    assert process.returncode == 130
    assert complained == (
        f"\nInterrupted. What is done is kept; to continue: wavequake {shlex.join(words)}\n"
    )
    assert not still_there(children)
    assert verify_store(tmp_path / "s").damaged == ()


def test_an_interruption_after_the_command_shows_no_traceback():
    script = (
        "import atexit, signal, sys, wavequake.cli as cli\n"
        "from wavequake.__main__ import main\n"
        "cli.app = lambda *words, **keys: sys.exit(0)\n"
        "atexit.register(signal.raise_signal, signal.SIGINT)\n"
        "sys.argv = ['wavequake', 'plan', 'x']\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def test_what_libraries_make_of_an_interruption_is_not_shown():
    script = (
        "import signal, sys, wavequake.cli as cli\n"
        "from wavequake.__main__ import main\n"
        "def load(*words, **keys):\n"
        "    try:\n"
        "        signal.raise_signal(signal.SIGINT)\n"
        "    except KeyboardInterrupt:\n"
        "        raise ImportError('initialization failed') from None\n"
        "cli.app = load\n"
        "sys.argv = ['wavequake', 'plan', 'x']\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 130
    assert done.stderr == "\nInterrupted. What is done is kept; to continue: wavequake plan x\n"
