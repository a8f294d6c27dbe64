"""Allowances as a table and as a CSV file."""

import csv
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from wavequake.errors import UserError
from wavequake.report.answers.rare import in_unit, unit_of
from wavequake.report.table import number
from wavequake.workflows.allow import Allowances

_FORM = re.compile(r"\s*(\w+(?:\[.*\])?)\.p(\d+(?:\.\d+)?)\s*")


def goal_of(measure: str, limit: str | float) -> tuple[str, float, float]:
    """Read ``wfe_rms.p95`` and ``60 nm``: the measure, how often the limit may be exceeded, the limit.

    Raises
    ------
    UserError
        If they have another form, or the quantile is no upper one.
    """
    match = _FORM.fullmatch(measure)
    if not match or not 50.0 < float(match[2]) < 100.0:
        raise UserError(f"{measure!r} is no upper quantile of a measure; write it as wfe_rms.p95.")
    return match[1], 1.0 - float(match[2]) / 100.0, in_unit(limit, unit_of(match[1]))


def allow_table(found: Allowances) -> Table:
    """Return the allowances of each axis over the segments as a table for the terminal."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("axis")
    for column in ("least", "median", "most", "unit", "share"):
        table.add_column(column, justify="left" if column == "unit" else "right")
    for axis, values, shares in zip(found.axes, found.rms, found.shares, strict=True):
        scale, unit = _scale(axis)
        numbers = (values.min(), float(np.median(values)), values.max())
        table.add_row(axis, *(number(scale * one) for one in numbers), unit, f"{shares.sum():.1%}")
    return table


def _scale(axis: str) -> tuple[float, str]:
    return (1e9, "nrad rms") if axis in ("rx", "ry", "rz") else (1e9, "nm rms")


def allow_notes(found: Allowances, measure: str, limit: float) -> Iterator[str]:
    """Yield what the allowances mean, and whether full traces confirm them, in lines."""
    if np.isfinite(found.factor):
        yield f"What the study has, times {found.factor:.4g}."
    check, unit = found.check, found.unit
    yield (
        f"{measure} is {number(limit, 4)} {unit} by the modal model; of {found.cases - found.failed} cases "
        f"that were drawn with these allowances and traced in full {number(check.value, 4)} {unit} "
        f"({number(check.low, 4)}–{number(check.high, 4)})."
    )
    if found.failed:
        yield f"WARNING {found.failed} of {found.cases} cases cannot be traced, and are left out."
    if not check.low <= limit <= check.high:
        yield "WARNING Full traces do not confirm the limit: the motions are too large for the modal model."


def write_allowances(found: Allowances, file: Path) -> None:
    """Write a row per segment and axis.

    Raises
    ------
    UserError
        If the file cannot be written.
    """
    rows: list[tuple[object, ...]] = [("element", "axis", "rms", "unit", "share")]
    for axis, values, shares in zip(found.axes, found.rms, found.shares, strict=True):
        unit = "rad" if axis in ("rx", "ry", "rz") else "m"
        parts = zip(found.elements, values.tolist(), shares.tolist(), strict=True)
        rows += [(name, axis, value, unit, part) for name, value, part in parts]
    try:
        with file.open("w", encoding="utf-8", newline="") as out:
            csv.writer(out, lineterminator="\n").writerows(rows)
    except OSError as error:
        raise UserError(f"{file} cannot be written: {error.strerror}.") from None
