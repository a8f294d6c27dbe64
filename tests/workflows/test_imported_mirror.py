"""A plate from CalculiX through mirror-mor and mirror-trace: what a user brings."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from wavequake import cli
from wavequake.campaign.store.store import open_store
from wavequake.commands import stores
from wavequake.errors import UserError
from wavequake.report.campaign import summary_table
from wavequake.workflows.mirrors import model_store
from wavequake.workflows.mirrors.trace import KIND
from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study

DATA = Path(__file__).parents[1] / "data"
PLATE = {
    "model.file": "plate.sti",
    "model.units": "m,kg,s,N",
    "model.interfaces": "INTERFACES",
    "model.surface": "SURFACE",
    "optics.focal_length_m": 1.7,
    "reduction.variants": ["craigb18", "rubin18"],
    "reduction.frequencies": 12,
    "imaging.pixels": 8,
    "imaging.pupil_samples": 16,
    "imaging.instants": 3,
    "time.duration_s": 0.005,
}


@pytest.fixture(autouse=True)
def models(tmp_path_factory, monkeypatch):
    folder = tmp_path_factory.getbasetemp() / "plate-models"
    monkeypatch.setattr(model_store, "model_folder", lambda: folder)


def _words(keys):
    return [f"{key}={value}".replace("'", '"') for key, value in keys.items()]


def test_a_file_named_on_the_command_line_lies_in_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(DATA)
    words = ["run", "mirror-mor", *_words(PLATE), "--on", "serial", "--store", str(tmp_path / "s")]
    monkeypatch.setattr(sys, "argv", ["wavequake", *words])
    monkeypatch.setattr(stores, "write_report", lambda *_, **__: None)
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert not end.value.code
    store = open_store(tmp_path / "s")
    assert list(store["model"].values) == ["file"] * 3
    assert list(store["variant"].values) == ["full", "craigb18", "rubin18"]
    assert (store["status"] == 1).all()
    assert float(store["spot_error"].max()) < 1e-6
    assert " (plate) off full-size" in summary_table(tmp_path / "s").caption
    assert summary_table(tmp_path / "s").columns[0]._cells[0].plain == "plate"
    for ending in ("sti", "mas", "dof", "inp"):  # the name is that of the file that was imported last
        shutil.copy(f"plate.{ending}", tmp_path / f"my disc.{ending}")
    load_study("mirror-mor", PLATE | {"model.file": str(tmp_path / "my disc.sti")})
    assert " (my-disc) off full-size" in summary_table(tmp_path / "s").caption
    monkeypatch.setattr(model_store, "model_folder", lambda: tmp_path / "none")
    assert " (file) off full-size" in summary_table(tmp_path / "s").caption


def test_its_frequencies_are_those_that_calculix_prints(tmp_path, monkeypatch):
    """K of C3D20R and M of C3D20: 104 Hz is the free plate's first elastic mode (Kirchhoff: 104.3 Hz)."""
    monkeypatch.chdir(DATA)
    study = load_study("mirror-mor", PLATE)
    run_study(study, tmp_path / "s", on="serial")
    frequencies = open_store(tmp_path / "s")["mode_frequency"].isel(case=0).values
    assert (frequencies[:6] < 1e-3).all()
    assert frequencies[6] == pytest.approx(104.3, rel=0.06)


def test_the_path_is_no_part_of_the_identity(tmp_path, monkeypatch):
    monkeypatch.chdir(DATA)
    here = load_study("mirror-mor", PLATE)
    for ending in ("sti", "mas", "dof", "inp"):
        (tmp_path / f"disc.{ending}").write_bytes((DATA / f"plate.{ending}").read_bytes())
    monkeypatch.chdir(tmp_path)
    there = load_study("mirror-mor", PLATE | {"model.file": "disc.sti"})
    assert there.identity() == here.identity()
    beside = tmp_path / "study.toml"
    text = (DATA.parents[1] / "workflows" / "mirror-mor.toml").read_text()
    beside.write_text(text.replace("[model]\nshapes", '[model]\nfile = "disc.sti"\nshapes'))
    monkeypatch.chdir(DATA)
    keys = {key: value for key, value in PLATE.items() if key != "model.file"}
    assert load_study(beside, keys).identity() == here.identity()
    # A file that lies beside the study, too, but not in the current folder.
    monkeypatch.chdir(DATA.parent)
    assert load_study(beside, keys | {"model.file": "disc.sti"}).identity() == here.identity()


def test_mirror_trace_takes_it_too(monkeypatch):
    monkeypatch.chdir(DATA)
    keys = {key: value for key, value in PLATE.items() if not key.startswith("imaging")}
    keys.pop("reduction.frequencies")
    study = load_study("mirror-trace", keys | {"reduction.variants": ["craigb18"]})
    result = KIND.compute(study.identity_text(), np.arange(1), "auto")
    apart = result.arrays["wfe_difference"].max() / result.arrays["wfe_rms_standard"].max()
    assert apart < 1e-3


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"model.units": "furlong,kg,s,N"}, "furlong"),
        ({"model.interfaces": "NOWHERE"}, "NOWHERE"),
        ({"model.interfaces": [24, 29]}, "interface"),
        ({"model.interfaces": [11, 1, 5]}, "lie on a line"),
        ({"model.surface": []}, "surface"),
        ({"model.file": "plate.xyz"}, "no reader for .xyz"),
        ({"model.file": "absent.sti"}, "absent"),
        ({"optics.focal_length_m": -1.0}, "focal_length_m"),
    ],
)
def test_bad_models_are_one_sentence_and_exit_code_2(keys, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(DATA)
    words_of = ["run", "mirror-mor", *_words(PLATE | keys), "--on", "serial", "--store", str(tmp_path / "s")]
    monkeypatch.setattr(sys, "argv", ["wavequake", *words_of])
    with pytest.raises(SystemExit) as end:
        cli.main()
    message = capsys.readouterr().err.strip()
    assert end.value.code == 2
    assert words in message
    assert message.count("\n") == message.count(". ") == 0
    assert not (tmp_path / "s").exists()


def test_a_flat_plate_without_a_focal_length_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(DATA)
    study = load_study("mirror-mor", {k: v for k, v in PLATE.items() if k != "optics.focal_length_m"})
    with pytest.raises(UserError, match="say with optics"):
        run_study(study, tmp_path / "s", on="serial")
