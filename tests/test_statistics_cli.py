"""`wavequake budget` and `wavequake tail` as a user meets them."""

import sys

import pytest

from wavequake import cli
from wavequake.workflows.campaign import run_study
from wavequake.workflows.study import load_study

SMALL = ["telescope.name=tmt-18", "optics.rays_per_segment=6", "imaging.enabled=false"]


def wavequake(monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, "argv", ["wavequake", *map(str, words)])
    code = 0
    try:
        cli.main()
    except SystemExit as end:
        code = end.code or 0
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_a_budget_is_a_table_and_a_figure_of_the_report(tmp_path, monkeypatch, capsys):
    store = tmp_path / "s"
    words = ("budget", "tmt-segments", *SMALL, "--cases", 16, "--store", store)
    code, out, _ = wavequake(monkeypatch, capsys, *words)
    assert code == 0
    assert "ring 2 (12 segments)" in out
    assert "Written:" in out
    run_study(load_study("tmt-segments", [*SMALL, "campaign.cases=8"]), store, on="serial")
    code, _, _ = wavequake(monkeypatch, capsys, "report", store)
    assert code == 0
    assert 'id="budget"' in (store / "report.html").read_text()
    code, out, _ = wavequake(monkeypatch, capsys, *words)
    assert "Was there already, nothing was computed" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("tmt-segments", *SMALL, "--cases", "0"), "A budget of 0 cases says nothing"),
        (("lens-experiment",), "A budget is of segment-disturbance studies"),
        (("tmt-segments", *SMALL, "--of", "x"), "There is no combination 'x' in this study"),
    ],
)
def test_a_budget_that_cannot_be_is_refused_in_one_sentence(tmp_path, monkeypatch, capsys, words, message):
    code, _, err = wavequake(monkeypatch, capsys, "budget", *words, "--store", tmp_path / "s")
    assert code == 2
    assert message in err
    assert not (tmp_path / "s").exists()
