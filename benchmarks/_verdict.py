"""What was measured beside what is demanded: a table, and lines of JSON for those who collect them."""

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

from rich.table import Table

ROWS = "WAVEQUAKE_BENCHMARK_ROWS"
"""Environment variable: the file to which every row is appended, if it is set."""


class Row(NamedTuple):
    """One demand.

    Attributes
    ----------
    name : str
    value : float or None
        What was measured; None where it could not be.
    demanded, aim : float
    least : bool
        Whether more is better, as of ratios and rates; less is better of times.
    unit : str
    reason : str
        Why there is no value.
    slower : float
        How many times as long this processor takes for libraries alone as the one that met the demands
        (`benchmarks._processor`); of times.
    """

    name: str
    value: float | None
    demanded: float
    aim: float
    least: bool = True
    unit: str = ""
    reason: str = "a peer is not installed"
    slower: float = 1.0

    @property
    def word(self) -> str:
        """``"met"``, also for the speed of the processor, ``"short"``, or ``"skipped"`` with the reason."""
        if self.value is None:
            return f"skipped: {self.reason}"
        if (self.value >= self.demanded) == self.least or self.value == self.demanded:
            return "met"
        if not self.least and self.value / self.slower <= self.demanded:
            return f"met for its speed: {self.value / self.slower:.3g}"
        return "short"


def verdict(rows: Iterable[tuple[Any, ...]]) -> Table:
    """Return a table that says which demands are met, and note its rows where `ROWS` asks for them."""
    made = [Row(*row) for row in rows]
    if file := os.environ.get(ROWS):
        with Path(file).open("a", encoding="utf-8") as opened:
            opened.writelines(json.dumps(row._asdict()) + "\n" for row in made)
    return table(made)


def table(rows: Iterable[Row], *first: Iterable[str]) -> Table:
    """Return rows as a table; `first` has words for further columns before them."""
    columns = Table(*("" for _ in first), "", "measured", "demanded", "aim", "", box=None)
    for *words, row in zip(*first, rows, strict=True):
        value = "-" if row.value is None else f"{row.value:.3g} {row.unit}".rstrip()
        columns.add_row(*words, row.name, value, f"{row.demanded:g}", f"{row.aim:g}", row.word)
    return columns
