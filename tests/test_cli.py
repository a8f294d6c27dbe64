"""The command line as a user meets it: exit codes, sentences, and that repeating is safe."""

import json
import os
import shlex
import subprocess
import sys
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from small_pistons import STUDY

import wavequake as wq
from wavequake import terminal
from wavequake.bundled import bundled_studies, bundled_titles
from wavequake.campaign.store.manifest import read_manifest, write_manifest
from wavequake.commands import stores
from wavequake.kernels.device import opencl
from wavequake.workflows.run import finished_study
from wavequake.workflows.study import load_study


@pytest.fixture
def tiny(tmp_path):
    path = tmp_path / "tiny.toml"
    path.write_text(STUDY)
    return path


@pytest.fixture
def done(tiny, tmp_path):
    """Give a store of four cases of the study, without a report."""
    wq.run(tiny, cases=4, store=tmp_path / "store", on="serial")
    return tmp_path / "store"


def run_tiny(wavequake, tiny, store, *words):
    return wavequake("run", tiny, *words, "--store", store, "--on", "serial")


def test_run_repeat_extend_status_verify_report(wavequake, tiny, tmp_path):
    store = tmp_path / "store"
    code, out, _ = run_tiny(wavequake, tiny, store, "campaign.cases=6")
    assert code == 0
    assert "6 cases computed" in out
    assert "pistons" in out
    assert (store / "report.html").stat().st_size > 10_000
    first = wq.open_store(store).load()

    code, again, _ = run_tiny(wavequake, tiny, store, "campaign.cases=6")
    assert code == 0
    assert "nothing was computed" in again
    assert "The store holds" not in again
    assert again[again.index("disturbance") :] == out[out.index("disturbance") :]
    code, out, _ = run_tiny(wavequake, tiny, store, "campaign.cases=4")
    assert code == 0
    assert "The store holds 6 cases: table and report are of all, not of 4 alone." in out

    code, out, _ = run_tiny(wavequake, tiny, store, "campaign.cases=9")
    assert code == 0
    extended = wq.open_store(store).load()
    assert extended.sizes["case"] == 9
    for name in first.data_vars:
        if "case" in first[name].dims and first[name].dtype.kind == "f":
            np.testing.assert_array_equal(extended[name][:6], first[name])

    code, out, _ = wavequake("status", store)
    assert code == 0
    assert "9" in out
    assert wavequake("verify", store)[0] == 0
    code, out, _ = wavequake("report", store)
    assert code == 0
    assert "report.html" in out


def test_a_complete_store_is_shown_without_what_makes_one(wavequake, tiny, tmp_path):
    """Neither what reads or draws its numbers nor a device: its second run is a matter of a second."""
    heavy = ["dask", "distributed", "matplotlib", "pandas", "pyopencl", "xarray", "zarr"]
    words = ["run", str(tiny), "campaign.cases=6", "--store", str(tmp_path / "s"), "--on", "serial"]
    code = (
        f"import sys; sys.argv[1:] = {words}; from wavequake import cli\ntry: cli.main()\n"
        f"finally: print([one for one in {heavy} if one in sys.modules], file=sys.stderr)"
    )
    assert wavequake(*words)[0] == 0
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "nothing was computed" in told.stdout
    assert told.stderr.strip() == "[]"
    assert wavequake("status", tmp_path / "s")[0] == 0


@pytest.mark.parametrize("way", ["a file is missing", "another device", "another version", "more cases"])
def test_a_store_that_is_not_complete_is_looked_at_closely(tiny, done, way):
    device = "numpy" if way == "another device" else "auto"
    study = load_study(tiny, {"campaign.cases": 5 if way == "more cases" else 4, "campaign.device": device})
    if way == "a file is missing":
        (done / "data.zarr" / "wfe_rms" / "c.0.0").unlink()
    if way == "another version":
        manifest = read_manifest(done)
        write_manifest(done, replace(manifest, provenance={**manifest.provenance, "wavequake": "0.1"}))
    assert finished_study(study, done) is None


def test_a_complete_store_is_known_as_such(tiny, done):
    found = finished_study(load_study(tiny, {"campaign.cases": 4}), done)
    assert (found.done_before, found.computed, found.quarantined) == (4, 0, 0)
    first = finished_study(load_study(tiny, {"campaign.cases": 2}), done)
    assert first.done_before == 4  # the chunk that they are in


def test_damage_is_named_and_mended(wavequake, tiny, done):
    store = done
    wq.run(tiny, cases=8, store=store, on="serial")
    before = wq.open_store(store)["zernike"].values
    assert wavequake("verify", store)[0] == 0
    shard = next(
        path
        for path in sorted((store / "data.zarr" / "zernike").rglob("*"))
        if path.is_file() and path.name != "zarr.json"
    )
    shard.write_bytes(b"")
    code, out, _ = wavequake("verify", store)
    assert code == terminal.EXIT_DAMAGED
    assert "zernike" in out
    assert run_tiny(wavequake, tiny, store, "campaign.cases=8")[0] == 0
    assert wavequake("verify", store)[0] == 0
    np.testing.assert_array_equal(wq.open_store(store)["zernike"].values, before)
    flipped = bytearray(shard.read_bytes())
    flipped[len(flipped) // 2] ^= 1
    shard.write_bytes(flipped)
    assert wavequake("verify", store)[0] == terminal.EXIT_DAMAGED
    assert run_tiny(wavequake, tiny, store, "campaign.cases=8", "--repair")[0] == 0
    assert wavequake("verify", store)[0] == 0
    np.testing.assert_array_equal(wq.open_store(store)["zernike"].values, before)


def test_a_flipped_bit_is_named_by_the_report(wavequake, tiny, done):
    shard = next((done / "data.zarr" / "strehl").glob("c*"))
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 1
    shard.write_bytes(content)
    for words in (["report", done], ["run", tiny, "campaign.cases=4", "--store", done, "--on", "serial"]):
        code, _, err = wavequake(*words)
        assert code == terminal.EXIT_DAMAGED
        assert "strehl, cases 0 to 3" in err


def test_plan_says_what_it_would_take_and_stores_nothing(wavequake, tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = wavequake("plan", tiny, "campaign.cases=10")
    assert code == 0
    for word in ("10 in 3 chunks of 4", "kB per case", "estimate"):
        assert word in out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tiny.toml"]


def test_titles_of_studies_are_those_of_their_files():
    """Though no more of a file is parsed than the table that has it."""
    whole = {
        name: tomllib.loads(path.read_text(encoding="utf-8")) for name, path in bundled_studies().items()
    }
    assert bundled_titles() == {name: one["study"].get("title", "") for name, one in whole.items()}


@pytest.mark.parametrize(
    ("words", "unneeded"),
    [
        ("studies", {"numpy"}),
        ("--version", {"numpy"}),
        ("info double-gauss", {"charset_normalizer", "numpy.f2py.crackfortran"}),
    ],
)
def test_commands_load_little(words, unneeded):
    """What takes long to load and is not needed is not loaded."""
    code = (
        f"import sys; sys.argv = ['wavequake', *{words!r}.split()]\n"
        "from wavequake.__main__ import main\n"
        "try:\n    main()\n"
        "finally:\n    print(*sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout
    loaded = set(done.stderr.split())
    assert "wavequake.cli" in loaded
    assert not loaded & unneeded


def test_studies_devices_and_version(wavequake):
    code, out, _ = wavequake("studies")
    assert code == 0
    assert "tmt-segments" in out
    assert "jwst-segments" in out
    code, out, _ = wavequake("devices")
    assert code == 0
    assert "numpy" in out.lower()
    assert wavequake("--version")[1].split() == ["wavequake", wq.__version__]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["run", "tmt-segment"], "tmt-segments"),
        (["run", "TINY", "campaign.casse=1"], "'cases'"),
        (["run", "TINY", "campaign.cases=-1"], "greater than or equal to 1"),
        (["run", "TINY", "optics.wavelength_nm=0"], "optics.wavelength_nm"),
        (["run", "TINY", "campaign.device=abacus"], "abacus"),
        (["run", "TINY", "optics.sampling=sunflower", "optics.rays=10"], "ray"),
        (["run", "TINY", "optics.field_arcmin=[600.0, 0.0]"], "optics.field_arcmin"),
        (["run", "TINY", "--on", "moon"], "moon"),
        (["status", "nowhere"], "nowhere"),
        (["verify", "nowhere"], "nowhere"),
        (["report", "nowhere"], "nowhere"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(wavequake, tiny, tmp_path, monkeypatch, words, sentence):
    monkeypatch.chdir(tmp_path)
    code, _, err = wavequake(*[str(tiny) if word == "TINY" else word for word in words])
    assert code == terminal.EXIT_BAD_INPUT
    assert sentence in err
    assert "Traceback" not in err
    assert len(err.strip().splitlines()) == 1


def test_output_that_is_closed_or_has_no_greek_does_no_harm(done):
    python = f"{shlex.quote(sys.executable)} -m wavequake"
    store = shlex.quote(str(done))
    for command in (f"PYTHONIOENCODING=ascii {python} report {store}", f"{python} status {store} >&-"):
        done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(("columns", "width"), [("40", 40), ("0", 110), ("", 110)])
def test_a_pipe_is_as_wide_as_columns_asks_for(columns, width):
    command = [sys.executable, "-m", "wavequake", "studies"]
    environment = {**os.environ, "COLUMNS": columns}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert 0.9 * width <= max(map(len, done.stdout.splitlines())) <= width


@pytest.mark.parametrize("place", [0, 1, 2])
def test_debug_shows_the_traceback_wherever_it_stands(wavequake, place):
    words = ["run", "no-such-study"]
    words.insert(place, "--debug")
    code, _, err = wavequake(*words)
    assert code == terminal.EXIT_BAD_INPUT
    assert "Traceback" in err


def test_a_store_of_another_study_is_refused_and_left_alone(wavequake, tiny, done):
    manifest = (done / "manifest.json").read_bytes()
    code, _, err = run_tiny(wavequake, tiny, done, "campaign.cases=4", "study.seed=5")
    assert code == terminal.EXIT_BAD_INPUT
    assert "seed" in err
    assert (done / "manifest.json").read_bytes() == manifest


def test_a_store_that_cannot_be_written_says_so(wavequake, tiny, tmp_path):
    (tmp_path / "file").write_text("not a folder")
    code, _, err = run_tiny(wavequake, tiny, tmp_path / "file" / "store", "campaign.cases=2")
    assert code == terminal.EXIT_BAD_INPUT
    assert "file" in err


def test_no_plan_ends_a_process_that_is_anothers(wavequake, tiny, monkeypatch):
    """Where it is the command's own, it ends with a last word; here it would end the tests."""
    seen = []
    monkeypatch.setattr("wavequake.workflows.planning.plan.planned", lambda *given: seen.append(given) or {})
    assert wavequake("plan", tiny)[0] == 0
    ((_, seconds, _, last_word),) = seen
    assert seconds > 5.0
    assert last_word is None


def test_quarantined_cases_end_with_exit_code_3_and_their_reason(wavequake, tiny, tmp_path):
    store = tmp_path / "store"
    code, out, err = run_tiny(
        wavequake, tiny, store, "campaign.cases=3", "disturbance.pistons.in_plane_um=4e6"
    )
    assert code == terminal.EXIT_QUARANTINED
    assert "3 cases are quarantined" in err
    code, out, _ = wavequake("status", store)
    assert "lost all its rays" in out


@pytest.mark.parametrize("name", ["sp ace", "back\\slash", 'it\'s "q"', "[bold]ünï"])
def test_a_store_may_have_any_name(wavequake, tiny, tmp_path, name):
    code, out, _ = run_tiny(wavequake, tiny, tmp_path / name, "campaign.cases=1")
    assert code == 0
    assert out.count(name) == 2
    assert wq.open_store(tmp_path / name).sizes["case"] == 1


def test_a_report_that_was_cut_off_is_written_by_the_next_run(wavequake, tiny, tmp_path, monkeypatch):
    run_tiny(wavequake, tiny, tmp_path / "store", "campaign.cases=2")
    report = tmp_path / "store" / "report.html"
    before = report.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(stores, "write_report", lambda store, fresh: None)
        run_tiny(wavequake, tiny, tmp_path / "store", "campaign.cases=6")
    assert report.read_bytes() == before
    assert run_tiny(wavequake, tiny, tmp_path / "store", "campaign.cases=6")[0] == 0
    assert report.read_bytes() != before


def test_a_store_is_reported_where_its_device_is_missing(wavequake, done, monkeypatch):
    monkeypatch.setattr(opencl, "_found", lambda: ())
    code, out, _ = wavequake("report", done)
    assert code == 0
    assert "pistons" in out


def test_without_opencl_the_user_learns_what_to_install(wavequake, tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(opencl, "_found", lambda: ())
    code, _, err = run_tiny(wavequake, tiny, tmp_path / "store", "campaign.cases=2")
    assert code == terminal.EXIT_BAD_INPUT
    assert "pip install pocl-binary-distribution" in err
    assert "campaign.device=numpy" in err
    code, out, _ = run_tiny(wavequake, tiny, tmp_path / "store", "campaign.cases=2", "campaign.device=numpy")
    assert code == 0
    assert "2 cases computed" in out


def test_from_python(tiny, tmp_path):
    ds = wq.run(tiny, cases=3, store=tmp_path / "store", optics__wavelength_nm=1000.0)
    assert ds.wfe_rms_raw.dims == ("case", "time")
    assert ds.wfe_rms_raw.attrs["units"] == "nm"
    assert json.loads(ds.attrs["study"])["optics"]["wavelength_nm"] == 1000.0
    assert wq.open_store(tmp_path / "store").identical(ds)
    assert "run" in dir(wq)
    with pytest.raises(wq.UserError, match="nearest valid key"):
        wq.run(tiny, optics__wavelength=1.0)


def test_help_puts_every_command_into_a_group(wavequake):
    code, out, _ = wavequake("--help")
    assert code == 0
    assert "─ Commands ─" not in out
    for group in ("Begin", "Run", "Decide", "Measurements", "Machines"):
        assert f"─ {group}" in out
