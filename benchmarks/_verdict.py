"""What was measured beside what is demanded."""

from collections.abc import Sequence

from rich.table import Table

# What it is, what was measured (None: a peer is missing), the least that is demanded, and what is aimed at.
Row = tuple[str, float | None, float, float]


def verdict(rows: Sequence[Row]) -> Table:
    """Return a table that says which demands are met."""
    table = Table("", "measured", "demanded", "aim", "", box=None)
    for name, value, demanded, aim in rows:
        word = "skipped" if value is None else "met" if value >= demanded else "short"
        table.add_row(name, "-" if value is None else f"{value:.3g}", f"{demanded:g}", f"{aim:g}", word)
    return table
