"""Build the documentation as a site into docs/_site/html: ``make docs``.

Tutorials are executed and their pictures renewed, every bundled study is run with few cases for the gallery,
and Sphinx treats every warning as an error.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import wavequake as wq
from wavequake.report.page import read_answer
from wavequake.workflows.study import load_study

DOCS = Path(__file__).parent
SITE = DOCS / "_site"
# Overrides that make a study small enough for a picture; others run with eight cases.
SMALL = {
    "tmt-million": {"campaign.cases": 4000},
    "tmt-segments": {"campaign.cases": 24},
    "lens-passive": {"passive.iterations": 5},
    "mirror-mor": {"model.rings": 2, "reduction.frequencies": 24},
    "tmt-segment-mor": {"model.divisions": 3, "telescope.name": "tmt-18", "segments.name": "6"},
}


def execute(page: Path, folder: Path) -> list[Path]:
    """Run the commands and snippets of a page in order in a folder; return the pictures that they wrote."""
    names: dict[str, object] = {}
    os.chdir(folder)
    for language, block in re.findall(
        r"^```(console|python)\n(.*?)^```", page.read_text(), flags=re.M | re.S
    ):
        if language == "python":
            exec(compile(block, page.name, "exec"), names)
            continue
        for line in block.splitlines():
            subprocess.run([sys.executable, "-m", *shlex.split(line.removeprefix("$ "))], check=True)
    return sorted(folder.glob("*.png"))


def show(name: str, title: str, folder: Path) -> str:
    """Run a bundled study with few cases, keep its report, and return its entry of the gallery."""
    extra = SITE / "extra" / "gallery"
    try:
        study = load_study(name, {"campaign.cases": 8, **SMALL.get(name, {})})
    except wq.UserError:  # it counts its own cases
        study = load_study(name, SMALL.get(name, {}))
    wq.run(study, store=folder / name)
    report = wq.report(folder / name)
    shutil.copy(report, extra / f"{name}.html")
    wq.draw(name).savefig(extra / f"{name}.png", dpi=110)
    return (
        f"## {name}\n\n{title}\n\n"
        f'<a href="gallery/{name}.html"><img src="gallery/{name}.png" alt="{name}" loading="lazy"></a>\n\n'
        f"> {read_answer(report)}\n\n"
        f'`wavequake run {name}` – <a href="gallery/{name}.html">the report of a few cases</a>\n'
    )


def main(chosen: list[str]) -> int:
    """Build the site; with names of studies the gallery shows these alone."""
    shutil.rmtree(SITE, ignore_errors=True)
    (SITE / "extra" / "gallery").mkdir(parents=True)
    scratch = SITE / "scratch"
    for page in sorted((DOCS / "tutorials").glob("*.md")):
        (folder := scratch / page.stem).mkdir(parents=True)
        for picture in execute(page, folder):
            shutil.copy(picture, DOCS / "pictures")
    os.chdir(DOCS)
    entries = [show(n, t, scratch) for n, t in wq.studies().items() if n in chosen or not chosen]
    words = (
        "# Gallery: every bundled study\n\nRun with few cases to make this page; click for the report.\n\n"
    )
    (DOCS / "gallery.md").write_text(words + "\n".join(entries), encoding="utf-8")
    try:
        build = ["-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(SITE / "html")]
        return subprocess.run([sys.executable, "-m", "sphinx", *build]).returncode
    finally:
        (DOCS / "gallery.md").unlink()
        shutil.rmtree(scratch)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
