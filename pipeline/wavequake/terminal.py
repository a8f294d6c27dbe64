"""What the command line prints on: its consoles, pairs of words, and the progress of a run."""

import os
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import replace
from typing import Any, NoReturn

from rich.cells import cell_len
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from wavequake.words import counted, plain, printable

# How a command ended; quarantined are cases that failed, and loops that are unstable.
EXIT_BAD_INPUT, EXIT_QUARANTINED, EXIT_DAMAGED, EXIT_INTERRUPTED = 2, 3, 4, 130


_TOGETHER = 0.5  # of the time of the first chunk
_LABEL = 24  # characters of labels in wide tables, where their words allow it


class _Console(Console):
    """A console that shows what names and files hold, and does not obey it."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Make a text of a string."""
        return super().render_str(printable(text), **options)


# Where the output is no terminal (a log, a pipe), lines have room for the table, or what COLUMNS asks for.
_asked = os.environ.get("COLUMNS", "")
_piped = int(_asked) if _asked.isdecimal() and int(_asked) else 110
out = _Console(highlight=False, width=None if sys.stdout and sys.stdout.isatty() else _piped)
err = _Console(stderr=True, highlight=False)


def print_pairs(pairs: dict[str, str]) -> None:
    """Print two columns of words."""
    table = Table(show_header=False, box=None)
    for key, value in pairs.items():
        table.add_row(key, value)
    out.print(table)


def interrupted() -> NoReturn:
    """Say how to go on, and end at once: nobody waits for threads or libraries."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    words = shlex.join(["wavequake", *sys.argv[1:]])
    with suppress(OSError):  # the terminal may be gone
        err.print(f"\nInterrupted. What is done is kept; to continue: {words}", markup=False, soft_wrap=True)
        sys.stdout.flush()
    os._exit(EXIT_INTERRUPTED)


def print_fitting(table: Table) -> None:
    """Print a table, or where it is too wide its rows below each other, a line for every column."""
    widest = out.measure(table, options=out.options.update(max_width=10_000)).maximum
    out.print(table if widest - _spare(table) <= out.width else stacked(table))


def _spare(table: Table) -> int:
    """Return by how much the columns of a table that may wrap can be narrower."""
    spare = 0
    for column in table.columns:
        lines = [line for cell in (column.header, *column.cells) for line in str(cell).split("\n")]
        least = max([column.min_width or 0, *(len(word) for line in lines for word in line.split())])
        if not column.no_wrap:
            spare += max(max(map(len, lines)) - least, 0)
    return spare


def stacked(table: Table) -> Table:
    """Return a table of three columns: the first column of another one, the headers of its others, cells."""
    first, *others = table.columns
    found = Table(box=table.box, title=table.title, title_justify=table.title_justify, pad_edge=False)
    for header in (first.header, "", ""):
        found.add_column(header, overflow="fold")
    for name, *cells in zip(first.cells, *(column.cells for column in others), strict=True):
        for place, (column, cell) in enumerate(zip(others, cells, strict=True)):
            header = " ".join(str(column.header).split())
            last = place == len(others) - 1
            found.add_row("" if place else name, header, cell, end_section=last)
    return found


def print_in_blocks(table: Table) -> None:
    """Print a table, where it is too wide as blocks of columns one below the other; then what it says."""
    for block in in_blocks(table, out.width):
        out.print(block)
    if table.caption:
        out.print(table.caption, style="table.caption")


def in_blocks(table: Table, width: int) -> list[Table]:
    """Return a table as blocks of columns, each with the labels, that fit a width without cutting a number.

    Labels are the first columns that are aligned to the left; long ones wrap, if they may.
    """
    gap = sum(table.padding[1::2]) + (table.box is not None)
    wide = [
        max(cell_len(line) for cell in (column.header, *column.cells) for line in _plain(cell).split("\n"))
        for column in table.columns
    ]
    labels = next((place for place, one in enumerate(table.columns) if one.justify == "right"), 1) or 1
    for place in range(labels):
        words = [_plain(cell) for cell in (table.columns[place].header, *table.columns[place].cells)]
        longest = max(cell_len(word) for one in words for word in one.split() or [""])
        if not table.columns[place].no_wrap:
            wide[place] = min(wide[place], max(longest, _LABEL // labels))
        table.columns[place].width = wide[place]
    room = width - 2 - sum(wide[:labels]) - gap * (labels - (not table.pad_edge))
    groups: list[list[int]] = [[]]
    for place in range(labels, len(wide)):
        if groups[-1] and sum(wide[one] + gap for one in (*groups[-1], place)) > room:
            groups.append([])
        groups[-1].append(place)
    blocks = []
    for group in groups:
        block = copy(table)
        block.columns = [
            replace(table.columns[place], _index=number)
            for number, place in enumerate((*range(labels), *group))
        ]
        block.title = table.title if group is groups[0] else None
        block.caption = None
        blocks.append(block)
    return blocks


def _plain(cell: object) -> str:
    return cell.plain if isinstance(cell, Text) else Text.from_markup(str(cell)).plain


def fail(message: str, code: int, debug: bool, details: str = "") -> NoReturn:
    """End with a message, lines of details below it, and an exit code."""
    if debug:
        err.print_exception()
    err.print(plain(message), markup=False, soft_wrap=True)
    for line in details.splitlines():
        err.print(printable(line), markup=False, soft_wrap=True, highlight=False)
    sys.exit(code)


@contextmanager
def live_progress() -> Iterator[Callable[[int, int, int], None]]:
    """Give a callback (done, total, quarantined): one live line on a terminal, plain lines elsewhere."""
    if not out.is_terminal:
        with _plain_progress() as update:
            yield update
        return
    columns = (
        BarColumn(),
        TextColumn("{task.description}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=out, transient=True) as bar:
        task = bar.add_task("preparing", total=None)
        rate = _Rate()

        def update(done: int, total: int, quarantined: int) -> None:
            words = progress_words(done, total, rate(done), quarantined)
            bar.update(task, completed=done, total=total, description=words)

        yield update


@contextmanager
def frame_progress() -> Iterator[Callable[[int, int], None]]:
    """Give a callback (drawn, total) for the frames of a moving picture; it says first that it computes."""
    if not out.is_terminal:
        out.print("computing the case")

        def say(drawn: int, total: int) -> None:
            if drawn in (1, total):
                out.print(f"frame {drawn} of {total}")

        yield say
        return
    with Progress(BarColumn(), TextColumn("{task.description}"), console=out, transient=True) as bar:
        task = bar.add_task("computing the case", total=None)
        yield lambda drawn, total: bar.update(
            task, completed=drawn, total=total, description=f"frame {drawn} of {total}"
        )


def progress_words(done: int, total: int, rate: float, quarantined: int) -> str:
    """Return how far a run is, in words; before the first case is done there is no rate."""
    speed = f"  {rate_words(rate)}/s" if rate > 0 else "  starting"
    lost = f"  {quarantined} quarantined" if quarantined else ""
    return f"{done}/{counted(total, 'case')}{speed}{lost}"


class _Rate:
    """Cases per second, once chunks have come for a while without the time that workers took to start."""

    def __init__(self) -> None:
        self._start: tuple[float, int] | None = None
        self._first: tuple[float, int] | None = None
        self._until = 0.0

    def __call__(self, done: int) -> float:
        now = time.monotonic()
        if self._start is None:
            self._start = (now, done)
        since, before = self._start
        if done > before and (self._first is None or now < self._until):
            # Workers that began together bring their first chunks one soon after the other.
            self._until = self._until or now + _TOGETHER * (now - since)
            self._first = (now, done)
        elif self._first is not None and done > self._first[1]:
            since, before = self._first
        return (done - before) / (now - since) if now > since else 0.0


def rate_words(rate: float) -> str:
    """Return a rate in words: whole numbers from 10 on, two digits below."""
    return f"{rate:.0f}" if rate >= 10 else f"{rate:.2g}"


@contextmanager
def _plain_progress(
    every_s: float = 5.0, silent_s: float = 20.0
) -> Iterator[Callable[[int, int, int], None]]:
    """Give a callback that prints a line at most so often; a line comes, too, when nothing has for long."""
    rate, begun, over = _Rate(), time.monotonic(), threading.Event()
    said, last = "preparing", 0.0

    def update(done: int, total: int, quarantined: int) -> None:
        nonlocal said, last
        first, speed, now = not last, rate(done), time.monotonic()
        if (now - last < every_s and done < total) or (first and done == total):
            return
        last, said = now, progress_words(done, total, speed, quarantined)
        left = f"  {(total - done) / speed:.0f} s left" if speed > 0 and done < total else ""
        out.print(said + left)

    def remind() -> None:
        while not over.wait(silent_s):
            now = time.monotonic()
            if now - max(last, begun) >= silent_s:
                out.print(f"{said}  after {now - begun:.0f} s")

    reminding = threading.Thread(target=remind, daemon=True)
    reminding.start()
    try:
        yield update
    finally:
        over.set()
        reminding.join()
