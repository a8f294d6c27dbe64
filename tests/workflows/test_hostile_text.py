"""Names and files may hold what terminals obey: it is shown, and not obeyed."""

import io
import logging
import re
import time
import unicodedata

import pytest
import toy
from hypothesis import given
from hypothesis import strategies as st
from rich.table import Table

from wavequake import terminal
from wavequake.campaign.contract import ChunkResult, StudyKind
from wavequake.campaign.engine.driver import run_campaign
from wavequake.campaign.engine.runlog import run_log
from wavequake.campaign.store.store import open_store
from wavequake.cli import main
from wavequake.words import MOST, plain, printable, shortened

HOSTILE = "a\x1b]0;title\x07\x1b[2J\x9b31m\r\x00b\u202ec\u2066d\u2028"
SHOWN = r"a\x1b]0;title\x07\x1b[2J\x9b31m\r\x00b\u202ec\u2066d\u2028"


@given(st.text(st.characters(codec=None)))
def test_no_character_that_is_obeyed_remains(text):
    shown = printable(text)
    assert all(
        unicodedata.category(one) not in ("Cc", "Cs", "Zl", "Zp") for one in shown if one not in "\n\t"
    )
    assert all(unicodedata.bidirectional(one) not in BIDI for one in shown)
    assert printable(shown) == shown
    shown.encode()


BIDI = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}


@given(st.text(max_size=2000), st.integers(20, 700))
def test_a_shortened_text_keeps_both_ends(text, most):
    short = shortened(text, most)
    assert len(short) <= most or short == text
    assert (short == text) == (len(text) <= most)
    if short == text:
        return
    cuts = (place for place in range(len(short)) if short.startswith(" ... ", place))
    assert any(
        text.startswith(short[:place])
        and text.endswith(short[place + 5 :])
        and min(place, len(short) - place - 5) >= most // 6
        for place in cuts
    )


def test_a_shortened_text_keeps_whole_words_of_both_ends():
    words = " ".join(f"word{number}" for number in range(300))
    first, last = plain(words).split(" ... ")
    assert {*first.split(), *last.split()} <= set(words.split())
    assert len(plain(words)) > MOST - 20


def test_text_that_is_fine_stays_as_it_is():
    fine = "Größe 3 µm, ±70 nm → 53 %\n\tstraße 望遠鏡 \u05d0\u05d1"
    assert printable(fine) == fine
    assert printable(HOSTILE) == SHOWN


def test_the_time_that_is_left_does_not_count_the_start(monkeypatch):
    """Two workers start for 30 s, then each does 10 cases in 5 s: 4 cases a second."""
    now = [0.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])
    rate = terminal._Rate()
    assert rate(100) == 0.0
    said = {}
    for number in range(12):
        for worker in (0.0, 0.3):
            now[0] = 35.0 + 5.0 * number + worker
            said[now[0]] = rate(100 + 20 * number + (20 if worker else 10))
    assert said[35.0] == pytest.approx(10 / 35.0)  # nothing better is known
    late = [words for time, words in said.items() if time > 60.0]
    assert late == pytest.approx([4.0] * len(late), rel=0.2)
    assert late[-1] == pytest.approx(4.0, rel=0.02)


def test_a_log_says_now_and_then_that_a_run_still_prepares(monkeypatch):
    file = io.StringIO()
    monkeypatch.setattr(terminal, "out", terminal._Console(file=file, force_terminal=False, width=110))
    with terminal._plain_progress(silent_s=0.2) as update:
        while file.getvalue().count("\n") < 2:
            time.sleep(0.01)
        update(0, 6, 0)
        while file.getvalue().count("\n") < 4:
            time.sleep(0.01)
    lines = file.getvalue().splitlines()
    assert lines[0].startswith("preparing  after 0 s")
    assert lines[2:3] == ["0/6 cases  starting"]
    assert lines[3].startswith("0/6 cases  starting  after ")


@pytest.mark.parametrize("tabled", [False, True])
def test_the_terminal_shows_and_does_not_obey(monkeypatch, tabled):
    file = io.StringIO()
    console = terminal._Console(file=file, force_terminal=False, width=110, highlight=False)
    table = Table("name")
    table.add_row(HOSTILE)
    console.print(table if tabled else HOSTILE, **({} if tabled else {"markup": False}))
    assert SHOWN in file.getvalue()
    assert not re.search("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]", file.getvalue())


def test_what_is_wrong_with_a_name_is_told_in_600_characters(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["wavequake", "plan", f"{HOSTILE}{'x' * 5000}"])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    told = capsys.readouterr().err
    assert len(told) <= MOST + 1
    assert "\x1b" not in told


def test_reasons_of_cases_are_filtered_in_store_and_log(tmp_path):
    def compute(text, cases, device):
        result = toy.compute(text, cases, device)
        status = result.status.copy()
        status[3] = 2
        return ChunkResult(result.arrays, status, ("", "", "", HOSTILE + "y" * 10**4, *[""] * 6))

    workflow = StudyKind("toy", toy.template, toy.case_table, compute)
    run_campaign(workflow, toy.study(), tmp_path / "s", cases=10, chunk=10, device="numpy", on="serial")
    (message,) = open_store(tmp_path / "s").message.values[3:4]
    assert message.startswith(SHOWN)
    assert len(message) == MOST


def test_a_line_of_the_log_cannot_pass_for_two(tmp_path):
    with run_log(tmp_path) as log:
        log.warning("cases of %s", f"{HOSTILE}\n2026-01-01 00:00:00,000 INFO the run is complete")
    (file,) = tmp_path.glob("*.log")
    lines = file.read_text().splitlines()
    assert len(lines) == 2
    assert SHOWN in lines[0]
    assert logging.getLogger("wavequake.run").handlers == []


@pytest.mark.parametrize("text", [" " * 10**6 + "x", "\n" * 10**6, "\t \n " * 10**6, "\x1b" * 10**6])
def test_messages_of_any_length_are_made_plain_at_once(text):
    start = time.process_time()
    assert len(plain(text)) <= MOST
    assert time.process_time() - start < 3.0
