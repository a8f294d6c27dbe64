"""Documentation that runs: snippets are executed, tables are made from the code."""

import importlib.util
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks.measured import named_tests

from wavequake.workflows.study import load_study

ROOT = Path(__file__).parents[1]
# What the commands do not speak of and takes long on one processor.
SMALLER = {
    "mirror-mor": ["reduction.frequencies=24", "time.duration_s=0.005", "imaging.pupil_samples=32"],
    "tmt-segment-mor": ["reduction.frequencies=24", "time.traced=16"],
}
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES = [page for page in PAGES if page.name != "gallery.md"]  # made by make_site.py
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), flags=re.M | re.S)


def commands(page):
    lines = [
        line for block in blocks(page, "console") for line in block.splitlines() if line.startswith("$ ")
    ]
    return [line[2:] for line in lines if line.startswith("$ wavequake")]


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "python")], ids=lambda page: page.name)
def test_python_snippets_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in blocks(page, "python"):
        exec(compile(block, page.name, "exec"), names)


def follow(command, wavequake):
    """Run a command of a page; runs are made smaller and serial."""
    words = shlex.split(re.sub(r"(?<= campaign\.cases=)(\d+)\b", lambda m: f"{int(m[1]) // 10}", command))
    if words[1] == "run":
        cases = next((int(word[15:]) for word in words if word.startswith("campaign.cases=")), 0)
        chunk = f"store.chunk_cases={max(4, cases // 10)}"
        words += [*SMALLER.get(words[2], []), chunk, "--on", "serial"]
    code, _, complained = wavequake(*words[1:])
    assert code == 0, (command, complained)


@pytest.mark.parametrize("page", [p for p in PAGES if commands(p)], ids=lambda page: page.name)
def test_commands_run(page, tmp_path, monkeypatch, wavequake):
    """The commands of a page, in order, in one folder."""
    monkeypatch.chdir(tmp_path)
    for command in commands(page):
        follow(command, wavequake)


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_tutorials_run(page, tmp_path, monkeypatch, wavequake):
    """Commands and snippets of a tutorial in order; they write the pictures that it shows."""
    monkeypatch.chdir(tmp_path)
    names = {}
    text = page.read_text()
    for language, block in re.findall(r"^```(console|python)\n(.*?)^```", text, flags=re.M | re.S):
        if language == "python":
            exec(compile(block, page.name, "exec"), names)
        for line in block.splitlines() if language == "console" else ():
            follow(line.removeprefix("$ "), wavequake)
    shown = re.findall(r"!\[[^]]+\]\(\.\./pictures/([^)]+)\)", text)
    assert shown
    assert set(shown) <= {picture.name for picture in tmp_path.glob("*.png")}


@pytest.mark.parametrize("text", [block for page in PAGES for block in blocks(page, "toml")])
def test_study_files_load(text, tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(text)
    assert load_study(path).cases > 0


def test_links_lead_somewhere():
    for page in [*PAGES, *TUTORIALS]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            if "://" not in target:
                assert (page.parent / target).exists(), (page.name, target)


def test_the_site_builds_without_a_warning(tmp_path):
    """All but the gallery, whose reports `make docs` computes."""
    pytest.importorskip("sphinx", reason="needs: pip install 'wavequake[docs]'")
    shutil.copytree(ROOT / "docs", tmp_path / "docs", ignore=shutil.ignore_patterns("_site"))
    (tmp_path / "docs" / "_site" / "extra").mkdir(parents=True)
    (tmp_path / "docs" / "gallery.md").write_text("# Gallery\n")
    for folder in ("workflows", "tests", "cluster", "benchmarks", "firmware", "pipeline"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    build = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    made = subprocess.run(
        [*build, str(tmp_path / "docs"), str(tmp_path / "site")], capture_output=True, text=True
    )
    assert made.returncode == 0, made.stderr
    assert "craigb36" in (tmp_path / "site" / "tutorials" / "reduction.html").read_text()
    assert "wavequake.run" in (tmp_path / "site" / "api.html").read_text()


def test_the_reference_of_keys_is_what_the_code_says():
    spec = importlib.util.spec_from_file_location(
        "make_study_reference", ROOT / "docs" / "make_study_reference.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    made = (ROOT / "docs" / "study.md").read_text().split(module.MARK)[1].strip()
    assert made == module.reference().strip(), "run python docs/make_study_reference.py"


def test_the_tests_that_the_page_on_validation_names_exist():
    named = set(re.findall(r"`([a-z_]+/test_\w+\.py)(?:::(\w+))?", (ROOT / "docs/validation.md").read_text()))
    assert len(named) > 30
    for file, test in named:
        path = ROOT / "tests" / file
        assert path.is_file(), file
        assert f"def {test}" in path.read_text(), f"{file}::{test}"


def test_validation_names_tests_that_there_are_and_a_figure_in_every_row():
    text = (ROOT / "docs" / "validation.md").read_text(encoding="utf-8")
    for name in named_tests():
        file, _, function = name.partition("::")
        assert (ROOT / file).exists(), name
        assert not function or f"def {function}(" in (ROOT / file).read_text(encoding="utf-8"), name
    table = text.partition("## Quantities")[2].partition("\n\n")[0]
    rows = [line.split(" | ") for line in table.splitlines()[3:]]
    assert len(rows) > 80
    assert not [row[0] for row in rows if len(row) != 5 or not re.search(r"\d|equal|all|none|every", row[3])]


def test_what_tests_compare_is_measured():
    """The index of silica is off by 3.7e-6 of the 1e-5 that are allowed."""
    test = "tests/optics/test_media.py::test_silica_against_measured_indices"
    command = [sys.executable, "-m", "benchmarks.measured", test]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert re.search(r"3\.7e-06 of +1\.0e-05 = 36\.9%", said), said
