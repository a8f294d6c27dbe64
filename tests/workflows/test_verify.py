import dataclasses
import errno
import os
import shutil

import google_crc32c
import pytest
import toy
import zarr

from wavequake.campaign.store.journal import append, read_journal
from wavequake.campaign.store.status import store_status
from wavequake.campaign.store.verify import verify_store
from wavequake.errors import StoreDamageError


def delete(file):
    file.unlink()


def empty(file):
    file.write_bytes(b"")


def truncate(file):
    file.write_bytes(file.read_bytes()[:-5])


def shorten(file):
    """Leave fewer numbers, with a checksum of their own."""
    content = file.read_bytes()[:16]
    file.write_bytes(content + google_crc32c.value(content).to_bytes(4, "little"))


def flip(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def swap(file):
    """Replace a file by an intact one with other numbers, which no checksum inside the file can see."""
    file.write_bytes(file.with_name(file.name.replace("c.1", "c.0").replace("c.4", "c.0")).read_bytes())


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    store = tmp_path_factory.mktemp("kept") / "s"
    toy.run(store, {"reasons": [15]}, cases=43)
    return store


@pytest.fixture
def done(kept, tmp_path):
    return shutil.copytree(kept, tmp_path / "s")


def test_an_intact_store_passes(done):
    report = verify_store(done)
    assert report.ok
    assert (report.checked, report.missing, report.damaged, report.extra) == (5, (), (), ())
    assert report.lines()[-1] == "The store is complete and intact."


FILES = [("zernike", "c.1.0.0"), ("status", "c.1"), ("time_s", "c.4.0")]
DAMAGES = [(damage, *file) for damage in (delete, empty, truncate, flip) for file in FILES]


# Swapping two chunks' times is no damage: they are equal.
@pytest.mark.parametrize(("damage", "name", "file"), [*DAMAGES, *((swap, *file) for file in FILES[:2])])
def test_damage_is_named_and_repaired_to_equal_bits(done, damage, name, file):
    before = toy.digests(done)
    damage(done / "data.zarr" / name / file)
    report = verify_store(done)
    first, last = (10, 20) if "1" in file else (40, 43)
    assert [(d.array, d.first, d.last) for d in report.damaged] == [(name, first, last)]
    assert not report.ok
    lines = report.lines()
    assert lines[1].startswith(
        f"damaged {name}, cases {first} to {last - 1} ({done / 'data.zarr' / name / file}): "
    )
    assert lines[-1] == "To repair the store, run the study again with --repair."
    summary = toy.run(done, {"reasons": [15]}, cases=43, recompute=report.chunks)
    assert (summary.computed, summary.chunks) == (last - first, 1)
    assert verify_store(done).ok
    assert toy.digests(done) == before


@pytest.mark.parametrize(
    ("damage", "name", "reason"),
    [
        (delete, "strehl/c.3", "the file is missing or empty"),
        (flip, "strehl/c.3", "the file has changed since it was written: its checksum does not fit"),
        (truncate, "zernike/c.1.0.0", "the file has changed since it was written: its checksum does not fit"),
        (shorten, "strehl/c.3", "the file was cut off or overwritten: its bytes are no array"),
        (flip, "message/c.1", "the file has changed since it was written: its checksum does not fit"),
    ],
)
def test_damage_is_told_in_words(done, damage, name, reason):
    damage(done / "data.zarr" / name)
    assert [one.reason for one in verify_store(done).damaged] == [reason]


def test_a_file_that_may_not_be_read_is_told_in_words(done, monkeypatch):
    def refuse(self, key, *rest):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(zarr.Array, "__getitem__", refuse)
    assert verify_store(done).damaged[0].reason == "the file cannot be read (permission denied)"


def test_a_damaged_message_is_named(done):
    delete(done / "data.zarr" / "message" / "c.1")
    assert [d.array for d in verify_store(done).damaged] == ["message"]


@pytest.mark.parametrize("damage", [delete, empty])
def test_a_run_computes_again_what_a_loss_of_power_took(done, damage):
    damage(done / "data.zarr" / "strehl" / "c.3")
    summary = toy.run(done, {"reasons": [15]}, cases=43)
    assert (summary.done_before, summary.computed) == (33, 10)
    assert verify_store(done).ok


def test_a_chunk_whose_cases_all_failed_is_done_and_intact(tmp_path):
    options = {"poison": list(range(10))}
    assert toy.run(tmp_path / "s", options, cases=20).quarantined == 10
    assert verify_store(tmp_path / "s").ok
    assert toy.run(tmp_path / "s", options, cases=20).computed == 0


def test_what_is_not_done_is_missing(done):
    toy.run(done, {"reasons": [15]}, cases=43)
    for file in (done / "done").glob("*.jsonl"):
        file.write_text("\n".join(line for line in file.read_text().splitlines() if '"first":20' not in line))
    report = verify_store(done)
    assert report.missing == ((20, 30),)
    assert not report.ok
    assert report.lines()[-1] == "Run the study again to complete the store."


def test_leftovers_of_a_crash_are_told_and_swept(done):
    leftover = done / "data.zarr" / "strehl" / "c.9.0123.partial"
    leftover.write_bytes(b"x")
    report = verify_store(done)
    assert report.ok
    assert report.extra == ("data.zarr/strehl/c.9.0123.partial",)
    toy.run(done, {"reasons": [15]}, cases=50)
    assert not leftover.exists()


LAYOUT = ["realization/c.0", "disturbance/c.0", "zernike_static/c.0", "strehl/zarr.json", "zarr.json"]


def files_of(folder):
    return {file.relative_to(folder): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize("damage", [delete, empty, flip, truncate])
@pytest.mark.parametrize("name", LAYOUT)
def test_damaged_labels_and_metadata_are_named_and_repaired(done, damage, name):
    before = files_of(done / "data.zarr")
    damage(done / "data.zarr" / name)
    report = verify_store(done)
    assert not report.ok
    assert name.split("/")[0] in " ".join(report.layout)
    assert report.lines()[-1] == "To repair the store, run the study again with --repair."
    assert toy.run(done, {"reasons": [15]}, cases=43, repair=True).computed == 0
    assert files_of(done / "data.zarr") == before
    assert verify_store(done).ok


@pytest.mark.parametrize("name", LAYOUT)
def test_a_run_puts_lost_labels_and_metadata_back(done, name):
    before = files_of(done / "data.zarr")
    delete(done / "data.zarr" / name)
    toy.run(done, {"reasons": [15]}, cases=43)
    assert files_of(done / "data.zarr") == before


def test_a_repair_mends_layout_and_numbers_at_once(done):
    before = files_of(done / "data.zarr")
    flip(done / "data.zarr" / "zernike" / "zarr.json")
    flip(done / "data.zarr" / "zernike" / "c.1.0.0")
    assert toy.run(done, {"reasons": [15]}, cases=43, repair=True).computed == 10
    assert files_of(done / "data.zarr") == before


def test_two_runs_with_other_numbers_are_an_alarm_everywhere(done):
    record = read_journal(done / "done").records[10, 20]
    append(done / "done", dataclasses.replace(record, digests={**record.digests, "strehl": "0" * 32}))
    with pytest.raises(StoreDamageError, match="strehl differ"):
        verify_store(done)
    with pytest.raises(StoreDamageError, match="strehl differ"):
        toy.run(done, {"reasons": [15]}, cases=43)


HALF_LOST = [
    (["realization/c.0"], ()),
    (["zarr.json"], ()),
    (["strehl/zarr.json"], ()),
    (["zarr.json", "zernike/zarr.json"], ("zernike",)),
]


@pytest.mark.parametrize(("lost", "unchecked"), HALF_LOST, ids=["labels", "root", "array", "both"])
def test_numbers_are_checked_while_labels_or_metadata_are_lost(done, lost, unchecked):
    before = files_of(done / "data.zarr")
    for name in lost:
        delete(done / "data.zarr" / name)
    flip(done / "data.zarr" / "strehl" / "c.2")
    report = verify_store(done)
    assert [(one.array, one.first, one.last) for one in report.damaged] == [("strehl", 20, 30)]
    assert (report.checked, report.unchecked) == (5, unchecked)
    assert str(done / "data.zarr" / lost[0]) in report.layout[0]
    words = "\n".join(report.lines())
    assert ("not checked, as their metadata is lost: zernike" in words) == bool(unchecked)
    assert toy.run(done, {"reasons": [15]}, cases=43, repair=True).computed == 10
    assert files_of(done / "data.zarr") == before


def test_a_store_without_any_array_is_told(done):
    shutil.rmtree(done / "data.zarr")
    report = verify_store(done)
    assert report.checked == 0
    assert set(report.unchecked) >= {"strehl", "zernike", "status"}
    assert report.lines()[0].endswith("s: 0 chunks read, 0 damaged, 0 to do")


def test_one_of_a_kind_is_told_in_the_singular(tmp_path):
    toy.run(tmp_path / "s", {"reasons": [0]}, cases=1)
    assert verify_store(tmp_path / "s").lines()[0].endswith("s: 1 chunk read, 0 damaged, 0 to do")
    assert store_status(tmp_path / "s").lines()[1].startswith("1 case in 1 chunk of ")
