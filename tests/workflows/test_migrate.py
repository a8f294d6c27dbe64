"""Studies and stores of version 0.1: files mean what they meant, and stores are told apart."""

import json
from pathlib import Path

import pytest
import toy

import wavequake as wq
from wavequake.campaign.store import manifest as manifests
from wavequake.campaign.store.layout import refuse_older
from wavequake.errors import UserError

OLD = Path(__file__).parents[1] / "data" / "studies-0.1"
FILES = sorted(OLD.glob("*.toml"))


def entries(record, prefix=""):
    """Yield every entry of a record by its key; lists of tables by their names."""
    for key, value in record.items():
        if isinstance(value, dict):
            yield from entries(value, f"{prefix}{key}.")
        elif isinstance(value, list) and value and all(isinstance(one, dict) for one in value):
            for place, one in enumerate(value):
                yield from entries(one, f"{prefix}{key}.{one.get('name', place)}.")
        else:
            yield f"{prefix}{key}", value


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_study_files_of_0_1_say_what_they_said(file):
    """The bundled studies of that version, against what it read in them."""
    then = dict(entries(json.loads((OLD / "read_by_0.1.json").read_text())[file.stem]))
    now = dict(entries(json.loads(wq.load_study(file).identity_text())))
    assert {key: now.get(key) for key in then} == then
    assert all(now[key] in (None, []) for key in now.keys() - then.keys())  # what is new is off


def test_every_bundled_study_of_0_1_is_here():
    assert len(FILES) == 14
    assert {file.stem for file in FILES} == set(json.loads((OLD / "read_by_0.1.json").read_text()))


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("mirror-mor", ["reduction.variants"]),
        ("tmt-segments", ["imaging"]),
        ("tmt-exposure", []),
        ("lens-experiment", []),
    ],
)
def test_what_comes_out_otherwise_is_said_by_key(wavequake, name, keys):
    code, said, _ = wavequake("migrate", OLD / f"{name}.toml")
    lines = said.splitlines()
    assert code == 0
    assert lines[0].startswith(f"No key of {name} has moved or means something else than in 0.1")
    assert [line.split(":")[0] for line in lines[1:]] == keys
    assert lines == wq.migrate(OLD / f"{name}.toml")


def test_apertures_of_lens_files_that_were_paraxial_are_named(tmp_path):
    lens = OLD.parent / "lenses" / "ray_optics_us05831776_1.zmx"
    text = (OLD / "double-gauss.toml").read_text().replace('name = "double-gauss"', f'file = "{lens}"', 2)
    (tmp_path / "a.toml").write_text(text.replace(f'file = "{lens}"', 'name = "mine"', 1))
    wanted = ["system.file: a numerical aperture in object space (OBNA) is that of real rays"]
    assert [line.split(",")[0] for line in wq.migrate(tmp_path / "a.toml")[1:]] == wanted


def test_a_file_that_is_no_study_is_one_sentence(wavequake, tmp_path):
    (tmp_path / "a.toml").write_text((OLD / "tmt-segments.toml").read_text() + "\n[optix]\nrays = 5\n")
    code, _, told = wavequake("migrate", tmp_path / "a.toml")
    assert code == 2
    assert "'optix' is unknown; the nearest valid key is 'optics'" in " ".join(told.split())


@pytest.fixture
def old(tmp_path):
    """A store that claims to be of 0.1, and to lack a number."""
    path = tmp_path / "s"
    toy.run(path, cases=10)
    file = path / "manifest.json"
    entry = json.loads(file.read_text())
    del entry["checksum"]
    entry["variables"] = [name for name in entry["variables"] if name != "strehl"]
    entry["provenance"]["wavequake"] = "0.1.0"
    file.write_text(json.dumps(manifests.sealed(entry)))
    return path


def test_stores_of_other_versions_are_told_apart_by_what_they_lack(old):
    manifest = manifests.read_manifest(old)
    with pytest.raises(
        UserError, match=r"made by Wavequake 0\.1\.0, which stored no 'strehl': status, verify"
    ):
        refuse_older(old, manifest, lambda _: toy.TOY)
    with pytest.raises(UserError, match="which stored no 'strehl'"):
        toy.run(old, cases=20)
    toy.run(old.parent / "own", cases=10)
    refuse_older(old.parent / "own", manifests.read_manifest(old.parent / "own"), lambda _: toy.TOY)


def test_a_run_says_which_version_made_the_store_of_another_study(old):
    with pytest.raises(UserError, match=r"another study, made by Wavequake 0\.1\.0: seed"):
        manifests.refuse_other(old, manifests.read_manifest(old), "toy", '{"seed":1}', "cpu")


def test_reports_reruns_and_views_refuse_what_they_cannot_read(old, monkeypatch, wavequake):
    for module in ("wavequake.report.campaign", "wavequake.report.exports.rerun", "wavequake.viewer.view"):
        monkeypatch.setattr(f"{module}.find_kind", lambda name: toy.TOY)
    monkeypatch.setattr("wavequake.viewer.view._MAKERS", {"toy": None})
    for words in (("report", old), ("rerun", old, "--case", 3), ("view", old)):
        code, _, told = wavequake(*words)
        assert code == 2, words
        assert "made by Wavequake 0.1.0, which stored no 'strehl'" in " ".join(told.split()), words
