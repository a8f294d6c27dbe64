import signal

import pytest
import toy

from wavequake.campaign.engine.driver_lock import Shard, shard_of
from wavequake.campaign.store.store import open_store
from wavequake.campaign.store.verify import verify_store
from wavequake.errors import UserError
from wavequake.workflows.run import run

SLOW = {"sleep_s": 0.02}


def finished(driver):
    out, err = driver.communicate(timeout=60)
    assert driver.returncode == 0, err
    return int(out)


def identical(path, other):
    assert toy.digests(path) == toy.digests(other)
    report = verify_store(path)
    assert report.ok, report.lines()
    assert report.extra == ()
    assert open_store(path).load().drop_attrs().identical(open_store(other).load().drop_attrs())


def test_shards_that_start_together_fill_one_store_with_the_bits_of_a_serial_run(tmp_path):
    drivers = [toy.driver(tmp_path / "s", {}, cases=67, chunk=5, shard=f"{i}/3") for i in range(3)]
    assert [finished(driver) for driver in drivers] == [25, 22, 20]  # 14 chunks, the last of 2 cases
    toy.run(tmp_path / "serial", cases=67, chunk=5)
    identical(tmp_path / "s", tmp_path / "serial")
    assert toy.records(tmp_path / "s") == 14
    assert toy.run(tmp_path / "s", cases=67, chunk=5).computed == 0


def test_a_shard_on_local_workers_counts_and_completes_its_own_chunks_only(tmp_path):
    calls = []
    options = {"poison": [3, 17]}
    summary = toy.run(
        tmp_path / "s", options, shard="1/2", on="local", workers=1, progress=lambda *c: calls.append(c)
    )
    assert (summary.done_before, summary.computed, summary.chunks, summary.quarantined) == (0, 20, 2, 1)
    assert (calls[0], calls[-1]) == ((0, 20, 0), (20, 20, 1))
    assert sorted(toy.digests(tmp_path / "s")) == [(10, 20), (30, 40)]
    assert toy.run(tmp_path / "s", options).computed == 20


def test_one_store_has_one_driver_per_shard_and_one_way_to_divide_it(tmp_path):
    slow = toy.driver(tmp_path / "s", SLOW, cases=2000, chunk=5, shard="1/3")
    try:
        toy.wait_for_records(tmp_path / "s", 1)

        def refused(words, cases=2000, **shard):
            with pytest.raises(UserError, match=words):
                toy.run(tmp_path / "s", SLOW, cases=cases, chunk=5, **shard)

        refused(rf"^Shard 1/3 of .* is in use by process {slow.pid} on ", shard="1/3")
        refused(rf"is in use by a run of shard 1/3, process {slow.pid} on ")
        refused(r"other shards \(1/3\), and yours is 0/2", shard="0/2")
        refused(r"computed to 2000 cases \(shard 1/3\): give all shards the same", cases=3000, shard="0/3")
        assert toy.run(tmp_path / "s", SLOW, cases=20, chunk=5, shard="0/3").computed == 10
        assert slow.poll() is None
    finally:
        slow.kill()
        slow.communicate()
    assert toy.run(tmp_path / "s", SLOW, cases=10, chunk=5, shard="0/2").computed == 0


def test_a_whole_run_keeps_shards_out(tmp_path):
    def meanwhile(*counts):
        with pytest.raises(UserError, match=r"is in use by process \d+ on "):
            toy.run(tmp_path / "s", shard="0/2")

    toy.run(tmp_path / "s", progress=meanwhile)
    assert not toy.run(tmp_path / "s", shard="0/2").computed


def test_a_killed_shard_goes_on_where_it_was_while_the_others_work(tmp_path):
    arguments = {"cases": 120, "chunk": 5}
    first, killed = (toy.driver(tmp_path / "s", SLOW, **arguments, shard=f"{i}/2") for i in range(2))
    toy.wait_for_records(tmp_path / "s", 4)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    done = sum(piece[0] // 5 % 2 for piece in toy.digests(tmp_path / "s"))
    again = toy.driver(tmp_path / "s", SLOW, **arguments, shard="1/2")
    assert finished(again) == 60 - 5 * done
    assert finished(first) == 60
    toy.run(tmp_path / "serial", SLOW, **arguments)
    identical(tmp_path / "s", tmp_path / "serial")


def test_sweeping_spares_what_other_shards_are_writing(tmp_path):
    toy.run(tmp_path / "s", SLOW, cases=200, chunk=5, shard="0/3")
    leftover = tmp_path / "s" / "data.zarr" / "strehl" / "c.1.partial"
    leftover.touch()
    slow = toy.driver(tmp_path / "s", SLOW, cases=200, chunk=5, shard="1/3")
    try:
        toy.wait_for_records(tmp_path / "s", 15)
        assert not leftover.exists()
        leftover.touch()
        toy.run(tmp_path / "s", SLOW, cases=200, chunk=5, shard="0/3")
        assert leftover.exists()
    finally:
        slow.kill()
        slow.communicate()


@pytest.mark.parametrize("text", ["2/2", "1", "-1/2", "0/0", "a/b", "1/2/3", "1 /2", ""])
def test_what_is_no_shard_is_refused(text):
    with pytest.raises(UserError, match="is no shard: write i/n, with i from 0 to n - 1"):
        shard_of(text)


def test_shards_are_counted_from_0_and_take_every_nth_chunk():
    assert shard_of("2/3") == Shard(2, 3)
    owners = [
        [shard.owns((first, first + 4), 4) for first in range(0, 24, 4)]
        for shard in map(Shard, (0, 1), (2, 2))
    ]
    assert owners == [[True, False] * 3, [False, True] * 3]


def test_a_goal_needs_all_cases(tmp_path):
    with pytest.raises(UserError, match=r"campaign\.until judges all cases together"):
        run("tmt18-history", store=tmp_path / "s", shard="0/2", campaign__until="wfe_rms.p95 ci<=2%")
    assert not (tmp_path / "s").exists()
