"""Files for other programs, read back by those programs' own readers."""

import csv
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
import xarray as xr
from dask.array import ones

import wavequake as wq
from wavequake.errors import UserError
from wavequake.report.exports.store import export


@pytest.fixture
def dataset():
    """Case 0 has two instants, case 1 one, case 2 failed; seeds beyond 32 bits."""
    time = np.array([[0.0, 0.1], [0.0, np.nan], [np.nan, np.nan]])
    los = np.stack([time * 0 + 3.0, time * 0 - 4.0], axis=2)
    wfe = np.array([[3.0, 4.0], [1 / 3, np.nan], [np.nan, np.nan]])
    return xr.Dataset(
        {
            "wfe_rms": (("case", "time"), wfe, {"units": "nm"}),
            "los": (("case", "time", "axis"), los, {"units": "mas"}),
            "ee50": ("case", [0.5, np.inf, np.nan], {"units": "lambda/D"}),
            "status": ("case", np.array([1, 1, 2], np.int8)),
            "message": ("case", np.array(["", "", 'said "no", ß'], np.dtypes.StringDType())),
        },
        {
            "case": np.arange(3),
            "seed": ("case", [2**40, 1, 2]),
            "time_s": (("case", "time"), time, {"units": "s"}),
        },
        {"title": "λ"},
    )


@pytest.fixture
def odd(dataset):
    """Types, sizes and names that stores have here and there."""
    more = {
        "firmware_hash": (("case", "image"), np.array([[2**64 - 1], [0], [2**63]], np.uint64)),
        "counts": (("case", "image"), np.array([[-128], [0], [127]], np.int8)),
        "ports": (("case", "image"), np.array([[65000], [0], [7]], np.uint16)),
        "agrees": (("case", "image"), np.array([[True], [False], [True]])),
        "linear": ("case", [True, False, True]),
        "single": (("case", "y", "x"), np.linspace(0, 1, 18, dtype=np.float32).reshape(3, 2, 3)),
        "time": ("y", [1.0, 2.0]),  # has the name of a dimension of others
        "checked": ("check", np.zeros(0)),
        "controller": ("name", ["FF", "größer"]),
    }
    return dataset.assign(more)


def lazily(dataset):
    """Return a dataset as a store gives it: labels in memory, numbers in chunks."""
    chunked = {name: one.variable.chunk(case=2) for name, one in dataset.items() if one.dtype.kind == "f"}
    return dataset.assign({name: one for name, one in chunked.items() if "case" in one.dims})


def test_netcdf_holds_the_same_bits(odd, tmp_path):
    with xr.open_dataset(export(lazily(odd), tmp_path / "a.nc")) as back:
        for name, variable in odd.variables.items():
            if variable.dtype.kind in "biuf":
                np.testing.assert_array_equal(back[name], variable)
                assert (back[name].dtype, back[name].dims) == (variable.dtype, variable.dims), name
        assert back.seed.values.tolist() == [2**40, 1, 2]
        assert back.message.values.tolist() == ["", "", 'said "no", ß']
        assert back.controller.values.tolist() == ["FF", "größer"]
        assert back.wfe_rms.attrs["units"] == "nm"
        assert back.attrs["title"] == "λ"
        assert set(back.coords) == set(odd.coords)


def test_a_single_case_without_its_dimension_is_written(dataset, tmp_path):
    with xr.open_dataset(export(dataset.isel(case=0), tmp_path / "a.nc")) as back:
        assert float(back.ee50) == 0.5
        assert int(back.seed) == 2**40
        assert back.message.item() == ""
        np.testing.assert_array_equal(back.los, dataset.los[0])


FEW = [(suffix, cases) for suffix in (".nc", ".fits", ".csv") for cases in (slice(0), slice(1), 0)][:-1]


@pytest.mark.parametrize(("suffix", "cases"), FEW)
def test_stores_of_few_cases_are_written(odd, tmp_path, suffix, cases):
    path = export(lazily(odd).isel(case=cases), tmp_path / f"a{suffix}")
    if suffix == ".csv":
        assert len(path.read_text().splitlines()) == 1 + (cases == slice(1))
    elif suffix == ".nc":
        with xr.open_dataset(path) as back:
            xr.testing.assert_equal(back.los.variable, odd.isel(case=cases).los.variable)
    else:
        with pytest.importorskip("astropy.io.fits").open(path, checksum=True) as file:
            assert len(file["CASES"].data if cases != 0 else ()) == (cases == slice(1))
            np.testing.assert_array_equal(file["single"].data, odd.isel(case=cases).single)


def test_csv_has_one_row_per_case(dataset, tmp_path):
    with export(dataset, tmp_path / "a.csv").open(encoding="utf-8", newline="") as file:
        first, second, failed = csv.DictReader(file)
    assert float(first["wfe_rms_mean (nm)"]) == 3.5
    assert float(first["wfe_rms_rms (nm)"]) == np.sqrt(12.5)
    assert (first["los_x_mean (mas)"], first["los_y_mean (mas)"]) == ("3.0", "-4.0")
    assert float(second["wfe_rms_mean (nm)"]) == 1 / 3
    assert second["ee50 (lambda/D)"] == "inf"
    assert first["seed"] == str(2**40)
    assert failed["message"] == 'said "no", ß'
    assert failed["wfe_rms_rms (nm)"] == failed["ee50 (lambda/D)"] == ""


def test_a_missing_instant_is_not_averaged_away(dataset, tmp_path):
    dataset.wfe_rms[0, 1] = np.nan
    with export(dataset, tmp_path / "a.csv").open(encoding="utf-8", newline="") as file:
        assert next(csv.DictReader(file))["wfe_rms_mean (nm)"] == ""


def test_files_are_not_overwritten_unasked(dataset, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("mine")
    with pytest.raises(UserError, match="exists already"):
        export(dataset, path)
    assert path.read_text() == "mine"
    export(dataset, path, overwrite=True)
    assert [file.name for file in tmp_path.iterdir()] == ["a.csv"]
    assert path.read_text() != "mine"


def test_fits_holds_the_same_bits(dataset, tmp_path):
    fits = pytest.importorskip("astropy.io.fits")
    with fits.open(export(dataset, tmp_path / "a.fits"), checksum=True) as file:
        cases = file["CASES"].data
        assert cases["seed"].tolist() == [2**40, 1, 2]
        np.testing.assert_array_equal(cases["ee50"], dataset.ee50)
        assert file["CASES"].columns["ee50"].unit == "lambda/D"
        assert cases["message"].tolist() == ["", "", 'said "no", ?']
        assert cases["status"].tolist() == [1, 1, 2]
        for name in ("wfe_rms", "los", "time_s"):
            np.testing.assert_array_equal(file[name].data, dataset[name])
        header = file["los"].header
        assert [header[f"CTYPE{axis}"] for axis in (1, 2, 3)] == ["axis", "time", "case"]
        assert header["BUNIT"] == "mas"


def cards(content):
    """Cut a FITS file into 80 bytes each, without the text of checksums and the comments on those of data."""
    found = [content[first : first + 80] for first in range(0, len(content), 80)]
    for place, card in enumerate(found):
        if card.startswith((b"CHECKSUM=", b"DATASUM =")):
            found[place] = card[:9] if card.startswith(b"CHECKSUM=") else card[:22]
    return found


def test_fits_is_the_file_that_astropy_writes_of_arrays_in_memory(odd, tmp_path, monkeypatch):
    fits = pytest.importorskip("astropy.io.fits")
    columns, images = [], []
    for name, one in odd.variables.items():
        values, unit = one.to_numpy(), one.attrs.get("units", "")
        if one.dims == ("case",):
            code = {"b": "L", "f": "D", "i": "K"}.get(values.dtype.kind, "12A")
            texts = ["", "", 'said "no", ?'] if name == "message" else values
            columns.append(fits.Column(name, code, unit, array=np.array(texts)))
        elif values.dtype.kind in "biuf":
            image = fits.ImageHDU(values.astype(np.uint8) if values.dtype == bool else values, name=name)
            image.header["BUNIT"] = unit
            image.header.update({f"CTYPE{n}": dim for n, dim in enumerate(reversed(one.dims), 1)})
            images.append(image)
    first = fits.PrimaryHDU()
    first.header.update({"ORIGIN": "?", "STUDYID": "", "CREATED": ""})
    whole = fits.HDUList([first, fits.BinTableHDU.from_columns(columns, name="CASES"), *images])
    whole.writeto(tmp_path / "whole.fits", checksum=True)
    monkeypatch.setattr("wavequake.campaign.statistics.blocks.BLOCK_BYTES", 40)  # a case at a time
    export(lazily(odd), tmp_path / "parts.fits")
    # Astropy's comments on checksums hold the time, which ours do not; the reader below recomputes them.
    one, two = (cards((tmp_path / name).read_bytes()) for name in ("whole.fits", "parts.fits"))
    assert one == two
    assert sum(card.startswith(b"DATASUM = ") for card in one) == 2 + len(images)
    with fits.open(tmp_path / "parts.fits", checksum=True) as file:
        assert len(file) == 2 + len(images)
        np.testing.assert_array_equal(file["firmware_hash"].data, odd.firmware_hash)


@pytest.mark.parametrize("seed", range(5))
def test_checksums_of_fits_are_accepted_by_astropy(tmp_path, seed):
    """Two hundred random sums, whose letters meet punctuation of every kind."""
    fits = pytest.importorskip("astropy.io.fits")
    numbers = np.random.default_rng(seed).integers(0, 256, (40, 3, 7), np.uint8)
    dataset = xr.Dataset({f"n{k}": (("case", "x"), one) for k, one in enumerate(numbers)}, {"case": range(3)})
    with fits.open(export(dataset, tmp_path / "a.fits"), checksum=True) as file:  # a wrong one is a warning
        assert all(part.verify_checksum() == part.verify_datasum() == 1 for part in file)


@pytest.mark.parametrize("suffix", [".nc", ".fits"])
def test_an_export_takes_blocks_of_cases_into_memory(tmp_path, suffix):
    numbers = {name: ("case", np.arange(8000)) for name in ("case", "seed")}
    large = xr.Dataset({"image": (("case", "x"), ones((8000, 4000), chunks=(200, -1)))}, numbers)
    assert large.nbytes > 250e6
    export(large.isel(case=slice(1)), tmp_path / f"first{suffix}")  # loads the libraries
    tracemalloc.start()
    path = export(large, tmp_path / f"large{suffix}")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert path.stat().st_size > 250e6
    assert peak < 100e6


@pytest.mark.parametrize("suffix", [".nc", ".fits", ".csv"])
def test_a_full_disk_is_told_and_leaves_nothing(dataset, tmp_path, suffix):
    """In a process of its own, which may write no file of more than 4 KiB; HDF5 used to crash at its end."""
    dataset = dataset.isel(case=np.zeros(1000, dtype=int)).assign_coords(case=np.arange(1000))
    dataset.drop_vars("message").to_netcdf(tmp_path / "source.nc", engine="h5netcdf")
    code = f"""
import resource, signal
import xarray as xr
from wavequake.errors import UserError
from wavequake.report.exports.store import export
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
dataset = xr.load_dataset("source.nc")
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
try:
    export(dataset, "a{suffix}")
except UserError as error:
    print(error)
"""
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith(f"a{suffix} cannot be written: "), run.stdout + run.stderr
    assert [file.name for file in tmp_path.iterdir()] == ["source.nc"]


def test_fits_without_astropy_says_what_to_install(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr("wavequake.report.exports.store.find_spec", lambda name: None)
    with pytest.raises(UserError, match="pip install astropy"):
        export(dataset, tmp_path / "a.fits")


def test_csv_needs_no_times_per_case(dataset, tmp_path):
    fixed = dataset.drop_vars("time_s").assign_coords(time_s=("time", [0.0, 0.1]))
    for number, one in enumerate((fixed, dataset.drop_vars("time_s"))):
        with export(one, tmp_path / f"{number}.csv").open(encoding="utf-8", newline="") as file:
            first, second, _ = csv.DictReader(file)
        assert float(first["wfe_rms_mean (nm)"]) == 3.5
        assert second["wfe_rms_mean (nm)"] == ""


@pytest.mark.parametrize("name", ["a.hdf5", "a", "none/a.csv"])
def test_other_names_are_refused(dataset, tmp_path, name):
    with pytest.raises(UserError):
        export(dataset, tmp_path / name)


def test_the_command_writes_once(tmp_path, wavequake):
    study = tmp_path / "tiny.toml"
    study.write_text(
        '[study]\nname = "tiny"\nworkflow = "segment-disturbance"\n[telescope]\nname = "tmt-18"\n'
        '[imaging]\npixels = 16\n[[disturbance]]\nname = "pistons"\nmodel = "static-random"\n'
        "piston_nm = 20.0\ninstants = 2\n"
    )
    store, file = tmp_path / "store", tmp_path / "a.csv"
    wq.run(study, cases=2, store=store, on="serial")
    code, said, _ = wavequake("export", store, file)
    assert code == 0
    assert str(file) in said
    with file.open(encoding="utf-8", newline="") as text:
        rows = list(csv.DictReader(text))
    raw = wq.open_store(store).wfe_rms_raw.to_numpy()
    found = [float(row["wfe_rms_raw_rms (nm)"]) for row in rows]
    np.testing.assert_allclose(found, np.linalg.norm(raw, axis=1) / np.sqrt(2), rtol=1e-14)
    code, _, _ = wavequake("export", store, file)
    assert code == 2


def test_controllers_have_columns_by_name(tmp_path):
    values = np.arange(6.0).reshape(2, 3)
    dataset = xr.Dataset(
        {"peak_to_peak": (("case", "controller"), values, {"units": "%"})},
        {"case": [0, 1], "controller": ["FF", "FI", "FF+FI"], "springs": ("case", ["initial", "changed"])},
    )
    with export(dataset, tmp_path / "lens.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["springs"] for row in rows] == ["initial", "changed"]
    for index, name in enumerate(("FF", "FI", "FF+FI")):
        assert [float(row[f"peak_to_peak_{name} (%)"]) for row in rows] == values[:, index].tolist()
