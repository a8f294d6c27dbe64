import errno
import json
import os
import shutil
import warnings

import dask.array
import numpy as np
import pytest
import toy
import xarray as xr
import zarr

from wavequake.campaign.contract import ChunkResult, Variable
from wavequake.campaign.store import arrays, journal, store
from wavequake.campaign.store.status import store_status
from wavequake.campaign.store.store import (
    create_store,
    extend_store,
    open_for_report,
    open_store,
    read_manifest,
)
from wavequake.errors import StoreDamageError, UserError


def new(path, cases=40, chunk=10, **options):
    return create_store(path, toy.TOY, toy.study(**options), cases, chunk, "numpy", {"python": "3"})


def test_plain_xarray_opens_a_store_without_warnings(tmp_path):
    toy.run(tmp_path / "s", {"poison": [17]}, cases=43)
    extend_store(tmp_path / "s", toy.TOY, 50)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dataset = xr.open_zarr(tmp_path / "s" / "data.zarr")
    assert dataset.zernike.dims == ("case", "time", "noll")
    assert dataset.sizes == {"case": 50, "time": 4, "noll": 3}
    assert dataset.zernike.attrs == {"units": "nm", "long_name": "Zernike coefficients"}
    assert dataset.status.dtype == np.int8
    assert dataset.status.attrs["flag_meanings"].split()[2] == "raised"
    np.testing.assert_array_equal(
        dataset.status, np.where(np.arange(50) < 43, np.where(np.arange(50) == 17, 2, 1), 0)
    )
    assert {"case", "noll", "time_s", "disturbance", "realization"} == set(dataset.coords)
    assert json.loads(dataset.attrs["study"])["poison"] == [17]
    assert dataset.attrs["cases_per_chunk"] == 10


def test_open_store_is_lazy_labelled_and_complete(tmp_path):
    toy.run(tmp_path / "s", {"poison": [17]})
    dataset = open_store(tmp_path / "s")
    assert isinstance(dataset.zernike.data, dask.array.Array)
    assert dataset.chunks["case"] == (10,) * 4
    assert dataset.message.sel(case=17).item() == "ValueError: the segment broke"
    assert set(dataset.message.drop_sel(case=17).values) == {""}
    assert np.isnan(dataset.zernike.sel(case=17)).all()
    np.testing.assert_array_equal(dataset.zernike.sel(case=18), toy.numbers(18))
    wind = dataset.strehl.where(dataset.status == 1).groupby("disturbance").count().sel(disturbance="wind")
    assert wind == 19
    assert dataset.names.values.tolist() == ["piston", "tip", "tilt"]
    np.testing.assert_array_equal(dataset.zernike_static, [1.5, 3.0, 4.5])
    assert list(dataset.data_vars)[:2] == ["zernike", "strehl"]
    assert "wave" in repr(dataset).lower()


def test_a_small_store_is_read_for_reports_without_dask_and_says_the_same(tmp_path, monkeypatch):
    toy.run(tmp_path / "s", {"poison": [17]}, cases=43)
    small = open_for_report(tmp_path / "s")
    assert not small.chunks
    xr.testing.assert_identical(small.load(), open_store(tmp_path / "s").load())
    monkeypatch.setattr("wavequake.campaign.store.store._SMALL", 100)
    assert open_for_report(tmp_path / "s").chunks["case"] == (10, 10, 10, 10, 3)


def test_every_chunk_is_one_file_of_every_array(tmp_path):
    toy.run(tmp_path / "s", {"reasons": [25]}, cases=43)
    names = sorted(p.name for p in (tmp_path / "s" / "data.zarr" / "zernike").iterdir())
    assert names == [*(f"c.{i}.0.0" for i in range(5)), "zarr.json"]
    assert [p.name for p in (tmp_path / "s" / "data.zarr" / "message").glob("c.*")] == ["c.2"]


def test_a_small_store_is_small(tmp_path):
    toy.run(tmp_path / "s")
    labels = [tmp_path / "s" / "data.zarr" / name for name in ("case", "disturbance", "realization")]
    assert all(1 < (folder / "c.0").stat().st_size < 4096 for folder in labels)  # for up to 65536 cases


def test_large_chunks_are_shards_that_are_read_in_parts(tmp_path):
    group = arrays.create_group(tmp_path / "g", {})
    arrays.create_per_case(group, "psf", Variable(("y", "x"), (256, 256), {}), cases=120, chunk=40)
    arrays.create_per_case(group, "los", Variable(("axis",), (2,), {}), cases=60, chunk=20)
    assert group["psf"].shards == (40, 256, 256)
    assert group["psf"].chunks == (2, 256, 256)  # 1 MiB, and a divisor of 40
    assert group["los"].shards is None
    assert group["los"].chunks == (20, 2)
    assert group["los"].metadata.fill_value != group["los"].metadata.fill_value


@pytest.mark.parametrize("chunk", [(5, 15), (0, 5), (10, 30), (0, 20), (40, 50)])
def test_only_whole_chunks_can_be_written(tmp_path, chunk):
    new(tmp_path / "s", cases=43)
    group = arrays.open_group(tmp_path / "s" / "data.zarr")
    result = toy.compute(toy.study(), np.arange(*chunk), "numpy")
    with pytest.raises(AssertionError, match="are not one piece"):
        arrays.write_chunk({"zernike": group["zernike"]}, chunk, result)


@pytest.mark.parametrize("chunk", [(0, 20), (20, 40), (40, 43)])
@pytest.mark.parametrize(
    "dtype", ["float64", "float32", "int8", "int32", "int64", "bool", "complex128", "str"]
)
@pytest.mark.parametrize(
    ("kind", "shape"), [("plain", ()), ("plain", (3, 2)), ("compressed", (3,)), ("shards", (256, 512))]
)
def test_files_are_what_zarr_itself_writes(tmp_path, monkeypatch, dtype, kind, shape, chunk):
    """Whole pieces of plain numbers are written without zarr."""
    if kind == "shards" and dtype != "float64":
        return
    numbers = np.random.default_rng(1).integers(0, 100, (chunk[1] - chunk[0], *shape))
    values = np.asfortranarray(numbers).astype(
        object if dtype == "str" else np.dtype(dtype).newbyteorder(">")
    )
    values = np.vectorize(str, otypes=[object])(values) if dtype == "str" else values
    written = []
    for folder in (tmp_path / "zarr", tmp_path / "ours"):
        group = arrays.create_group(folder, {})
        if kind == "compressed":
            codecs = {**arrays._encoding(dtype), "compressors": arrays._EVEN}
            group.create_array("a", shape=(43, *shape), chunks=(20, *shape), **codecs)
        else:
            arrays.create_per_case(group, "a", Variable(tuple("xyz"[: len(shape)]), shape, {}, dtype), 43, 20)
        array = arrays.array_of(group, "a")
        if folder.name == "zarr":
            array[slice(*chunk)] = values
        else:
            arrays.sync(arrays._write(array, *chunk, values))
        written.append(arrays.chunk_file(folder, array, chunk[0]).read_bytes())
    assert written[0] == written[1]


def test_numbers_are_on_disk_when_the_write_returns(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(os, "fsync", lambda handle: synced.append(os.readlink(f"/proc/self/fd/{handle}")))
    arrays.create_group(tmp_path / "g", {}).create_array("a", shape=(2,), dtype="f8")[:] = 1.0
    for name in ("a", "a/c"):
        assert str(tmp_path / "g" / name) in synced
    named = str(tmp_path / "g" / "a" / "c" / "0.")  # the file has its data before it has its name
    written = next(index for index, name in enumerate(synced) if name.startswith(named))
    assert synced[written].endswith(".partial")
    assert str(tmp_path / "g" / "a" / "c") in synced[written:]


def test_manifest_says_what_the_store_is(tmp_path):
    made = new(tmp_path / "s", cases=43, seed_word="x")
    assert read_manifest(tmp_path / "s") == made
    assert made.plan() == [(0, 10), (10, 20), (20, 30), (30, 40), (40, 43)]
    assert (made.workflow, made.cases, made.chunk, made.device_kind) == ("toy", 43, 10, "numpy")
    assert made.study == toy.study(seed_word="x")


def test_an_extension_keeps_earlier_cases_and_adds_labels(tmp_path):
    assert toy.run(tmp_path / "s", cases=43).again == 0
    before = open_store(tmp_path / "s").load()
    extend_store(tmp_path / "s", toy.TOY, 80)
    after = open_store(tmp_path / "s").load()
    assert after.sizes["case"] == 80
    xr.testing.assert_identical(after.isel(case=slice(43)), before)
    assert after.disturbance.values.tolist() == ["random", "wind"] * 40
    np.testing.assert_array_equal(after.case, np.arange(80))
    assert (after.status[43:] == 0).all()
    assert np.isnan(after.zernike[43:]).all()
    assert extend_store(tmp_path / "s", toy.TOY, 20).cases == 80
    done = toy.run(tmp_path / "s", cases=80)
    assert (done.done_before, done.computed, done.again) == (40, 40, 3)  # those of the chunk of 40 to 49
    assert toy.run(tmp_path / "s", cases=80).again == 0


def test_an_interrupted_extension_is_completed_by_the_next(tmp_path, monkeypatch):
    new(tmp_path / "s", cases=40)
    monkeypatch.setattr(store, "write_manifest", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        extend_store(tmp_path / "s", toy.TOY, 80)
    monkeypatch.undo()
    assert open_store(tmp_path / "s").sizes["case"] == 40
    extend_store(tmp_path / "s", toy.TOY, 60)
    dataset = xr.open_zarr(tmp_path / "s" / "data.zarr")
    assert dataset.sizes["case"] == 60
    np.testing.assert_array_equal(dataset.realization, np.arange(60) // 2)


def test_an_interrupted_creation_is_begun_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "write_manifest", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        new(tmp_path / "s", cases=40)
    monkeypatch.undo()
    new(tmp_path / "s", cases=20)
    assert open_store(tmp_path / "s").sizes["case"] == 20


def test_paths_that_are_no_place_for_a_store(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("x")
    with pytest.raises(UserError, match="cannot be written"):
        new(tmp_path / "file")
    with pytest.raises(UserError, match="cannot be written"):
        new(tmp_path / "file" / "s")
    with pytest.raises(UserError, match=r"is not a store: it holds 'thesis\.tex'"):
        new(tmp_path / "full")
    assert (tmp_path / "full" / "thesis.tex").exists()
    (tmp_path / "other" / "data.zarr").mkdir(parents=True)
    with pytest.raises(UserError, match=r"is not a store: it holds 'data\.zarr'"):
        new(tmp_path / "other")
    assert (tmp_path / "other" / "data.zarr").exists()
    with pytest.raises(UserError, match="cannot be written"):
        new(tmp_path / ("x" * 300))
    with pytest.raises(UserError, match="There is no store at"):
        open_store(tmp_path / "nowhere")
    with pytest.raises(UserError, match="There is no store at"):
        store_status(tmp_path / "file")
    (tmp_path / "budgeted" / "budget.zarr").mkdir(parents=True)
    with pytest.raises(UserError, match=r"has no runs to report, but budget\.zarr .*`wavequake run`"):
        open_store(tmp_path / "budgeted")
    with pytest.raises(UserError, match=r"at least one case \(campaign.cases is 0\)"):
        new(tmp_path / "s", cases=0)


def test_a_lost_journal_is_begun_again(tmp_path):
    toy.run(tmp_path / "s")
    before = toy.digests(tmp_path / "s")
    shutil.rmtree(tmp_path / "s" / "done")
    assert toy.run(tmp_path / "s").done_before == 0
    assert toy.digests(tmp_path / "s") == before


@pytest.mark.parametrize("other", ["report.html", "case-3.nc"])
def test_results_without_a_manifest_are_never_overwritten(tmp_path, other):
    toy.run(tmp_path / "s")
    (tmp_path / "s" / other).write_text("x")
    (tmp_path / "s" / "manifest.json").unlink()
    with pytest.raises(UserError, match=r"has results but no manifest\.json"):
        toy.run(tmp_path / "s")
    assert (tmp_path / "s" / "data.zarr" / "zernike" / "c.0.0.0").exists()


@pytest.mark.parametrize("damage", ["{", "[]", '{"schema": 1}', "", "identity"])
def test_a_damaged_manifest_is_named(tmp_path, damage):
    new(tmp_path / "s")
    file = tmp_path / "s" / "manifest.json"
    file.write_text(file.read_text().replace("toy", "boy") if damage == "identity" else damage)
    with pytest.raises(StoreDamageError, match=r"manifest\.json is damaged"):
        open_store(tmp_path / "s")


def test_a_store_of_another_version_is_refused(tmp_path):
    new(tmp_path / "s")
    file = tmp_path / "s" / "manifest.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "schema": 99, "more": 1}))
    with pytest.raises(UserError, match="has schema 99; this version of Wavequake reads schema 1"):
        open_store(tmp_path / "s")


def test_a_lost_array_is_named(tmp_path):
    new(tmp_path / "s")
    (tmp_path / "s" / "data.zarr" / "strehl" / "zarr.json").unlink()
    with pytest.raises(StoreDamageError, match="strehl"):
        extend_store(tmp_path / "s", toy.TOY, 80)
    with pytest.raises(StoreDamageError, match="strehl"):
        open_store(tmp_path / "s")


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"optics": {"wavelength_nm": 550.0}, "a": 2}, "optics.wavelength_nm is 500.0 there, 550.0 here"),
        ({"optics": {"wavelength_nm": 500.0, "rays": 9}, "a": 2}, "optics.rays is absent there, 9 here"),
        (
            {"disturbance": [{"name": "wind", "speed": 8}], "a": 2},
            "disturbance.wind.speed is 5 there, 8 here",
        ),
        ({"disturbance": [{"name": "rain", "speed": 5}], "a": 2}, "disturbance.rain is absent there"),
        ({"a": 3}, "a is 2 there, 3 here"),
    ],
)
def test_the_store_of_another_study_is_refused_with_the_first_difference(tmp_path, other, words):
    base = {"a": 2, "optics": {"wavelength_nm": 500.0}, "disturbance": [{"name": "wind", "speed": 5}]}
    new(tmp_path / "s", **base)
    with pytest.raises(UserError, match=f"belongs to another study: {words}"):
        toy.run(tmp_path / "s", {**base, **other})


def test_another_workflow_or_kind_of_device_is_refused(tmp_path):
    manifest = new(tmp_path / "s")
    with pytest.raises(UserError, match='workflow is "toy" there, "mirror-mor" here'):
        store.refuse_other(tmp_path / "s", manifest, "mirror-mor", toy.study(), "numpy")
    with pytest.raises(UserError, match=r"begun on a device of kind 'numpy' .*campaign.device=numpy"):
        store.refuse_other(tmp_path / "s", manifest, "toy", toy.study(), "gpu")
    store.refuse_other(tmp_path / "s", manifest, "toy", toy.study(), "numpy")


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.ENOSPC, "is full: what is done is kept"),
        (errno.EDQUOT, "is full"),
        (errno.EROFS, "cannot be written"),
    ],
)
def test_a_disk_that_takes_nothing_is_one_sentence(tmp_path, monkeypatch, code, words):
    def refuse(path, parts):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(arrays, "_put", refuse)
    with pytest.raises(UserError, match=words):
        new(tmp_path / "s")
    monkeypatch.undo()
    toy.run(tmp_path / "s", cases=10)


@pytest.mark.parametrize("where", ["data", "journal"])
def test_a_disk_that_fills_up_loses_nothing(tmp_path, monkeypatch, where):
    written = []
    put, record = arrays._put, journal.append

    def fill(path, parts):
        written.append(path)
        if len(written) == 13:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        put(path, parts)

    def fill_journal(folder, entry):
        if entry.first == 20:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        record(folder, entry)

    new(tmp_path / "s")
    if where == "data":
        monkeypatch.setattr(arrays, "_put", fill)
    else:
        monkeypatch.setattr(journal, "append", fill_journal)
    with pytest.raises(UserError, match="is full"):
        toy.run(tmp_path / "s")
    monkeypatch.undo()
    summary = toy.run(tmp_path / "s")
    assert (summary.done_before, summary.computed) == (20, 20)
    toy.run(tmp_path / "whole")
    assert toy.digests(tmp_path / "s") == toy.digests(tmp_path / "whole")


def test_status_says_what_is_done_and_why_not(tmp_path):
    toy.run(tmp_path / "s", {"poison": [17], "reasons": [3]})
    extend_store(tmp_path / "s", toy.TOY, 60)
    found = store_status(tmp_path / "s")
    assert found.counts == (20, 38, 2, 0, 0, 0)
    assert (found.chunks_done, found.quarantined) == (4, 2)
    text = "\n".join(found.lines())
    assert "60 cases in 6 chunks of 10; 4 are done" in text
    assert "20 todo, 38 done, 2 raised" in text
    assert "case 3 raised: case 3 loses a segment" in text
    assert "case 17 raised: ValueError: the segment broke" in text
    assert "... and 1 more" in "\n".join(found.lines(most=1))


def test_fill_values_say_that_nothing_is_there(tmp_path):
    new(tmp_path / "s")
    group = zarr.open_group(tmp_path / "s" / "data.zarr", mode="r")
    assert np.isnan(group["strehl"][:]).all()
    assert (group["status"][:] == 0).all()
    assert isinstance(toy.compute(toy.study(), np.arange(3), "numpy"), ChunkResult)


def test_what_is_not_computed_yet_reads_as_no_numbers_whatever_zarr_was_told(tmp_path):
    """Since 3.2 zarr can be told to raise where a chunk is missing."""
    create_store(tmp_path / "s", toy.TOY, toy.study(), 40, 10, "numpy", {})
    with zarr.config.set({"array.read_missing_chunks": False}):
        stored = open_store(tmp_path / "s").load()
        assert np.isnan(stored.zernike).all()
        assert not stored.status.any()
        toy.run(tmp_path / "s", cases=20)
        assert open_store(tmp_path / "s").status.values.tolist() == [1] * 20 + [0] * 20
