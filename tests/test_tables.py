"""Tables on disk: the same bits, made once, and never believed when they are damaged."""

from dataclasses import dataclass

import numpy as np
import pytest

from wavequake import tables
from wavequake.tables import kept, kept_by, table_folder

made = []


@dataclass(frozen=True)
class Table:
    values: np.ndarray
    scale: float
    count: int


def make(values, factor=1.0):
    made.append(factor)
    return Table(np.asarray(values) * factor, factor, len(values))


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "table_folder", lambda: tmp_path)
    made.clear()
    return tmp_path


def test_a_table_is_made_once_and_read_with_the_same_bits():
    values = np.random.default_rng(1).normal(size=(5, 3)).astype(np.float32)
    first, second = kept(Table, make, values, factor=3.0), kept(Table, make, values, factor=3.0)
    assert made == [3.0]
    np.testing.assert_array_equal(first.values, second.values)
    assert second.values.dtype == first.values.dtype
    assert (second.scale, second.count) == (3.0, 5)
    assert (type(second.scale), type(second.count)) == (float, int)


def test_other_arguments_are_other_tables():
    values = np.arange(4.0)
    for argument in (values, values.astype(np.float32), values.reshape(2, 2), values + 1e-300):
        kept(Table, make, argument)
    kept(Table, make, values, factor=2.0)
    assert len(made) == 5
    assert len(list(tables.table_folder().iterdir())) == 5


def test_arrays_by_name_are_known_by_all_their_numbers():
    values = np.zeros(5000)
    for place in (1, 2500):  # the middle of a long array is not in its words
        values[2500] = place
        kept(Table, make, np.ones(5000), factor=values.copy())
    assert len(made) == 2


def test_what_this_package_does_not_decide_outlives_its_versions(monkeypatch):
    for version in ("0.1", "0.2"):
        monkeypatch.setattr(tables, "_makers", lambda version=version: version)
        kept(Table, make, np.arange(4.0))
        kept_by(Table, "program", ("text", ["-w"]), lambda: make(np.arange(4.0), 5.0))
    assert sorted(made) == [1.0, 1.0, 5.0]
    kept_by(Table, "program", ("text", ["-O2"]), lambda: make(np.arange(4.0), 5.0))
    assert len(made) == 4


@pytest.mark.parametrize("damage", [b"", b"PK", None])
def test_a_damaged_table_is_made_anew(folder, damage):
    kept(Table, make, np.arange(1000.0))
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    middle = len(whole) // 2
    file.write_bytes(whole[:middle] + b"\xff\xfe" + whole[middle + 2 :] if damage is None else damage)
    np.testing.assert_array_equal(kept(Table, make, np.arange(1000.0)).values, np.arange(1000.0))
    assert len(made) == 2
    assert file.read_bytes()[:2] == b"PK"


def test_no_damaged_bit_is_believed_or_ends_a_run(folder):
    kept(Table, make, np.arange(2.0))
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    directory = whole.rindex(b"PK\x01\x02")  # names methods of compression, encryption and versions
    for place in range(directory, len(whole)):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        found = kept(Table, make, np.arange(2.0))
        np.testing.assert_array_equal(found.values, np.arange(2.0))


def test_the_folder_is_bounded_and_the_newest_stays(folder, monkeypatch):
    monkeypatch.setattr(tables, "_MOST_BYTES", 20_000)
    for factor in range(6):
        kept(Table, make, np.arange(1000.0), factor=float(factor))
    assert sum(path.stat().st_size for path in folder.iterdir()) <= 20_000
    kept(Table, make, np.arange(1000.0), factor=5.0)
    assert len(made) == 6


def test_a_folder_that_cannot_be_written_costs_only_time(monkeypatch, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setattr(tables, "table_folder", lambda: blocked / "tables")
    assert kept(Table, make, np.arange(3.0)).count == 3


def test_the_folder_is_the_users():
    assert "wavequake" in str(table_folder())
