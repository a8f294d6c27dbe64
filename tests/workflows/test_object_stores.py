"""Campaigns whose store is in object storage: kills, late writers, lost answers; moto's S3 is the server."""

import os
import random
import signal
import subprocess
import sys
import threading
import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import boto3
import numpy as np
import psutil
import pytest
import toy
import xarray as xr

from wavequake.campaign.engine.chunks import computed_chunk, store_chunk
from wavequake.campaign.store import lease, objects
from wavequake.campaign.store.fence import ShutOutError
from wavequake.campaign.store.journal import read_journal
from wavequake.campaign.store.objects import location
from wavequake.campaign.store.status import store_status
from wavequake.campaign.store.store import open_store
from wavequake.campaign.store.verify import verify_store
from wavequake.errors import UserError

SERVER = Path(__file__).with_name("object_server.py")
SECRET = "a-key-that-nobody-may-read"
CHUNK = 5
QUICK = "from wavequake.campaign.store import lease; lease.BEAT_S, lease.EXPIRY_S = 0.5, 4.0\n"


@pytest.fixture(scope="module", autouse=True)
def bucket():
    server = subprocess.Popen(
        [sys.executable, SERVER], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{int(server.stdout.readline())}")
        patch.setenv("AWS_ACCESS_KEY_ID", "somebody")
        patch.setenv("AWS_SECRET_ACCESS_KEY", SECRET)
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        patch.setattr(lease, "BEAT_S", 0.5)
        patch.setattr(lease, "EXPIRY_S", 4.0)
        boto3.client("s3").create_bucket(Bucket="campaigns")
        yield
    server.kill()
    server.communicate()


@pytest.fixture
def path():
    return location(f"s3://campaigns/{uuid.uuid4().hex}/store")


def identical(path, other):
    """The numbers, labels and attributes of two stores, and what their journals say of them."""
    report = verify_store(path)
    assert report.ok, report.lines()
    assert toy.digests(path) == toy.digests(other)
    assert open_store(path).load().drop_attrs().identical(open_store(other).load().drop_attrs())


def everything(path):
    return {file: file.read_bytes() for file in objects.sizes(path)}


# --- the steps that everything else rests on


def test_of_many_writers_one_creates_and_none_loses_a_change(path):
    names = path / "names"

    def add(i):
        objects.change(names, lambda old: b"%s%d " % (old or b"", i))

    with ThreadPoolExecutor(8) as pool:
        won = list(pool.map(lambda i: objects.put(path / "one", b"%d" % i, None), range(8)))
        assert sum(won) == 1
        assert (path / "one").read_bytes() == b"%d" % won.index(True)
        list(pool.map(add, range(16)))
    assert sorted(map(int, names.read_bytes().split())) == list(range(16))


def test_addresses_are_kept_whole_and_are_no_folders_of_this_machine(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    store = location("s3://campaigns/a/b")
    assert str(store / "c") == "s3://campaigns/a/b/c"
    assert (
        str(location(Path("s3://campaigns/a/b")))
        == str(location(store))
        == str(store.absolute())
        == str(store)
    )
    assert (store.bucket, (store / "c").key) == ("campaigns", "a/b/c")
    assert not isinstance(location("runs/s3"), objects.ObjectPath)
    with pytest.raises(UserError, match="is in object storage, where this cannot be"):
        os.stat(store)
    with pytest.raises(UserError, match="names no store: write s3://BUCKET/PREFIX"):
        location("s3://campaigns")
    store.mkdir(parents=True)
    assert not list(tmp_path.iterdir())


# --- a campaign


def test_a_campaign_has_the_bits_of_a_folder_and_what_reads_stores_reads_it(path, tmp_path):
    options = {"reasons": [3], "poison": [16]}
    for place in (path, tmp_path / "s"):
        toy.run(place, options, cases=17)
        summary = toy.run(place, options, cases=23)
        assert (summary.computed, summary.again, summary.quarantined) == (13, 7, 2)
        assert toy.run(place, options, cases=23).computed == 0
    identical(path, tmp_path / "s")
    assert store_status(path).counts == store_status(tmp_path / "s").counts
    for file in (tmp_path / "s" / "data.zarr").rglob("*"):
        if file.is_file() and file.parent.name not in ("message", "data.zarr"):
            assert (path / file.relative_to(tmp_path / "s")).read_bytes() == file.read_bytes(), file
    plain = xr.open_zarr(f"{path}/data.zarr", storage_options={"use_listings_cache": False})
    np.testing.assert_array_equal(plain.zernike[22], toy.numbers(22))
    assert any(
        b"the run is complete" in text for file, text in everything(path).items() if file.suffix == ".log"
    )
    assert not any(SECRET.encode() in text for text in everything(path).values())


def test_what_is_lost_or_damaged_is_found_and_mended(path, tmp_path):
    toy.run(path, cases=20)
    toy.run(tmp_path / "s", cases=20)
    (path / "data.zarr" / "strehl" / "c.1").unlink()
    assert [str(one.file) for one in verify_store(path).damaged] == [f"{path}/data.zarr/strehl/c.1"]
    assert toy.run(path, cases=20).computed == 10
    (path / "data.zarr" / "count" / "c.0").write_bytes(b"nonsense")
    (path / "data.zarr" / "noll" / "zarr.json").unlink()
    report = verify_store(path)
    assert len(report.damaged) == 1
    assert len(report.layout) == 1
    assert toy.run(path, cases=20, repair=True).computed == 10
    identical(path, tmp_path / "s")


def test_a_run_that_cannot_start_leaves_nothing(path):
    with pytest.raises(UserError, match=r"tcp://127\.0\.0\.1:9"):
        toy.run(path, on="tcp://127.0.0.1:9")
    assert [file.name for file in everything(path)] == ["lock"]  # which says that nobody holds it


# --- deaths, and answers that are lost


class Died(BaseException):
    """Of a process, at a request."""


def requests_of(monkeypatch, act):
    """Have `act(number, send)` send every request from now on."""
    count, call = iter(range(10**9)), objects._call

    async def counted(*arguments, **keywords):
        return await act(next(count), lambda: call(*arguments, **keywords))

    monkeypatch.setattr(objects, "_call", counted)
    return count


def test_no_death_at_any_request_loses_or_changes_anything(path, tmp_path, monkeypatch):
    small = {"cases": 7, "chunk": CHUNK}
    survived = 0
    toy.run(tmp_path / "s", **small)
    monkeypatch.setattr(lease, "alive", lambda path, holders: set())  # who died is known to be dead
    monkeypatch.setattr(lease, "BEAT_S", 3600.0)
    with monkeypatch.context() as patch:
        count = requests_of(patch, lambda number, send: send())
        toy.run(path / "peace", **small)
        requests = next(count)
    generator = random.Random(24)
    for trial in range(8):
        last = generator.randrange(requests)
        died_after = generator.random() < 0.5

        async def act(number, send, last=last, died_after=died_after):
            if number == last and died_after:
                await send()
            if number >= last:
                raise Died
            return await send()

        with monkeypatch.context() as patch, suppress(Died):  # it may have had less to do than the first run
            requests_of(patch, act)
            toy.run(path / str(trial % 2), **small)
            survived += 1
    assert survived < 4
    for store in range(2):
        toy.run(path / str(store), **small)
        identical(path / str(store), tmp_path / "s")


def test_answers_that_are_lost_are_no_harm(path, tmp_path, monkeypatch):
    """A client sends again what had no answer, and is told that its own write is somebody else's."""

    async def twice(number, send):
        await send()
        return await send()

    toy.run(tmp_path / "s", cases=20)
    requests_of(monkeypatch, twice)
    toy.run(path, cases=20)
    monkeypatch.undo()
    identical(path, tmp_path / "s")
    assert len(list((path / "done").glob("*.jsonl"))) == 2


def driver(path, seconds, **keywords):
    """Start a campaign in a process of its own whose leases end soon."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    call = f"toy.run({str(path)!r}, {{'sleep_s': {seconds}}}, **{keywords!r})"
    words = [sys.executable, "-c", f"{QUICK}import toy\nif __name__ == '__main__':\n    {call}\n"]
    nothing = subprocess.DEVNULL
    return subprocess.Popen(words, env=environment, stdout=nothing, stderr=nothing, start_new_session=True)


def test_four_writers_that_are_killed_lose_nothing(path, tmp_path):
    """Two of four workers, and then the driver with all others, at moments that a seed draws."""
    generator = random.Random(4)
    cases, seconds = 60, 0.02
    running = driver(path, seconds, cases=cases, chunk=CHUNK, on="local", workers=4)
    wait_for_chunks(path, 2)
    workers = [one for one in psutil.Process(running.pid).children(recursive=True) if one.children() == []]
    for worker in generator.sample(workers, 2):
        worker.send_signal(signal.SIGKILL)
        time.sleep(generator.uniform(0.0, 0.2))
    wait_for_chunks(path, generator.randrange(4, 8))
    for one in [*psutil.Process(running.pid).children(recursive=True), running]:
        one.kill()
    running.wait()
    records = read_journal(path / "done").records
    done = sum(last - first for first, last in records)
    assert 0 < done < cases
    assert not any(record.quarantined for record in records.values())
    options = {"sleep_s": seconds}
    assert toy.run(path, options, cases=cases, chunk=CHUNK).done_before == done
    toy.run(tmp_path / "s", options, cases=cases, chunk=CHUNK)
    identical(path, tmp_path / "s")


def wait_for_chunks(path, count):
    end = time.monotonic() + 120
    while len(list((path / "done").glob("*.jsonl"))) < count:
        assert time.monotonic() < end
        time.sleep(0.2)


def test_shards_fill_a_store_together_at_the_same_time(path, tmp_path):
    running = [driver(path, 0.02, cases=37, chunk=CHUNK, shard=f"{i}/3") for i in range(3)]
    assert [one.wait(120) for one in running] == [0] * 3
    toy.run(tmp_path / "s", {"sleep_s": 0.02}, cases=37, chunk=CHUNK)
    identical(path, tmp_path / "s")


# --- writers that are late


@pytest.fixture
def stale(path):
    """A store of 17 cases, and what a worker holds of a run: its job and a chunk with other numbers."""
    toy.run(path, cases=17)
    job = toy.job(path)
    result, seconds = computed_chunk(job, 10, 17)
    result.arrays["zernike"][:] += 1.0  # by a machine that computes wrong
    return job, result, seconds


def test_a_late_worker_of_an_earlier_run_changes_nothing(path, stale):
    toy.run(path, cases=20)
    before = everything(path)
    with pytest.raises(ShutOutError, match="another run has begun to compute it"):
        store_chunk(stale[0], (10, 17), *stale[1:])
    assert everything(path) == before


@pytest.mark.parametrize("conditional", [True, False])
def test_a_worker_that_is_stopped_in_the_middle_of_a_write_overwrites_nothing(
    path, stale, monkeypatch, conditional
):
    """It was admitted, looked and was about to write as a later run came: only the condition is left."""
    put = objects._put_all

    def stopped(contents, before):
        if any(file.parent.name == "zernike" for file in contents):
            monkeypatch.setattr(objects, "_put_all", put)
            toy.run(path, cases=20)
            if not conditional:
                before = objects.versions(list(contents))
        return put(contents, before)

    monkeypatch.setattr(objects, "_put_all", stopped)
    with pytest.raises(ShutOutError):
        store_chunk(stale[0], (10, 17), *stale[1:])
    assert verify_store(path).ok is conditional  # else this test could not fail
    if conditional:
        np.testing.assert_array_equal(open_store(path).zernike[10:], [toy.numbers(i) for i in range(10, 20)])


def test_of_two_workers_at_one_chunk_the_later_one_has_it(path, monkeypatch):
    """As where a worker is believed to be lost: what it goes on to write, the other one writes over."""
    toy.run(path, cases=17)
    for file in objects.sizes(path, "*10-17*") | objects.sizes(path, "c.1*"):
        file.unlink()
    job = toy.job(path)
    first, second = (computed_chunk(job, 10, 17) for _ in range(2))
    first[0].arrays["zernike"][:] += 1.0
    put = objects._put_all

    def overtaken(contents, before):
        if any(file.parent.name == "zernike" for file in contents):
            monkeypatch.setattr(objects, "_put_all", put)
            store_chunk(job, (10, 17), *second)
        return put(contents, before)

    monkeypatch.setattr(objects, "_put_all", overtaken)
    with pytest.raises(ShutOutError, match="another worker of this run"):
        store_chunk(job, (10, 17), *first)
    assert verify_store(path).ok
    np.testing.assert_array_equal(open_store(path).zernike[10:], [toy.numbers(i) for i in range(10, 17)])


# --- who is at work


def test_a_store_in_use_is_refused_and_one_whose_run_died_is_taken_over(path, monkeypatch):
    def refused(*counts):
        with pytest.raises(UserError, match=rf"is in use by process {os.getpid()} on .*: wait for it"):
            toy.run(path)
        with pytest.raises(UserError, match=rf"is in use by process {os.getpid()} on "):
            toy.run(path, shard="0/2")

    toy.run(path, cases=10, progress=refused)
    with lease.held(path, "0/2", "a run of shard 0/2") as (_, setup):
        setup.close()
        with pytest.raises(UserError, match=r"other shards \(0/2\), and yours is 1/3"):
            toy.run(path, shard="1/3")
        with pytest.raises(UserError, match="in use by a run of shard 0/2"):
            toy.run(path, shard="0/2")
    with monkeypatch.context() as patch:
        patch.setattr(lease, "_leave", lambda *_: None)
        toy.run(path, cases=10)  # and then it dies, as the table says nothing of its end
    assert len(lease.read_table((path / "lock").read_bytes()).holders) == 1
    assert toy.run(path, cases=20).computed == 10


def test_heartbeats_end_with_the_run(path):
    toy.run(path, cases=10)
    assert not list((path / "beats").glob("*"))
    assert not [thread for thread in threading.enumerate() if thread.name == "heartbeat"]


# --- what is said


def test_what_cannot_work_is_said_in_a_sentence(path, monkeypatch):
    with pytest.raises(UserError, match="there is no bucket 'nowhere'; make it first"):
        toy.run(location("s3://nowhere/store"))
    with pytest.raises(UserError, match=f"There is no store at {path}"):
        verify_store(path)
    (path / "letter.txt").write_bytes(b"of somebody else")
    with pytest.raises(UserError, match=r"is not a store: it holds 'letter.txt'"):
        toy.run(path)
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(UserError, match=r"need s3fs: pip install s3fs"):
        toy.run(path)
