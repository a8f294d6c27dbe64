"""What a written report keeps for those who make none."""

import io

import pytest
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from wavequake.report.written import _drawn, as_comment, read_table


def drawn(table, width):
    console = Console(file=io.StringIO(), width=width, force_terminal=True, color_system="standard")
    console.print(table)
    return console.file.getvalue()


def styled(cell):
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, caption="of -- λ", title="τ")
    table.add_column("name\nof it", overflow="fold")
    table.add_column("value", justify="right", no_wrap=True, style="cyan")
    table.add_row(cell, "1.0 --> [2, 3]", end_section=True)
    table.add_row("b", "12")
    return table


@pytest.mark.parametrize("cell", ["a", Text("a", style="bold"), Text.assemble(("bold", "bold"), "\n plain")])
def test_a_table_comes_back_as_it_was_written(tmp_path, cell):
    page, table = tmp_path / "report.html", styled(cell)
    page.write_bytes(b"<p>a page</p>" + as_comment(table) + b"\n<!-- of 12 bytes of journal -->\n")
    assert page.read_text().count("-->") == 2  # the table's own arrows do not end its comment
    for width in (40, 110):
        assert drawn(read_table(page), width) == drawn(table, width)


@pytest.mark.parametrize("cell", [Panel("in a frame"), Text("a", justify="center")])
def test_a_table_that_would_look_different_is_not_kept(tmp_path, cell):
    page = tmp_path / "report.html"
    page.write_bytes(b"<p>a page</p>" + as_comment(styled(cell)))
    assert read_table(page) is None


@pytest.mark.parametrize("content", [b"", b"[]", b"{}", b'{"box": "SIMPLE_HEAD", "columns": 1}'])
def test_a_damaged_table_is_none(tmp_path, content):
    page = tmp_path / "report.html"
    page.write_bytes(b"\n<!-- table " + content + b" -->\n")
    assert read_table(page) is None


def test_what_is_drawn_to_be_kept_is_not_shown_in_a_notebook(monkeypatch):
    shown = []
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setattr("rich.jupyter.display", lambda *parts: shown.append(parts))
    table = Table("a number")
    table.add_row("42")
    assert "42" in _drawn(table)
    assert shown == []
