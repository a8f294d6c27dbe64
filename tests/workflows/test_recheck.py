"""A share of the chunks is computed again: a machine that computes wrong is named, and its chunks redone."""

import dataclasses

import pytest
import toy
from hypothesis import given
from hypothesis import strategies as st

from wavequake.campaign.engine.plan import share_of
from wavequake.campaign.engine.recheck import Answer, drawn, to_redo, wrong_process
from wavequake.campaign.store.journal import Record, append, read_journal
from wavequake.campaign.store.verify import verify_store
from wavequake.errors import StoreDamageError, UserError


def test_what_is_right_is_left_alone(tmp_path):
    toy.run(tmp_path / "s", cases=40)
    before = toy.records(tmp_path / "s")
    summary = toy.run(tmp_path / "s", cases=40, recheck=0.5)
    assert summary.rechecked == ("2 chunks of 4 computed again by other processes: not a bit differs",)
    assert toy.records(tmp_path / "s") == before


def test_cases_that_kill_their_process_are_not_tried_again(tmp_path):
    options = {"crash": [13]}
    arguments = {"cases": 40, "on": "local", "workers": 2}
    assert toy.run(tmp_path / "s", options, **arguments).quarantined == 1
    told = toy.run(tmp_path / "s", options, recheck=1.0, **arguments).rechecked
    assert told == ("3 chunks of 4 computed again by other processes: not a bit differs",)


def test_a_worker_that_computes_wrong_is_named_and_its_chunks_are_redone(tmp_path):
    options = {"liar": str(tmp_path), "sleep_s": 0.01}
    summary = toy.run(tmp_path / "s", options, cases=80, on="local", workers=2, recheck=1.0)
    liar = int((tmp_path / "liar").read_text())
    assert f"process {liar} on " in summary.rechecked[1]
    assert "computes wrong" in summary.rechecked[1]
    records = read_journal(tmp_path / "s" / "done").records.values()
    assert {record.pid for record in records}.isdisjoint({liar})
    assert verify_store(tmp_path / "s").ok
    toy.run(tmp_path / "right", cases=80)
    assert toy.digests(tmp_path / "s") == toy.digests(tmp_path / "right")


def test_a_serial_run_that_computed_wrong_is_found_by_a_process_of_its_own(tmp_path):
    options = {"liar": str(tmp_path)}
    summary = toy.run(tmp_path / "s", options, cases=20, recheck=0.5)
    assert "computes wrong" in summary.rechecked[1]
    toy.run(tmp_path / "right", cases=20)
    found, right = toy.digests(tmp_path / "s"), toy.digests(tmp_path / "right")
    assert found == right


def test_a_record_that_was_forged_is_redone(tmp_path):
    toy.run(tmp_path / "s", cases=20)
    record = read_journal(tmp_path / "s" / "done").records[0, 10]
    forged = {**record.digests, "strehl": "0" * 32}
    append(
        tmp_path / "s" / "done",
        dataclasses.replace(record, digests=forged, pid=1, settles=True, epoch=record.epoch + 1),
    )
    assert not verify_store(tmp_path / "s").ok
    assert "process 1 on" in toy.run(tmp_path / "s", cases=20, recheck=1.0).rechecked[1]
    assert verify_store(tmp_path / "s").ok


RIGHT, WRONG = {"zernike": "a", "status": "s"}, {"zernike": "b", "status": "s"}


def test_the_majority_of_three_is_right():
    record = Record(0, 10, RIGHT, (0, 10, 0, 0, 0, 0), {}, host="h", pid=1)
    right, wrong = (Answer((0, 10), digests, ("h", 2)) for digests in (RIGHT, WRONG))
    assert wrong_process(record, right, wrong) is None
    assert wrong_process(record, wrong, right) == ("h", 2)
    assert wrong_process(dataclasses.replace(record, digests=WRONG), right, right) == ("h", 1)
    other = Answer((0, 10), {"zernike": "c", "status": "s"}, ("h", 3))
    with pytest.raises(StoreDamageError, match="three ways, by process 1 on h, by process 2 on h"):
        wrong_process(record, wrong, other)
    assert to_redo({(0, 10): record}, {("h", 1)}) == [(0, 10)]
    assert to_redo({(0, 10): record}, {("g", 1), ("h", 2)}) == []


@given(st.integers(1, 300), st.floats(1e-6, 1.0), st.text())
def test_a_share_is_drawn_by_lot_and_is_the_same_again(count, share, seed):
    pieces = [(10 * i, 10 * i + 10) for i in range(count)]
    found = drawn(pieces, share, seed)
    assert len(found) == min(count, max(1, round(share * count)))
    assert found == drawn(pieces[::-1], share, seed)
    assert set(found) <= set(pieces)
    assert drawn(pieces, 0.0, seed) == []


def test_a_share_is_read():
    assert [share_of(text) for text in ("1%", "0.01", "100 %", "0", ".5%")] == [0.01, 0.01, 1.0, 0.0, 0.005]
    for text in ("", "-1", "101%", "1.5", "nan", "one", "1%%", "1e-3"):
        with pytest.raises(UserError, match="is no share"):
            share_of(text)
