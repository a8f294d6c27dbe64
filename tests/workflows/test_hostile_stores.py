"""Manifests, journals and metadata that were changed by hand, by disks or by somebody who means harm."""

import dataclasses
import json
import os
import resource
import shutil
import signal
from hashlib import sha256

import pytest
import toy

from wavequake.campaign.store import manifest as manifests
from wavequake.campaign.store.journal import append, read_journal
from wavequake.campaign.store.status import store_status
from wavequake.campaign.store.store import create_store, read_manifest
from wavequake.campaign.store.verify import verify_store
from wavequake.errors import StoreDamageError, UserError


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    store = tmp_path_factory.mktemp("kept") / "s"
    toy.run(store, cases=43)
    return store


@pytest.fixture
def done(kept, tmp_path):
    return shutil.copytree(kept, tmp_path / "s")


@pytest.fixture
def bounded():
    """Let no test take more than 1 GB beyond what there is."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as file:
        now = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + 2**30, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def lines_of(store):
    (file,) = (store / "done").glob("*.jsonl")
    return file, [line for line in file.read_bytes().split(b"\n") if line]


@pytest.mark.parametrize("place", range(0, 900, 90))
def test_a_digit_that_changes_in_the_journal_costs_one_chunk(done, place):
    before = toy.digests(done)
    file, lines = lines_of(done)
    changed = bytearray(lines[2])
    changed[place % len(changed)] ^= 1
    file.write_bytes(b"\n".join([*lines[:2], changed, *lines[3:]]) + b"\n")
    assert len(read_journal(done / "done").records) == 4
    assert toy.run(done, cases=43).computed == 10
    assert toy.digests(done) == before
    assert verify_store(done).ok
    assert verify_store(done).torn >= 1


@pytest.mark.parametrize("place", ["done/*.jsonl", "data.zarr/*/c.*"])
def test_nobody_waits_for_a_pipe_in_the_place_of_a_file(done, place):
    for file in done.glob(place):
        file.unlink()
        os.mkfifo(file)
    signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.alarm(20)
    try:
        found = verify_store(done)
        store_status(done)
    finally:
        signal.alarm(0)
    assert not found.ok


def test_lines_of_earlier_versions_without_a_checksum_are_read(done):
    before = toy.digests(done)
    file, lines = lines_of(done)
    bare = [json.loads(line.rpartition(b" ")[0]) for line in lines]
    old = [{k: v for k, v in entry.items() if k not in ("epoch", "settles")} for entry in bare]
    file.write_text("\n".join(map(json.dumps, old)) + "\n")
    assert toy.digests(done) == before
    assert toy.run(done, cases=43).computed == 0


WRONG = {
    "first": ["0", None, -10, 1.5, True, 10**400],
    "last": ["10", 0, [], 10**30],
    "digests": [None, [], {"strehl": 5}],
    "counts": [None, "0,10", [10], [0, "10", 0, 0, 0, 0], [0, 99, 0, 0, 0, 0]],
    "failures": [None, [1], {"x": [2, ""]}, {"3": [9, ""]}, {"3": "no"}],
    "timings": [None, {"compute_s": "1"}],
    "time": ["now", None, float("nan")],
    "code": [7],
    "epoch": ["1", -1, 2**60],
    "more": [1],
}


@pytest.mark.parametrize(("key", "value"), [(key, value) for key in WRONG for value in WRONG[key]])
def test_a_line_of_wrong_types_is_no_record(done, key, value):
    """Also with a checksum that fits: whoever writes it wrong can."""
    _, lines = lines_of(done)
    entry = {**json.loads(lines[1].rpartition(b" ")[0]), key: value}
    (done / "done" / "other.jsonl").write_text(json.dumps(entry) + "\n")
    assert read_journal(done / "done").torn == 1
    assert toy.run(done, cases=43).computed == 0
    assert store_status(done).quarantined == 0


@pytest.mark.parametrize("line", [b"[" * 10**6, b'{"first":' * 10**5, b"\xff\xfe", b"1" * 5000, b"null"])
def test_a_line_that_is_anything_is_no_record(done, line):
    (done / "done" / "other.jsonl").write_bytes(line + b"\n")
    assert read_journal(done / "done").torn == 1
    assert toy.run(done, cases=43).computed == 0


CHANGES = {
    "cases": ["60", 0, -1, 1.5, None, True, 10**12, 10**8 + 1],
    "chunk": [0, "10", None, -5, 2.5],
    "variables": [None, [1, 2], "strehl", {}],
    "study": [None, 5, "{}"],
    "identity": [None, "0" * 64],
    "provenance": [None, [1]],
    "metadata": [5],
    "device": [{}],
    "schema": [[]],
    "more": [1],
}


@pytest.mark.parametrize("sealed", [True, False], ids=["sealed", "bare"])
@pytest.mark.parametrize(("key", "value"), [(key, value) for key in CHANGES for value in CHANGES[key]])
def test_a_manifest_that_cannot_be_is_damage(done, bounded, key, value, sealed):
    file = done / "manifest.json"
    entry = {**json.loads(file.read_text()), key: value}
    del entry["checksum"]
    file.write_text(json.dumps(manifests.sealed(entry) if sealed else entry))
    for ask in (store_status, verify_store, lambda path: toy.run(path, cases=43)):
        with pytest.raises((StoreDamageError, UserError) if key == "schema" else StoreDamageError) as told:
            ask(done)
        assert len(str(told.value)) < 600


@pytest.mark.parametrize(
    "text", ["", "[]", "5", "[" * 10**5, '{"schema":1}', "\0", '{"schema":' + "9" * 5000]
)
def test_a_manifest_that_is_anything_is_damage(done, text):
    (done / "manifest.json").write_text(text)
    with pytest.raises(StoreDamageError, match=r"manifest\.json is damaged"):
        store_status(done)


def test_a_number_that_was_changed_in_a_manifest_is_found(done):
    file = done / "manifest.json"
    file.write_text(file.read_text().replace('"cases": 43', '"cases": 40'))
    with pytest.raises(StoreDamageError, match="checksum"):
        verify_store(done)


def edit(file, change):
    entry = json.loads(file.read_text())
    change(entry)
    file.write_text(json.dumps(entry))


def both(store, name, change):
    """Edit the metadata of an array in both places that have it."""
    edit(store / "data.zarr" / name / "zarr.json", change)
    edit(
        store / "data.zarr" / "zarr.json",
        lambda root: change(root["consolidated_metadata"]["metadata"][name]),
    )


def units(entry):
    entry["attributes"]["units"] = "um"


def huge(entry):
    entry["shape"][0] = 10**15


@pytest.mark.parametrize(
    ("name", "change"),
    [("zernike", units), ("realization", huge), ("noll", huge), ("strehl", huge), ("strehl", dict.clear)],
    ids=["units", "labels", "fixed", "numbers", "nothing"],
)
def test_metadata_that_were_changed_in_both_places_are_found_and_put_back(done, bounded, name, change):
    before = {file: file.read_bytes() for file in (done / "data.zarr").rglob("*") if file.is_file()}
    both(done, name, change)
    report = verify_store(done)
    assert not report.ok
    assert report.layout
    assert toy.run(done, cases=43, repair=True).computed == 0
    assert {file: file.read_bytes() for file in before} == before
    assert verify_store(done).ok


def test_a_repair_ends_an_argument_of_two_records(done):
    before = toy.digests(done)
    record = read_journal(done / "done").records[10, 20]
    append(done / "done", dataclasses.replace(record, digests={**record.digests, "strehl": "0" * 32}))
    with pytest.raises(StoreDamageError, match="with --repair, which computes them anew"):
        toy.run(done, cases=43)
    assert toy.run(done, cases=43, repair=True).computed == 10
    assert toy.digests(done) == before
    assert verify_store(done).ok
    assert toy.run(done, cases=43).computed == 0


@pytest.mark.parametrize(("cases", "chunk"), [(10**8, 1), (10**8, 99), (2 * 10**8, 400)])
def test_more_than_a_store_can_hold_is_refused_before_it_is_made(tmp_path, bounded, cases, chunk):
    with pytest.raises(UserError, match=r"at most 1000000 are possible, with|more than 100000000"):
        toy.run(tmp_path / "s", cases=cases, chunk=chunk)
    assert not (tmp_path / "s").exists()
    toy.run(tmp_path / "s", cases=4, chunk=1)
    with pytest.raises(UserError, match=r"at most 1000000 are possible, with|more than 100000000"):
        toy.run(tmp_path / "s", cases=cases, chunk=1)
    assert read_manifest(tmp_path / "s").cases == 4


def test_identities_are_checked_as_before(tmp_path):
    create_store(tmp_path / "s", toy.TOY, toy.study(), 4, 2, "numpy", {})
    assert read_manifest(tmp_path / "s").identity == sha256(toy.study().encode()).hexdigest()
