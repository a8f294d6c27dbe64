"""What a written report says: its answer and its table, without what makes reports.

The last lines of a report are comments: the table of the terminal, and how much journal it shows.
"""

import io
import json
import re
from html import unescape
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from wavequake.campaign.store.folder import JOURNAL, REPORT
from wavequake.campaign.store.objects import location, sizes

_ATTRIBUTES = ("title", "title_justify", "caption", "caption_justify", "pad_edge", "show_header", "padding")
_OF_COLUMNS = ("header", "justify", "overflow", "no_wrap", "style")
_TABLE = re.compile(rb"\n<!-- table (.*) -->\n")


def report_path(store: Path) -> Path:
    """Return where the report of a store is."""
    return location(store) / REPORT


def is_current(store: Path) -> bool:
    """Return whether the report shows everything that the journal records, which only grows."""
    try:
        return report_path(store).read_bytes().endswith(seal(store))
    except FileNotFoundError:
        return False


def seal(store: Path) -> bytes:
    """Return the last line of a report: how much journal it shows. Times of files would trust clocks."""
    size = sum(sizes(location(store) / JOURNAL, "*.jsonl").values())
    return b"\n<!-- of %d bytes of journal -->\n" % size


def read_answer(report: Path) -> str:
    """Return the answer that a written report gives; empty where it has none."""
    with report.open(encoding="utf-8") as file:
        found = re.search(r'<meta name="description" content="([^"]*)">', file.read(8192))
    return unescape(found[1]) if found else ""


def read_table(report: Path) -> Table | None:
    """Return the table that a report was written with; None where it has none that can be read."""
    found = _TABLE.search(report.read_bytes())
    try:
        return _table(json.loads(found[1])) if found else None
    except (ValueError, TypeError, KeyError, AttributeError):
        return None


def as_comment(table: Table) -> bytes:
    """Return the line that keeps a table in its report; empty where it would look different when read."""
    record = {
        **{name: getattr(table, name) for name in _ATTRIBUTES},
        "box": next((name for name, one in vars(box).items() if one is table.box), None),
        "columns": [{name: getattr(one, name) for name in _OF_COLUMNS} for one in table.columns],
        "rows": list(zip(*([_words(cell) for cell in one.cells] for one in table.columns), strict=True)),
        "ends": [row.end_section for row in table.rows],
    }
    try:
        text = json.dumps(record, ensure_ascii=False)
        same = _drawn(_table(json.loads(text))) == _drawn(table)
    except TypeError:  # of what is no text
        return b""
    text = text.replace("--", "\\u002d\\u002d")  # which would end the comment
    return f"\n<!-- table {text} -->\n".encode() if same else b""


def _table(record: dict[str, Any]) -> Table:
    found = Table(box=record["box"] and getattr(box, record["box"]))
    for name in _ATTRIBUTES:
        setattr(found, name, record[name])
    for column in record["columns"]:
        found.add_column(**column)
    for cells, end in zip(record["rows"], record["ends"], strict=True):
        found.add_row(*map(_cell, cells), end_section=end)
    return found


def _words(cell: Any) -> Any:
    """Return a cell as JSON has it; of a text that has styles, where which is."""
    if not isinstance(cell, Text):
        return cell
    return [cell.plain, cell.style, [[one.start, one.end, one.style] for one in cell.spans]]


def _cell(words: Any) -> Any:
    if not isinstance(words, list):
        return words
    plain, style, spans = words
    found = Text(plain, style=style)
    for start, end, one in spans:
        found.stylize(one, start, end)
    return found


def _drawn(table: Table) -> str:
    console = Console(  # in a notebook rich would show what is printed here
        file=io.StringIO(), width=100, force_terminal=True, force_jupyter=False, color_system="standard"
    )
    console.print(table)
    return console.file.getvalue()  # type: ignore[attr-defined,no-any-return]
