"""Differences of stores as a table for the terminal."""

from collections.abc import Sequence

import numpy as np
from rich.table import Table
from rich.text import Text

from wavequake.report.answers.comparison import Difference
from wavequake.report.table import difference, empty_table, number
from wavequake.words import counted

_SEEN = 5e-5  # relative differences that the table does not round to zero


def comparison_table(names: Sequence[str], comparisons: Sequence[Sequence[Difference]]) -> Table:
    """Return the differences of all stores from the first as a table for the terminal."""
    if any(one.variants for differences in comparisons for one in differences):
        return _table_of_variants(names, comparisons)
    table = empty_table(
        ("", "measure", "cases", "first", "this", "difference", "relative"),
        ("", "measure"),
        caption=f"Means over paired cases; difference from {names[0]} with its 95 % confidence interval "
        "(Student; of stratified cases by the scatter between their sets). Measures over time are rms values "
        "per case, the Strehl ratio a mean; images: L2 norm of the difference of unit-energy images."
        + _left_out(names, comparisons),
    )
    for name, differences in zip(names[1:], comparisons, strict=True):
        table.add_row(Text(name, style="bold"))
        for one in _changed(differences):
            table.add_row(
                Text(one.group),
                one.measure if one.units == "1" else f"{one.measure} ({one.units})",
                str(one.cases),
                number(one.first),
                number(one.second),
                *difference(one.mean, one.margin, one.first, np.abs(one.differences).max()),
            )
    return table


def _changed(differences: Sequence[Difference]) -> list[Difference]:
    return [one for one in differences if one.differences.any()]


def _left_out(names: Sequence[str], comparisons: Sequence[Sequence[Difference]]) -> str:
    """Say how many numbers of each store are those of the first in every case, and so no row."""
    words = ""
    for name, differences in zip(names[1:], comparisons, strict=True):
        equal = len(differences) - len(_changed(differences))
        if equal and equal == len(differences):
            words += f" No case of {name} differs from {names[0]} in any number."
        elif equal:
            words += f" Left out: {counted(equal, 'number')} in which no case of {name} differs."
    return words


def _table_of_variants(names: Sequence[str], comparisons: Sequence[Sequence[Difference]]) -> Table:
    """Return how far the reduced models are apart, which no mean over them would say."""
    table = empty_table(
        ("", "measure", "variants", "median", "largest", "of", "there", "here"),
        ("", "measure", "of"),
        caption=f"Differences of reduced models of one name, from {names[0]}. Measures over time or "
        "frequency are rms values; images: L2 norm of the difference of unit-energy images."
        + _left_out(names, comparisons),
    )
    for name, differences in zip(names[1:], comparisons, strict=True):
        table.add_row(Text(name, style="bold"))
        for one in _changed(differences):
            shares = one.relative
            known = bool(np.isfinite(shares).any())
            worst = int(np.nanargmax(np.abs(shares if known else one.differences)))
            seen = not known or abs(shares[worst]) >= _SEEN
            table.add_row(
                Text(one.group),
                one.measure if one.units == "1" else f"{one.measure} ({one.units})",
                str(one.cases),
                f"{np.nanmedian(shares):+.2%}" if known else number(float(np.median(one.differences))),
                f"{shares[worst]:+.2%}" if known else number(float(one.differences[worst])),
                Text(one.variants[worst] if seen else ""),
                number(float(one.each[worst])),
                number(float(one.each[worst] + one.differences[worst])),
            )
    return table
