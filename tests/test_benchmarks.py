"""What benchmarks say of their figures: met, short or skipped, what changed, and what a command took."""

import importlib.util
import io
import json
import pkgutil
import sys
from pathlib import Path

import pytest
from benchmarks import __main__ as command
from benchmarks._processor import MET, slower_by
from benchmarks._verdict import ROWS, Row, verdict
from benchmarks._whole import spent
from rich.console import Console

ROOT = Path(__file__).parents[1]


def text_of(table):
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text()


@pytest.mark.parametrize(
    ("value", "least", "word"),
    [(2.0, True, "met"), (1.9, True, "short"), (2.0, False, "met"), (2.1, False, "short")],
)
def test_a_row_says_whether_it_is_met(value, least, word):
    assert Row("x", value, 2.0, 3.0, least).word == word


def test_times_are_met_for_the_speed_of_a_processor_on_which_libraries_take_longer():
    assert Row("x", 3.0, 2.0, 1.0, least=False, slower=1.6).word == "met for its speed: 1.88"
    assert Row("x", 3.3, 2.0, 1.0, least=False, slower=1.6).word == "short"
    assert Row("x", 1.9, 2.0, 3.0, slower=1.6).word == "short"  # rates and ratios are as they are
    took = {name: factor * MET[name] for name, factor in zip(MET, (1.5, 1.6, 4.0), strict=True)}
    assert slower_by(took) == pytest.approx(1.6)


def test_every_benchmark_finds_what_it_takes_of_the_package():
    for one in pkgutil.iter_modules(command.benchmarks.__path__):
        importlib.import_module(f"benchmarks.{one.name}")


def test_rows_are_collected_from_processes_of_their_own_and_failures_have_a_reason(tmp_path, monkeypatch):
    package = tmp_path / "benchmarks"
    package.mkdir()
    for name in ("__init__", "_verdict"):
        source = Path(command.__file__).with_name(f"{name}.py")
        (package / source.name).write_text(source.read_text())
    (package / "fine.py").write_text(
        "from benchmarks._verdict import verdict\n"
        "verdict([('rate', 3.0, 2.0, 4.0), ('peer', None, 2.0, 4.0, True, '', 'it is not here')])\n"
    )
    (package / "broken.py").write_text("from benchmarks.fine import *\nraise ValueError('too small')\n")
    monkeypatch.chdir(tmp_path)
    rows = command.collect(["fine", "broken"])
    assert [(one["benchmark"], one["name"], one["value"]) for one in rows] == [
        ("fine", "rate", 3.0),
        ("fine", "peer", None),
        ("broken", "rate", 3.0),
        ("broken", "peer", None),
        ("broken", "all of it", None),
    ]
    shown = text_of(command.shown({"rows": rows}))
    assert "skipped: it is not here" in shown
    assert "skipped: ValueError: too small" in shown


def test_two_files_are_compared_row_by_row():
    def file(**values):
        rows = [
            {"benchmark": "b", **Row(name, value, 1.0, 1.0, name.startswith("rate"))._asdict()}
            for name, value in values.items()
        ]
        return {"rows": rows}

    before = file(rate=1.0, rate_up=1.0, time=1.0, time_up=1.0, gone=1.0, none=None, alike=100.0)
    after = file(rate=0.5, rate_up=2.0, time=0.5, time_up=2.0, gone=None, none=None, alike=105.0, new=1.0)
    lines = {
        line.split()[1]: line.split()[2:]
        for line in text_of(command.compared(before, after)).splitlines()[1:]
    }
    assert lines == {
        "rate": ["1", "0.5", "0.50", "worse"],
        "rate_up": ["1", "2", "2.00", "better"],
        "time": ["1", "0.5", "0.50", "better"],
        "time_up": ["1", "2", "2.00", "worse"],
        "gone": ["1", "-", "gone"],
        "none": ["-", "-", "skipped"],
        "alike": ["100", "105", "1.05"],
        "new": ["-", "1", "new"],
    }


def test_without_a_file_rows_are_only_shown(monkeypatch, tmp_path):
    monkeypatch.delenv(ROWS, raising=False)
    assert "short" in text_of(verdict([("x", 1.0, 2.0, 3.0)]))
    monkeypatch.setenv(ROWS, str(tmp_path / "rows"))
    verdict([("x", 1.0, 2.0, 3.0)])
    assert json.loads((tmp_path / "rows").read_text())["demanded"] == 2.0


def test_processor_time_counts_processes_that_nobody_waits_for():
    """A grandchild that outlives its parent, as workers that are forked outlive the run."""
    burn = "import time\nwhile time.process_time() < 0.3: pass"
    leave = f"import subprocess, sys; subprocess.Popen([sys.executable, '-c', {burn!r}])"
    took = spent([sys.executable, "-c", leave])
    assert 0.3 <= took.cpu < 5.0
    with pytest.raises(RuntimeError, match="exit code 3: no"):
        spent([sys.executable, "-c", "import sys; print('no', file=sys.stderr); sys.exit(3)"])


def test_the_page_on_speed_is_made_from_files(tmp_path, monkeypatch):
    spec = importlib.util.spec_from_file_location("make_speed", ROOT / "docs" / "make_speed.py")
    maker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(maker)
    text = maker.PAGE.read_text()
    files = [json.loads(file.read_text()) for file in sorted(maker.MEASURED.glob("*.json"))]
    assert maker.page(text, files) == text, "run python docs/make_speed.py"
    assert len(text.splitlines()) <= 120
    machine = {"processor": "P", "vectors": "256 bits", "cpus": 2, "date": "today"}
    rows = [
        {"benchmark": "b", **row._asdict()}
        for row in (
            Row("rate", 3.0, 2.0, 4.0),
            Row("time", 3.0, 2.0, 1.0, False, "s"),
            Row("peer", None, 1.0, 1.0),
        )
    ]
    made = maker.tables([{**machine, "rows": rows}, {**machine, "rows": rows[:1]}]).splitlines()
    assert made[3:] == [
        "| | demanded | aim | A | B |",
        "|---|---|---|---|---|",
        "| b: rate | 2 | 4 | 3 | 3 |",
        "| b: time | at most 2 s | 1 | **3** |  |",
        "| b: peer | 1 | 1 | – (a peer is not installed) |  |",
    ]
