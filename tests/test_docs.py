"""Documentation that runs: snippets are executed, tables are made from the code."""

import importlib.util
import json
import re
import shlex
import shutil
import subprocess
import sys
from base64 import b64decode
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest
from benchmarks.measured import named_tests

import wavequake as wq
from wavequake import cli
from wavequake.workflows.run import kind_of
from wavequake.workflows.study import load_study, study_with

ROOT = Path(__file__).parents[1]
# What the commands do not speak of and takes long on one processor.
RAYS = "optics.rays=120"
SMALLER = {
    "double-gauss": [
        *(RAYS, "imaging.pixels=16", "system.wavelengths_nm=[587.6]"),
        *("disturbance.vibration.instants=8", "disturbance.all.instants=8"),
    ],
    "euv-allowances": [RAYS],
    "lens-experiment": ["time.duration_s=2.0", "time.step_ms=20.0"],
    "mirror-mor": ["reduction.frequencies=24", "time.duration_s=0.003", "imaging.pupil_samples=32"],
    "mirror-trace": [RAYS, "time.duration_s=0.003"],
    "telescope-structure": [
        *("body.primary.mirror.rings=2", "body.secondary.mirror.rings=2", "body.tube.beams.pieces=1"),
        *("disturbance.floor.instants=16", "disturbance.wheel.instants=16", "disturbance.all.instants=16"),
        *("reduction.variants=['craigb24']", "imaging.pixels=16", RAYS),
    ],
    "tmt-segment-mor": ["reduction.frequencies=24", "time.traced=16"],
    "tmt18-history": ["optics.rays=400", "imaging.pixels=16", "disturbance.history.instants=8"],
}
# Meshes of studies that are only checked, by what stands in their text.
MESHES = {"\n[segment]\n": "segment.divisions", '"m2-body"': "actuator.mirror.divisions"}
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
    # What a page registers may be registered again by other tests that take it as a plug-in.
    names = {"__name__": f"wavequake_plugin_{page.stem}"}
    for block in blocks(page, "python"):
        exec(compile(block, page.name, "exec"), names)


def follow(command, wavequake):
    """Run a command of a page; studies are made smaller and runs serial."""
    few = re.sub(r"(?<= campaign\.cases=)\d+\b", lambda m: f"{int(m[0]) // 10}", command)
    words = shlex.split(re.sub(r"(?<= --cases )\d{3,}\b", lambda m: f"{int(m[0]) // 2}", few))
    if words[1] in ("run", "plan", "allow", "budget"):
        said = [word.partition("=")[0] for word in words]
        words += [key for key in SMALLER.get(words[2], []) if key.partition("=")[0] not in said]
    if words[1] == "run":
        cases = next((int(word[15:]) for word in words if word.startswith("campaign.cases=")), 0)
        words += [f"store.chunk_cases={max(4, cases // 10)}", "--on", "serial"]
    code, _, complained = wavequake(*words[1:])
    assert code == 0, (command, complained)


@pytest.fixture
def hasty(monkeypatch):
    """Let `plan` try first cases for a second; it has six."""
    monkeypatch.setattr(cli, "_PLAN_S", 1.0)


@pytest.mark.usefixtures("hasty", "undrawn")  # reports of every kind are drawn in tests of report and viewer
@pytest.mark.parametrize("page", [p for p in PAGES if commands(p)], ids=lambda page: page.name)
def test_commands_run(page, tmp_path, monkeypatch, wavequake):
    """The commands of a page, in order, in one folder."""
    monkeypatch.chdir(tmp_path)
    for command in commands(page):
        follow(command, wavequake)


@pytest.mark.usefixtures("hasty", "undrawn")  # of reports; what tutorials draw themselves is
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_tutorials_run(page, tmp_path, monkeypatch, wavequake):
    """Commands and snippets of a tutorial in order; they write the pictures that it shows."""
    monkeypatch.chdir(tmp_path)
    names = {}
    text = page.read_text()
    for language, block in re.findall(r"^```(console|python)\n(.*?)^```", text, flags=re.M | re.S):
        if language == "python":
            exec(compile(block.replace("rings=3", "rings=2"), page.name, "exec"), names)
        for line in block.splitlines() if language == "console" else ():
            follow(line.removeprefix("$ "), wavequake)
    shown = re.findall(r"!\[[^]]+\]\(\.\./pictures/([^)]+)\)", text)
    assert shown
    assert set(shown) <= {picture.name for picture in tmp_path.glob("*.png")}


@pytest.mark.parametrize("text", [block for page in PAGES for block in blocks(page, "toml")])
def test_study_files_are_what_a_run_takes(text, tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(text)
    study = load_study(path)
    assert study.cases > 0
    if "[sweep]" not in text:  # every point of which would be prepared
        coarse = {key: 4 for section, key in MESHES.items() if section in text}
        kind_of(study).check(study_with(study, coarse).identity_text())


def test_links_lead_somewhere():
    for page in [*PAGES, *TUTORIALS]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            if "://" not in target:
                assert (page.parent / target).exists(), (page.name, target)


def loaded(path):
    """Return a module of the documentation, which is no package."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Targets(HTMLParser):
    """Collects what a page of the site refers to."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        self.found += [value for name, value in attrs if name in ("href", "src") and value]


@pytest.mark.usefixtures("undrawn")
def test_the_site_builds_without_a_warning_and_its_links_lead_somewhere(tmp_path, monkeypatch):
    """As `make docs` does, with one short tutorial and two studies in the gallery."""
    pytest.importorskip("sphinx", reason="needs: pip install -e '.[docs]'")
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "docs", tmp_path / "docs", ignore=shutil.ignore_patterns("_site", "gallery.md"))
    for folder in ("workflows", "tests", "cluster", "benchmarks", "firmware", "pipeline"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    (tmp_path / "short.md").write_text(TUTORIAL)
    module = loaded(tmp_path / "docs" / "make_site.py")
    monkeypatch.setitem(
        module.SMALL, "tip-tilt-vibration", {"simulated.duration_s": 2.0, "campaign.cases": 4}
    )
    assert module.build(["tip-tilt-vibration"], [tmp_path / "short.md"]) == 0
    site = tmp_path / "docs" / "_site" / "html"
    assert "craigb36" in (site / "tutorials" / "reduction.html").read_text()
    assert "wavequake.run" in (site / "api.html").read_text()
    lost = []
    for page in site.rglob("*.html"):
        targets = Targets()
        targets.feed(page.read_text(encoding="utf-8"))
        for target in targets.found:
            local = unquote(target.partition("#")[0].partition("?")[0])
            if (
                "://" in target
                or target.startswith(("data:", "mailto:"))
                or not local
                or local == "view.html"
            ):
                continue
            if not (page.parent / local).exists():
                lost.append((page.name, target))
    assert lost == []
    notebook = json.loads((site / "notebooks" / "short.ipynb").read_text())
    kinds = [cell["cell_type"] for cell in notebook["cells"]]
    assert kinds == ["markdown", "code", "markdown", "code"]
    command, snippet = (cell for cell in notebook["cells"] if cell["cell_type"] == "code")
    assert command["source"] == "!wavequake studies"
    assert "double-gauss" in command["outputs"][0]["text"]
    assert snippet["outputs"][0] == {"output_type": "stream", "name": "stdout", "text": "mirror-mor\n"}
    assert b64decode(snippet["outputs"][1]["data"]["image/png"]).startswith(b"\x89PNG")
    assert len({cell["id"] for cell in notebook["cells"]}) == 4
    assert "![" not in "".join(str(cell["source"]) for cell in notebook["cells"])


TUTORIAL = """# Short

What there is:
```console
$ wavequake studies
```
![A picture](../pictures/one.png)

And drawn:
```python
import wavequake as wq

print([name for name in wq.studies() if name == "mirror-mor"][0])
wq.draw("tmt-18").savefig("one.png")
```
"""


def test_nobody_is_told_to_install_what_is_on_no_index():
    """Wavequake is installed from its folder or wheel; by its name pip would find nothing, or worse."""
    asked = re.compile(r"pip install (?:-U |--upgrade )?['\"]?wavequake(?!-)")
    texts = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    texts += [*(ROOT / "pipeline").rglob("*.py"), *(ROOT / "workflows").glob("*.toml")]
    assert [text.name for text in texts if asked.search(text.read_text(encoding="utf-8"))] == []


def test_the_reference_of_the_door_has_every_name():
    text = (ROOT / "docs/api.md").read_text()
    named = set(re.findall(r":: (?:wavequake\.(?:[\w]+\.)*)?(\w+)$", text, flags=re.M))
    assert set(wq.__all__) <= named


def test_the_reference_of_keys_is_what_the_code_says():
    module = loaded(ROOT / "docs" / "make_study_reference.py")
    made = (ROOT / "docs" / "study.md").read_text().split(module.MARK)[1].strip()
    assert made == module.reference().strip(), "run python docs/make_study_reference.py"


def test_every_key_has_a_meaning_in_words():
    lines = (ROOT / "docs" / "study.md").read_text(encoding="utf-8").splitlines()
    rows = [re.split(r"(?<!\\)\|", line) for line in lines if line.startswith("| `")]
    assert len(rows) > 600
    assert [row[1] for row in rows if len(row) != 5 or len(row[3].split()) < 2] == []


def test_the_page_on_the_reference_text_names_every_figure_and_table():
    """Of Chapters 4 and 5: in a row of its own, or in a range of them."""
    text = (ROOT / "docs" / "thesis.md").read_text(encoding="utf-8")
    named = set()
    for chapter, first, last in re.findall(r"\b([45])\.(\d+)(?:(?: to |-)\1\.(\d+))?", text):
        named |= {(int(chapter), number) for number in range(int(first), int(last or first) + 1)}
    assert named >= {(4, number) for number in range(1, 47)} | {(5, number) for number in range(1, 40)}
    assert re.search(r"\| Table 4\.1:", text)
    assert re.search(r"\| Table 4\.2:", text)
    assert re.search(r"\| Table 5\.1:", text)
    rows = [row for row in text.splitlines() if row.startswith("| ") and "statement" not in row]
    for row in rows:
        assert re.search(r"agree|differs|partly|fitted|open", row.split("|")[3]), row


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
