"""What is no file, or more than it seems, is refused before it takes memory or time."""

import base64
import io
import os
import time
import tracemalloc
import zipfile

import h5py
import numpy as np
import pytest

from wavequake import user_files
from wavequake.campaign.plugins import load_plugin
from wavequake.errors import UserError
from wavequake.mechanics.assembly.arrays import from_matrices, from_modes
from wavequake.mechanics.importers.arrays import read_npz as read_matrices
from wavequake.user_files import LIMIT, read_bytes, read_hdf5, read_npy, read_npz, read_text, read_toml
from wavequake.words import MOST
from wavequake.workflows.study import load_study


def header(shape, dtype="<f8"):
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": dtype, "fortran_order": False, "shape": shape})
    return out.getvalue()


def zipped(**members):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, content in members.items():
            packed.writestr(f"{name}.npy", content)
    return out.getvalue()


@pytest.mark.parametrize("kind", ["device", "pipe", "folder", "missing", "zero byte", "link to a device"])
def test_what_is_no_regular_file_is_refused_at_once(tmp_path, kind):
    path = tmp_path / "x"
    if kind == "device":
        path = "/dev/zero"
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "zero byte":
        path = "a\0b"
    elif kind == "link to a device":
        path.symlink_to("/dev/zero")
    begin = time.monotonic()
    for read in (read_bytes, read_text, user_files.require_file):
        with pytest.raises(UserError, match=r"cannot be read \("):
            read(path)
    assert time.monotonic() - begin < 1.0


def test_a_study_that_is_a_device_is_no_regular_file():
    with pytest.raises(UserError, match="The file /dev/zero is no regular file"):
        load_study("/dev/zero")


def test_plug_ins_are_files_of_users_too(tmp_path):
    with pytest.raises(UserError, match=r"The plug-in /dev/zero cannot be read \(it is no regular file\)"):
        load_plugin("/dev/zero")
    (tmp_path / "a.py").write_bytes(b"\xff\xfe")
    with pytest.raises(UserError, match="no text in UTF-8"):
        load_plugin(tmp_path / "a.py")


@pytest.mark.parametrize(
    ("make", "label", "values"),
    [
        ("modes", "frequencies_hz", np.array(3.0)),
        ("modes", "damping_ratios", np.ones((2, 2))),
        ("modes", "damping_ratios", np.ones(3)),
        ("modes", "shapes", np.array(1.0)),
        ("modes", "nodes_mm", np.ones(6)),
        ("modes", "names", np.array("a")),
        ("matrices", "mass", np.array(1.0)),
        ("matrices", "stiffness", np.ones(6)),
        ("matrices", "inputs", np.ones((6, 6, 1))),
        ("matrices", "nodes_mm", np.ones((2, 2))),
    ],
)
def test_bodies_of_numbers_with_other_shapes_are_one_sentence(make, label, values):
    good = {
        "modes": {
            "frequencies_hz": np.ones(2),
            "damping_ratios": np.array(0.01),
            "nodes_mm": np.eye(2, 3),
            "shapes": np.ones((2, 2, 3)),
        },
        "matrices": {
            "mass": np.eye(6),
            "stiffness": np.eye(6),
            "nodes_mm": np.eye(2, 3),
            "inputs": np.eye(6),
        },
    }[make]
    read = {"modes": from_modes, "matrices": from_matrices}[make]
    assert len(read("tube", in_base64(good)).nodes) == 2
    with pytest.raises(UserError, match=f"'{label}' of the body 'tube'|names of the body"):
        read("tube", in_base64(good | {label: values}))


def in_base64(arrays):
    out = io.BytesIO()
    np.savez(out, **arrays)
    return base64.b64encode(out.getvalue()).decode()


def test_a_link_to_a_file_is_read(tmp_path):
    (tmp_path / "there").write_text("\ufeffµm\r\n", encoding="utf-8")
    (tmp_path / "here").symlink_to(tmp_path / "there")
    assert read_text(tmp_path / "here") == "µm\n"


def test_the_limit_is_stated_and_can_be_changed(tmp_path, monkeypatch):
    (tmp_path / "x").write_bytes(bytes(2_000_001))
    monkeypatch.setenv(LIMIT, "2")
    for read in (read_bytes, user_files.require_file):
        with pytest.raises(UserError, match=r"larger than 2 MB; set .* WAVEQUAKE_MOST_MB"):
            read(tmp_path / "x")
    monkeypatch.setenv(LIMIT, "2.1")
    assert len(read_bytes(tmp_path / "x")) == 2_000_001
    for wrong in ("a lot", "-1", "nan"):
        monkeypatch.setenv(LIMIT, wrong)
        with pytest.raises(UserError, match="must be a positive number of MB"):
            read_bytes(tmp_path / "x")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (zipped(a=header((10**12,))), "announces the shape"),
        (zipped(a=header((10**12, 0, 10**12)) + b"x"), "announces the shape"),
        (zipped(a=header((2**62, 4))), "announces the shape"),
        (zipped(a=header((3,)) + bytes(8)), "has 8 bytes"),
        (zipped(a=header((1,), "|O") + bytes(8)), "holds object"),
        (zipped(a=b"text"), "is no array"),
        (zipped(a=header((1,)).replace(b"(1,)", b"((((")), "is no array"),
        (b"PK\3\4", "no NumPy .npz file"),
        (b"", "no NumPy .npz file"),
        (zipped(**{f"a{k}": b"" for k in range(10_001)}), "it holds 10001 arrays, 10000 are possible"),
    ],
    ids=lambda value: "archive" if isinstance(value, bytes) else value,  # an archive holds the time of day
)
def test_an_archive_is_what_it_announces(data, words):
    tracemalloc.start()
    with pytest.raises(UserError, match=words):
        read_npz(data)
    assert tracemalloc.get_traced_memory()[1] < 30e6
    tracemalloc.stop()


def test_a_bomb_is_refused_before_it_goes_off(monkeypatch):
    bomb = zipped(a=header((30_000_000,)) + bytes(240_000_000))
    assert len(bomb) < 300_000
    monkeypatch.setenv(LIMIT, "100")
    tracemalloc.start()
    with pytest.raises(UserError, match="expands to 240 MB, 100 MB are possible; set the"):
        read_npz(bomb)
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()
    liar = bomb.replace((240_000_128).to_bytes(4, "little"), (100).to_bytes(4, "little"))
    assert liar != bomb
    with pytest.raises(UserError, match="is no array"):
        read_npz(liar)


@pytest.mark.parametrize("shape", [(), (0,), (3,), (2, 3), (2, 0, 3)])
@pytest.mark.parametrize("dtype", ["<f8", ">f4", "|b1", "<i2", "<c16", "<U3", "|S4"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_come_back_as_numpy_wrote_them(shape, dtype, order):
    values = np.asarray(np.arange(np.prod(shape)).reshape(shape).astype(dtype), order=order)
    out = io.BytesIO()
    np.save(out, values)
    packed = io.BytesIO()
    np.savez_compressed(packed, a=values)
    for found in (read_npy(out.getvalue()), read_npz(packed.getvalue())["a"]):
        assert found.dtype == values.dtype
        assert found.flags.writeable
        np.testing.assert_array_equal(found, values)


def test_hdf5_that_announces_more_or_lies_elsewhere_is_refused(tmp_path):
    with h5py.File(tmp_path / "big.h5", "w") as file:
        file.create_dataset("a", shape=(10**12,), chunks=(1000,), dtype="f8")
    with pytest.raises(UserError, match=r"expands to 8e\+06 MB"):
        read_hdf5(tmp_path / "big.h5")
    (tmp_path / "secret").write_bytes(bytes(80))
    with h5py.File(tmp_path / "outside.h5", "w") as file:
        file.create_dataset("a", shape=(10,), dtype="f8", external=[(str(tmp_path / "secret"), 0, 80)])
    with pytest.raises(UserError, match="'a' lies in another file"):
        read_hdf5(tmp_path / "outside.h5")
    with h5py.File(tmp_path / "linked.h5", "w") as file:
        file["a"] = np.eye(2)
        file["b"] = h5py.ExternalLink("outside.h5", "a")
        file["loop"] = h5py.SoftLink("/")
    assert list(read_hdf5(tmp_path / "linked.h5")) == ["a"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = " + "9" * 5000, "4300 digits"),
        ("a = " + "[" * 2000 + "]" * 2000, "nested too deeply"),
        ("a = " + "[" * 300 + "]" * 300, "nested more than 40 deep"),
        (".".join("a" * 100_000) + " = 1", "line 1: a key has more than 40 parts"),
        ("\n[" + " . ".join(['"a"'] * 100_000) + "]", "line 2: a key has more than 40 parts"),
        ("b = {" + "a." * 50 + "a = 1}", "a key has more than 40 parts"),
    ],
)
def test_a_study_of_endless_keys_or_numbers_is_one_sentence(tmp_path, text, words):
    begin = time.monotonic()
    with pytest.raises(UserError, match=words):
        read_toml(text)
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(UserError, match=words) as error:
        load_study(tmp_path / "s.toml")
    assert len(str(error.value)) <= MOST
    assert time.monotonic() - begin < 5.0


def test_numbers_and_texts_with_dots_are_no_keys():
    text = 'a = "' + "word. " * 100 + '"\nb = [' + ", ".join(["0.5"] * 1000) + "]\nc.d.e = 1\n"
    assert read_toml(text)["c"] == {"d": {"e": 1}}


def test_an_override_of_endless_parts_is_one_sentence():
    for key in (".".join("a" * 100_000), "campaign.cases"):
        with pytest.raises(UserError) as error:
            load_study("tmt-segments", [f"{key}={'9' * 5000}"])
        assert len(str(error.value)) <= MOST


def test_compressed_columns_that_point_elsewhere_are_refused(tmp_path):
    good = {"data": np.ones(2), "indices": np.array([0, 1]), "indptr": np.array([0, 1, 2])}
    wrong = [
        ("indptr", np.array([0, 10**9, 2]), "indptr does not fit"),
        ("indptr", np.array([1, 1, 2]), "indptr does not fit"),
        ("indptr", np.array(3), "axes are needed"),
        ("indices", np.array([0, 2]), "lies outside its order 2"),
        ("indices", np.array([0, -1]), "lies outside its order 2"),
        ("indices", np.array([0.5, 1.0]), "whole numbers"),
        ("data", np.array(["a", "b"]), "numbers are needed"),
        ("data", np.ones(3), "indptr does not fit"),
    ]
    for name, values, words in wrong:
        arrays = {f"stiffness_{key}": value for key, value in (good | {name: values}).items()}
        np.savez(tmp_path / "m.npz", **arrays)
        with pytest.raises(UserError, match=words):
            read_matrices(tmp_path / "m.npz")
