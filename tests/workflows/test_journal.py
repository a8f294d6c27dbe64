import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavequake.campaign.store import journal
from wavequake.campaign.store.journal import Record, append, digest, read_journal
from wavequake.errors import StoreDamageError

RECORD = Record(
    20,
    30,
    {"zernike": "aa", "status": "bb"},
    (0, 9, 1, 0, 0, 0),
    {23: (2, "ValueError: no\nglass")},
    {"s": 0.5},
)


def write(folder, *records):
    for record in records:
        append(folder, record)


def test_a_record_comes_back_as_it_was_written(tmp_path):
    write(tmp_path, RECORD)
    found = read_journal(tmp_path)
    assert found.records == {(20, 30): RECORD}
    assert found.torn == 0
    assert RECORD.quarantined == 1


@pytest.mark.parametrize("keep", [2, 30, -2])
def test_a_torn_line_costs_its_own_record_only(tmp_path, keep):
    write(tmp_path, RECORD)
    (file,) = tmp_path.glob("*.jsonl")
    file.write_bytes(file.read_bytes().rstrip(b"\n")[:keep])
    later = dataclasses.replace(RECORD, first=30, last=40)
    write(tmp_path, later)
    found = read_journal(tmp_path)
    assert found.records == {(30, 40): later}
    assert found.torn == 1


def test_duplicates_that_agree_are_one_record(tmp_path):
    write(tmp_path, RECORD, dataclasses.replace(RECORD, pid=1, time=RECORD.time + 1, timings={}))
    assert list(read_journal(tmp_path).records) == [(20, 30)]


def test_duplicates_with_other_numbers_raise_the_alarm(tmp_path):
    write(tmp_path, RECORD, dataclasses.replace(RECORD, pid=1, digests={"zernike": "ab", "status": "bb"}))
    with pytest.raises(StoreDamageError, match=r"cases 20 to 29 were computed twice, .*zernike differ"):
        read_journal(tmp_path)


def test_a_crash_that_went_well_at_the_second_attempt_is_no_alarm(tmp_path):
    better = dataclasses.replace(
        RECORD, time=RECORD.time + 9, digests={"zernike": "ab", "status": "cc"}, failures={}
    )
    write(tmp_path, better, RECORD)
    assert read_journal(tmp_path).records == {(20, 30): better}


def test_a_full_disk_in_the_middle_of_a_record_is_an_error(tmp_path, monkeypatch):
    write_all = journal.os.write
    monkeypatch.setattr(journal.os, "write", lambda handle, line: write_all(handle, line[:40]))
    with pytest.raises(OSError, match="No space left"):
        append(tmp_path, RECORD)
    monkeypatch.undo()
    append(tmp_path, RECORD)
    assert read_journal(tmp_path).records == {(20, 30): RECORD}


@given(st.integers(0, 5 * 3 * 8 - 1), st.integers(1, 255))
def test_digest_sees_every_byte(place, flip):
    array = np.arange(15.0).reshape(5, 3)
    other = array.copy()
    other.view(np.uint8).reshape(-1)[place] ^= flip
    assert digest(array) != digest(other)


def test_digest_is_of_the_c_order_bytes_and_of_texts():
    array = np.arange(15.0).reshape(5, 3)
    assert digest(array) == digest(np.asfortranarray(array)) != digest(np.ascontiguousarray(array.T))
    assert digest(np.array(["a", ""], dtype=object)) == digest(
        np.array(["a", ""], dtype=np.dtypes.StringDType())
    )
    assert digest(np.array(["ab", ""], dtype=object)) != digest(np.array(["a", "b"], dtype=object))
