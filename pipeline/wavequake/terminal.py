"""What the command line prints on: its consoles, pairs of words, and the progress of a run."""

import os
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, NoReturn

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from wavequake.words import plain, printable

# How a command ended; quarantined are cases that failed, and loops that are unstable.
EXIT_BAD_INPUT, EXIT_QUARANTINED, EXIT_DAMAGED, EXIT_INTERRUPTED = 2, 3, 4, 130


class _Console(Console):
    """A console that shows what names and files hold, and does not obey it."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Make a text of a string."""
        return super().render_str(printable(text), **options)


# Where the output is no terminal (a log, a pipe), lines have room for the table.
out = _Console(highlight=False, width=None if sys.stdout and sys.stdout.isatty() else 110)
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
        yield _plain_progress()
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


def progress_words(done: int, total: int, rate: float, quarantined: int) -> str:
    """Return how far a run is, in words; before the first case is done there is no rate."""
    speed = f"  {rate_words(rate)}/s" if rate > 0 else "  starting"
    lost = f"  {quarantined} quarantined" if quarantined else ""
    return f"{done}/{total} cases{speed}{lost}"


class _Rate:
    """Cases per second since the first call."""

    def __init__(self) -> None:
        self._start: tuple[float, int] | None = None

    def __call__(self, done: int) -> float:
        now = time.monotonic()
        if self._start is None:
            self._start = (now, done)
        elapsed = now - self._start[0]
        return (done - self._start[1]) / elapsed if elapsed > 0 else 0.0


def rate_words(rate: float) -> str:
    """Return a rate in words: whole numbers from 10 on, two digits below."""
    return f"{rate:.0f}" if rate >= 10 else f"{rate:.2g}"


def _plain_progress(every_s: float = 5.0) -> Callable[[int, int, int], None]:
    rate, last = _Rate(), [0.0]

    def update(done: int, total: int, quarantined: int) -> None:
        first, speed, now = not last[0], rate(done), time.monotonic()
        if (now - last[0] < every_s and done < total) or (first and done == total):
            return
        last[0] = now
        left = f"{(total - done) / speed:.0f} s left" if speed > 0 else "starting"
        out.print(f"{done}/{total} cases  {rate_words(speed)}/s  {left}  {quarantined} quarantined")

    return update
