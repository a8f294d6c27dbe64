"""Build the documentation as a site into docs/_site/html: ``make docs``.

Tutorials are executed, their pictures renewed, and what they printed and drew is kept as notebooks; every
bundled study is run with few cases for the gallery, and Sphinx treats every warning as an error.
"""

import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from base64 import b64encode
from contextlib import redirect_stdout
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import wavequake as wq
from wavequake.report.written import read_answer
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


_BLOCK = re.compile(r"^```(console|python)\n(.*?)^```\n?", flags=re.M | re.S)


def execute(page: Path, folder: Path) -> dict[str, object]:
    """Run the commands and snippets of a page in order in a folder, and return the page as a notebook.

    Each block becomes a cell with what it printed and the pictures that it wrote; commands of the console are
    shell cells.
    """
    names: dict[str, object] = {}
    os.chdir(folder)
    cells, text, place = [], page.read_text(encoding="utf-8"), 0
    for block in _BLOCK.finditer(text):
        cells += _words(text[place : block.start()])
        place, before = block.end(), _pictures(folder)
        language, code = block.groups()
        if language == "python":
            printed = io.StringIO()
            with redirect_stdout(printed):
                exec(compile(code, page.name, "exec"), names)
            source, said = code, printed.getvalue()
        else:
            lines = [line.removeprefix("$ ") for line in code.splitlines() if line.startswith("$ ")]
            source, said = "\n".join(f"!{line}" for line in lines), "".join(map(_command, lines))
        new = [one for one, made in _pictures(folder).items() if before.get(one) != made]
        cells.append(_cell(source, said, new, len(cells) + 1))
    cells += _words(text[place:])
    about = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"
    return {"nbformat": 4, "nbformat_minor": 5, "metadata": about, "cells": cells}


def _command(line: str) -> str:
    command = [sys.executable, "-m", *shlex.split(line)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def _pictures(folder: Path) -> dict[Path, int]:
    return {one: one.stat().st_mtime_ns for one in sorted(folder.glob("*.png"))}


def _words(text: str) -> list[dict[str, object]]:
    """Return a cell of text without the pictures of the page, which are outputs in a notebook."""
    text = re.sub(r"^!\[[^]]*\]\([^)]*\)\n", "", text, flags=re.M).strip()
    return [{"cell_type": "markdown", "metadata": {}, "source": text}] if text else []


def _cell(source: str, said: str, pictures: list[Path], number: int) -> dict[str, object]:
    outputs: list[dict[str, object]] = []
    if said:
        outputs.append({"output_type": "stream", "name": "stdout", "text": said})
    for one in pictures:
        data = {"image/png": b64encode(one.read_bytes()).decode(), "text/plain": one.name}
        outputs.append({"output_type": "display_data", "metadata": {}, "data": data})
    kept = {"cell_type": "code", "metadata": {}, "execution_count": number}
    return {**kept, "source": source.rstrip("\n"), "outputs": outputs}


def show(name: str, title: str, folder: Path) -> str:
    """Run a bundled study with few cases, keep its pages, and return its entry of the gallery."""
    extra = SITE / "extra" / "gallery"
    try:
        study = load_study(name, {"campaign.cases": 8, **SMALL.get(name, {})})
    except wq.UserError:  # it counts its own cases
        study = load_study(name, SMALL.get(name, {}))
    wq.run(study, store=folder / name)
    report = wq.report(folder / name)
    page, words = report.read_text(encoding="utf-8"), [f"## {name}\n\n{title}\n"]
    report_link = f'<a href="gallery/{name}.html">'
    try:
        wq.draw(name).savefig(extra / f"{name}.png", dpi=110)
        words.append(f'{report_link}<img src="gallery/{name}.png" alt="{name}" loading="lazy"></a>\n')
    except wq.UserError:  # a study without anything to be drawn
        pass
    links = [f"{report_link}the report of a few cases</a>"]
    try:
        wq.view(folder / name, file=extra / f"{name}-view.html")
        links.append(f'<a href="gallery/{name}-view.html">in motion</a>')
        page = page.replace('href="view.html"', f'href="{name}-view.html"')
    except wq.UserError:  # no bodies that move
        pass
    (extra / f"{name}.html").write_text(page, encoding="utf-8")
    words += [f"> {read_answer(report)}\n", f"`wavequake run {name}` – {', '.join(links)}\n"]
    return "\n".join(words)


def build(chosen: list[str], tutorials: list[Path]) -> int:
    """Build the site with these tutorials executed; with names of studies the gallery shows these alone."""
    shutil.rmtree(SITE, ignore_errors=True)
    (SITE / "extra" / "gallery").mkdir(parents=True)
    scratch, notebooks = SITE / "scratch", SITE / "extra" / "notebooks"
    notebooks.mkdir(parents=True)
    for page in tutorials:
        (folder := scratch / page.stem).mkdir(parents=True)
        notebook = execute(page, folder)
        (notebooks / f"{page.stem}.ipynb").write_text(json.dumps(notebook, indent=1), encoding="utf-8")
        for picture in _pictures(folder):
            shutil.copy(picture, DOCS / "pictures")
    os.chdir(DOCS)
    entries = [show(n, t, scratch) for n, t in wq.studies().items() if n in chosen or not chosen]
    words = (
        "# Gallery: every bundled study\n\nRun with few cases to make this page; click for the report.\n\n"
    )
    links = [f'<a href="notebooks/{one.name}" download>{one.name}</a>' for one in sorted(notebooks.iterdir())]
    words += f"The tutorials as executed notebooks: {', '.join(links)}.\n\n"
    (DOCS / "gallery.md").write_text(words + "\n".join(entries), encoding="utf-8")
    try:
        options = ["-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(SITE / "html")]
        return subprocess.run([sys.executable, "-m", "sphinx", *options]).returncode
    finally:
        (DOCS / "gallery.md").unlink()
        shutil.rmtree(scratch, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(build(sys.argv[1:], sorted((DOCS / "tutorials").glob("*.md"))))
