"""`wavequake new`: what it writes can be run, and says what was found; names complete in a shell."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import wavequake as wq
from wavequake.workflows.new_study import glass_groups
from wavequake.workflows.study import bundled_studies, load_study

DATA = Path(__file__).parent / "data"


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("cooke_triplet.zmx", *(f"plate.{end}" for end in ("sti", "mas", "dof", "inp"))):
        shutil.copy(DATA / name, tmp_path)


@pytest.mark.parametrize(
    "source",
    ["euv", "six-lens", "gregorian", "tmt-18", "jwst", "cooke_triplet.zmx", "plate.sti", "mirror-mor"],
)
def test_what_is_begun_is_a_study(source, wavequake):
    code, out, err = wavequake("new", source)
    assert code == 0, err
    path = Path(f"{source.partition('.')[0]}.toml")
    assert load_study(path).cases > 0
    assert path.read_text().startswith("# A ")
    assert f"wavequake plan {path.name}" in out
    code, _, err = wavequake("new", source)
    assert (code, "exists; name another file" in err) == (2, True)


def test_lenses_are_found_by_their_glass():
    """Bodies of the bundled study of the double Gauss lens, and the three lenses of a Cooke triplet."""
    bodies = load_study("double-gauss").body
    assert glass_groups(wq.load_system("double-gauss")) == [list(body.surfaces) for body in bodies]
    assert [len(group) for group in glass_groups(wq.load_system("cooke_triplet.zmx"))] == [2, 2, 2]
    assert glass_groups(wq.load_system("euv")) == []


def test_bodies_are_called_what_their_surfaces_are(wavequake):
    """Rubin's filter and its third lens keep their names; surfaces that are numbered make numbered lenses."""
    assert wavequake("new", "rubin")[0] == 0
    assert "2 fields: (0, 0) deg; (0, 1) deg" in Path("rubin.toml").read_text()
    bodies = {body.name: list(body.surfaces) for body in load_study("rubin.toml").body}
    assert bodies == {name: [f"{name} front", f"{name} back"] for name in ("L1", "L2", "filter", "L3")}
    assert wavequake("new", "cooke_triplet.zmx")[0] == 0
    assert [body.name for body in load_study("cooke_triplet.toml").body] == ["L1", "L2", "L3"]


def test_a_begun_study_runs(wavequake):
    assert wavequake("new", "cooke_triplet.zmx", "-o", "mine.toml")[0] == 0
    ds = wq.run("mine.toml", cases=4, store="mine", optics__rays=60, wavefront__zernike_terms=11).load()
    assert (ds.status == 1).all()
    assert float(ds.wfe_change.max()) > 0.0


def test_a_model_says_its_sets_and_the_guess_of_its_units(wavequake):
    assert wavequake("new", "plate.sti")[0] == 0
    text = Path("plate.toml").read_text()
    assert "#   SURFACE: 34 nodes" in text
    assert 'units = "m,kg,s,N"  # A GUESS' in text
    assert 'interfaces = "INTERFACES"' in text
    scaled = Path("plate.inp").read_text().splitlines()
    start = next(k for k, line in enumerate(scaled) if line.startswith("*NODE")) + 1
    for k in range(start, start + 81):
        number, *place = scaled[k].split(",")
        scaled[k] = ", ".join([number, *(f"{1e3 * float(x):.9e}" for x in place)])
    Path("plate.inp").write_text("\n".join(scaled) + "\n")
    assert wavequake("new", "plate.sti", "-o", "mm.toml")[0] in (0, 2)
    assert 'units = "mm,t,s,N"' in Path("mm.toml").read_text()


def test_a_model_whose_sets_have_other_names_is_begun_and_says_what_to_set(wavequake):
    for end in ("sti", "mas", "dof", "inp"):
        shutil.copy(DATA / f"tetrahedra.{end}", ".")
    code, out, err = wavequake("new", "tetrahedra.sti")
    assert (code, err) == (0, "")
    assert "To be edited before it runs: tetrahedra.inp has no node set" in out
    assert "(interfaces); it has: ALL, BODY, TOP" in out
    assert "carry forces: TO BE SET" in Path("tetrahedra.toml").read_text()
    with pytest.warns(UserWarning, match="two.toml has to be edited before it runs: "):
        wq.new("tetrahedra.sti", "two.toml")
    text = Path("tetrahedra.toml").read_text().replace("NAME OF A NODE SET", "BODY")
    Path("tetrahedra.toml").write_text(text)
    assert load_study("tetrahedra.toml").model.interfaces == "BODY"


def test_a_flat_plate_finds_the_key_that_its_plan_asks_for(wavequake):
    code, out, _ = wavequake("new", "plate.sti")
    assert code == 0
    assert "To be edited before it runs: the optical surface of the imported model is flat" in out
    assert "optics.focal_length_m which parabola it stands for" in out
    code, *said = wavequake("plan", "plate.toml")
    assert code == 2
    assert "optics.focal_length_m" in " ".join(map(str, said))
    text = Path("plate.toml").read_text()
    assert "# [optics]\n# focal_length_m = " in text
    study = text.replace("# [optics]", "[optics]").replace("# focal_length_m", "focal_length_m")
    Path("curved.toml").write_text(study)
    assert load_study("curved.toml").optics.focal_length_m == 1.0


def test_there_is_no_wind_in_space(wavequake):
    assert wavequake("new", "jwst")[0] == 0
    assert "wind" not in Path("jwst.toml").read_text()
    assert wavequake("new", "tmt-18")[0] == 0
    assert "segment-wind" in Path("tmt-18.toml").read_text()


def test_what_is_not_there_is_said(wavequake):
    for words, said in (
        (("new", "nothing"), "nothing called 'nothing'"),
        (("new", "no.sti"), "There is no file no.sti"),
        (("run", "no.toml"), "The file no.toml does not exist"),
        (("plan", "no/study"), "The file no/study does not exist"),
        (("run", "tmt-segment"), "did you mean 'tmt-segments'"),
    ):
        code, _, err = wavequake(*words)
        assert code == 2
        assert said in err, err


def test_names_complete_in_a_shell():
    def offered(words):
        asked = {
            "_WAVEQUAKE_COMPLETE": "complete_bash",
            "COMP_WORDS": f"wavequake {words}",
            "COMP_CWORD": str(len(words.split(" "))),
        }
        done = subprocess.run(
            [sys.executable, "-c", "from wavequake.cli import app; app(prog_name='wavequake')"],
            env={**os.environ, **asked},
            capture_output=True,
            text=True,
            check=False,
        )
        return done.stdout.split()

    assert offered("run tmt-mi") == ["tmt-million"]
    assert "tmt-million" in bundled_studies()
    for command in ("draw", "new"):
        assert offered(f"{command} ke") == ["keck"]
    assert offered("run euv --on se") == ["serial"]
    assert offered("report runs/a --format ") == ["gif", "mp4"]


def test_completion_is_installed_under_the_program_s_name(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "wavequake", "--show-completion", "zsh"],
        env={**os.environ, "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.startswith("#compdef wavequake\n")
