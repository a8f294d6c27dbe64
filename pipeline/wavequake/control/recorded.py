"""Recordings of uncontrolled runs, from which the modal model is identified."""

import csv
import io
import math

import numpy as np

from wavequake.control.identification import Record
from wavequake.control.linear import Array
from wavequake.errors import UserError

COLUMNS = ("time_s", "command_mm", "sensor_mm", "image_mm")
# Instants may be off an even grid by this share of its interval.
_JITTER = 0.01


def read_recorded(text: str, name: str) -> Record:
    """Read CSV text of a run that no controller disturbed; the blow begins at 0 s.

    Its columns are time_s, command_mm, sensor_mm and image_mm in any order. A cell is empty where nothing was
    sampled: sensor and camera need not share their instants, but each needs even ones. The column of
    commands may be missing; where it is not, its values must be zero.

    Parameters
    ----------
    text : str
    name : str
        Of the file, for messages.

    Raises
    ------
    UserError
        If a column is missing, a value is no finite number, instants do not increase evenly, or the run was
        controlled; names file and line.
    """
    try:
        return _parsed(text, name)
    except csv.Error as error:
        raise UserError(f"{name} is no table in CSV: {error}.") from None


def _parsed(text: str, name: str) -> Record:
    lines = (line for line in io.StringIO(text) if line.strip() and not line.startswith("#"))
    reader = csv.DictReader(lines, skipinitialspace=True)
    header = [one.strip() for one in reader.fieldnames or ()]
    missing = [one for one in COLUMNS if one not in header and one != "command_mm"]
    if missing:
        raise UserError(f"{name} lacks the columns {', '.join(missing)}; its first line must name them.")
    reader.fieldnames = header
    found: dict[str, list[tuple[float, float]]] = {"sensor_mm": [], "image_mm": []}
    last = -math.inf
    for number, row in enumerate(reader, start=1):
        where = f"{name}, row {number}"
        time = _number(row["time_s"], where, "time_s")
        if time is None or time <= last:
            raise UserError(f"{where}: time_s must be there and increase; the row before has {last:g}.")
        last = time
        if _number(row.get("command_mm"), where, "command_mm"):
            raise UserError(
                f"{where}: the stage was commanded; record a run with the controller switched off."
            )
        for column, samples in found.items():
            value = _number(row[column], where, column)
            if value is not None:
                samples.append((time, value))
    lens, image = (_even(samples, f"{name}, column {column}") for column, samples in found.items())
    return Record(lens[0], 1e-3 * lens[1], image[0], 1e-3 * image[1])


def _number(cell: str | None, where: str, column: str) -> float | None:
    """Return a cell's value; None where it is empty."""
    if cell is None or not cell.strip():
        return None
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UserError(f"{where}: {column} is {cell.strip()!r}; it must be a finite number, or empty.")
    return value


def _even(samples: list[tuple[float, float]], where: str) -> tuple[Array, Array]:
    """Return even instants and values of a signal."""
    if len(samples) < 2:
        raise UserError(f"{where} has {len(samples)} values; a signal needs many.")
    time, values = np.array(samples).T
    even = np.linspace(time[0], time[-1], len(time))
    step = even[1] - even[0]
    off = np.abs(time - even)
    if off.max() > _JITTER * step:
        raise UserError(
            f"{where}: samples must be evenly spaced; that at {time[off.argmax()]:g} s is "
            f"{1e3 * off.max():.3g} ms off a step of {1e3 * step:.4g} ms."
        )
    return even, values
