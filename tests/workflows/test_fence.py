"""Writers of earlier runs are shut out, whatever they hold and whenever they wake."""

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import toy

from wavequake.campaign.engine.chunks import computed_chunk, store_chunk
from wavequake.campaign.store import arrays, fence, journal
from wavequake.campaign.store.fence import Fence, ShutOutError, admits, begin, read_fence, shut, writing
from wavequake.campaign.store.journal import read_journal
from wavequake.campaign.store.store import open_store
from wavequake.campaign.store.verify import verify_store
from wavequake.errors import UserError


@pytest.fixture
def stale(tmp_path):
    """A store of 60 cases, and what a worker holds of the run that gave it 57: its job and a chunk."""
    path = tmp_path / "s"
    toy.run(path, cases=57, chunk=10)
    job = toy.job(path)
    answer = computed_chunk(job, 50, 57)
    toy.run(path, cases=60)
    return path, job, answer


def test_a_late_worker_of_an_earlier_run_changes_nothing(stale):
    path, job, answer = stale
    with pytest.raises(ShutOutError, match="another run has begun to compute it"):
        store_chunk(job, (50, 57), *answer)
    assert verify_store(path).ok
    np.testing.assert_array_equal(open_store(path).zernike[57:], [toy.numbers(i) for i in (57, 58, 59)])


@pytest.mark.parametrize("locks", [True, False], ids=["locks", "no locks"])
def test_a_worker_that_is_overtaken_as_it_writes_records_nothing(tmp_path, monkeypatch, locks):
    """Where there are no locks a worker may be overtaken between its question and its record."""
    toy.run(tmp_path / "s", cases=57, chunk=10)
    job = toy.job(tmp_path / "s")
    answer, write = computed_chunk(job, 50, 57), arrays.write_chunk
    before = toy.records(tmp_path / "s")
    if not locks:
        monkeypatch.setattr(fence.fcntl, "fcntl", lambda *_: (_ for _ in ()).throw(OSError(95, "none")))

    def overtaken(*arguments):
        digests = write(*arguments)
        begin(tmp_path / "s", "", (), 0, wait_s=0.05)
        return digests

    monkeypatch.setattr("wavequake.campaign.engine.chunks.write_chunk", overtaken)
    words = "is being written by a process of an earlier run" if locks else "another run has begun"
    with pytest.raises(UserError, match=words):
        store_chunk(job, (50, 57), *answer)
    assert toy.records(tmp_path / "s") == before


def test_a_run_waits_for_writers_and_writers_for_nobody(tmp_path):
    inside, go_on = threading.Event(), threading.Event()

    def write():
        with writing(tmp_path, 0), writing(tmp_path, 10):
            inside.set()
            go_on.wait(10)

    writer = threading.Thread(target=write)
    writer.start()
    inside.wait(10)
    with pytest.raises(UserError, match="perhaps because it is stopped"):
        begin(tmp_path, "", (), 0, wait_s=0.05)
    go_on.set()
    assert begin(tmp_path, "", (), 0).epoch == 1
    writer.join()


def test_shards_that_work_together_admit_each_other_and_nobody_else():
    first = shut(Fence(4, {"": "old"}), "0/2", [], "a")
    both = shut(first, "1/2", ["0/2"], "b")
    assert [admits(both, token) for token in ("old", "a", "b")] == [False, True, True]
    again = shut(both, "0/2", ["1/2"], "c")
    assert [admits(again, token) for token in ("a", "b", "c")] == [False, True, True]
    assert again.epoch == 7
    whole = shut(again, "", [], "d")
    assert whole.runs == {"": "d"}
    renewed = shut(again, "1/2", None, "e")
    assert [admits(renewed, token) for token in ("b", "c", "e")] == [False, True, True]


@pytest.mark.parametrize("content", [b"", b"{", b'{"epoch":0}', b'{"epoch":"9","runs":{}}', b"[" * 10**5])
def test_a_lost_fence_is_made_anew_beyond_all_records(tmp_path, content):
    path = tmp_path / "s"
    for cases in (20, 30, 40):
        toy.run(path, cases=cases)
    epoch = max(record.epoch for record in read_journal(path / "done").records.values())
    (path / "fence.json").write_bytes(content)
    toy.run(path, cases=50)
    assert read_journal(path / "done").records[40, 50].epoch > epoch >= 3


def test_a_short_record_that_came_last_takes_the_longer_one_away(tmp_path):
    """As versions did whose writers were not shut out, or file systems without locks allow at the worst."""
    path = tmp_path / "s"
    toy.run(path, cases=57, chunk=10)
    short = read_journal(path / "done").records[50, 57]
    toy.run(path, cases=60)
    late = dataclasses.replace(short, epoch=read_fence(path).epoch, time=0.0)  # by a clock that was wrong
    journal.append(path / "done", late)
    assert toy.run(path, cases=60).computed == 10
    assert toy.run(path, cases=60).computed == 0
    assert verify_store(path).ok


WORKER = """
import sys, time
import toy
from pathlib import Path
from wavequake.campaign.engine.chunks import computed_chunk, store_chunk
job = toy.job(Path(sys.argv[1]))
answer = computed_chunk(job, 50, 57)
print("ready", flush=True)
sys.stdin.readline()
try:
    store_chunk(job, (50, 57), *answer)
    print("written")
except Exception as error:
    print(type(error).__name__)
"""


def test_a_process_that_was_stopped_wakes_to_no_harm(tmp_path):
    path = tmp_path / "s"
    toy.run(path, cases=57, chunk=10)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    words = [sys.executable, "-c", WORKER, str(path)]
    with subprocess.Popen(words, env=environment, text=True, **pipes) as worker:
        assert worker.stdout.readline() == "ready\n"
        worker.send_signal(signal.SIGSTOP)
        worker.stdin.write("\n")
        worker.stdin.flush()
        toy.run(path, cases=60)
        before = toy.digests(path)
        worker.send_signal(signal.SIGCONT)
        assert worker.communicate(timeout=60)[0] == "ShutOutError\n"
    assert toy.digests(path) == before
    assert verify_store(path).ok


def test_a_store_that_is_moved_leaves_nothing_where_it_was(tmp_path):
    path, there = tmp_path / "s", tmp_path / "there"

    def move(done, total, quarantined):
        if done == 20:
            shutil.move(path, there)

    with pytest.raises(UserError, match="no longer there"):
        toy.run(path, progress=move)
    assert not path.exists()
    assert toy.run(there).done_before == 20


def test_workers_of_a_store_that_is_moved_leave_nothing_where_it_was(tmp_path):
    path, there = tmp_path / "s", tmp_path / "there"

    def move(done, total, quarantined):
        if done == 20:
            shutil.move(path, there)

    with pytest.raises(UserError, match=r"no longer there|moved or deleted"):
        toy.run(path, {"sleep_s": 0.02}, cases=100, on="local", workers=2, progress=move)
    time.sleep(0.3)
    assert not path.exists()
    assert toy.run(there, {"sleep_s": 0.02}, cases=100).done_before >= 20


def test_two_writers_of_one_chunk_take_turns_and_the_first_record_of_a_run_stands(tmp_path):
    """As when a worker was believed to be lost, and its chunk fared otherwise on the next one."""
    path = tmp_path / "s"
    toy.run(path, cases=20)
    job = toy.job(path)
    result, seconds = computed_chunk(job, 10, 20)
    other = dataclasses.replace(result, status=np.full(10, 2, dtype=np.int8))
    with (
        writing(path, 10),
        pytest.raises(UserError, match="perhaps because it is stopped"),
        fence._locked(path, (10, 1), 0.05),
    ):
        pass
    assert store_chunk(job, (10, 20), other, seconds).quarantined == 10
    assert store_chunk(job, (10, 20), result, seconds).quarantined == 10
    assert toy.records(path) == 3
    assert verify_store(path).ok
