"""Heights of a surface on a regular grid, measured or designed: CSV, NPY and Zemax's grid files (.dat)."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.user_files import read_bytes, read_npy, read_text

Array = NDArray[np.float64]
Content = TypeVar("Content", str, bytes)

MAX_NODES = 512 * 512
_MM_PER_UNIT = (1.0, 10.0, 25.4, 1000.0)  # unit flags 0 to 3 of a grid file: mm, cm, in, m


@dataclass(frozen=True)
class SagTable:
    """Heights (rows, columns) in mm, rows towards +y and columns towards +x.

    ``spacing`` is (dx, dy) in mm, None where the file does not say.
    """

    heights: Array
    spacing: tuple[float, float] | None


def read_sag(path: str | Path) -> SagTable:
    """Read a table of heights; the end of its name tells the format.

    ``.csv`` holds one row of the grid per line, from the lowest y upwards, numbers in mm divided by commas;
    lines that start with # are comments. ``.npy`` holds the same as a NumPy array. ``.dat`` is the grid file
    of Zemax's Grid Sag surface: a line "nx ny delx dely unitflag xdec ydec", then a line per node, whose
    first number is the height, from the upper left (-x, +y) along x and then downwards.

    Raises
    ------
    UserError
        If the file cannot be read or holds no such table; the message names it and the line.
    """
    if not isinstance(path, str | Path):
        raise UserError(f"The sag file is {path!r}; it must be the path of a file, as text.")
    path = Path(path)
    readers = {".csv": _csv, ".npy": _npy, ".dat": _dat}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise UserError(f"The sag file {path} must be a .csv, .npy or .dat file.")
    table = reader(path)
    shape = table.heights.shape
    if len(shape) != 2 or min(shape) < 4 or table.heights.size > MAX_NODES:
        raise UserError(
            f"The sag file {path} holds heights of the shape {shape}; it needs rows and columns, 4 of each "
            f"at least and {MAX_NODES} heights at most."
        )
    if not np.isfinite(table.heights).all():
        row, column = np.argwhere(~np.isfinite(table.heights))[0]
        raise UserError(
            f"The sag file {path} has no finite height in row {row + 1} and column {column + 1} (counted "
            "from the lowest y and x); fill its holes first."
        )
    return table


def _from(path: Path, read: Callable[[Path], Content]) -> Content:
    try:
        return read(path)
    except UserError as error:
        raise UserError(f"The sag file {error}") from None


def _csv(path: Path) -> SagTable:
    rows: list[list[float]] = []
    for number, line in enumerate(_from(path, read_text).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        rows.append(_numbers(path, number, line.split(",")))
        if len(rows[-1]) != len(rows[0]):
            raise UserError(
                f"{path}, line {number}: it has {len(rows[-1])} heights, the first row {len(rows[0])}."
            )
    return SagTable(np.array(rows), None)


def _npy(path: Path) -> SagTable:
    data = _from(path, read_bytes)
    if data.startswith(b"PK"):
        raise UserError(f"The sag file {path} holds several arrays (.npz); save the one of heights as .npy.")
    try:
        heights = read_npy(data)
    except UserError as error:
        raise UserError(f"The sag file {path}: {error}.") from None
    if not (np.issubdtype(heights.dtype, np.floating) or np.issubdtype(heights.dtype, np.integer)):
        raise UserError(f"The sag file {path} holds {heights.dtype}, not numbers.")
    with np.errstate(over="ignore"):  # numbers that are too large become infinite, and are refused as such
        return SagTable(heights.astype(np.float64), None)


def _dat(path: Path) -> SagTable:
    numbered = enumerate(_from(path, read_text).splitlines(), start=1)
    lines = [(number, line) for number, line in numbered if line.strip() and not line.startswith("!")]
    if not lines:
        raise UserError(f"The sag file {path} is empty.")
    head = _numbers(path, lines[0][0], lines[0][1].split())
    whole = (
        len(head) == 7
        and np.isfinite(head).all()
        and [int(head[k]) for k in (0, 1, 4)] == [*head[:2], head[4]]
        and 0 < head[0] * head[1] <= MAX_NODES
        and head[0] > 0
    )
    if not whole or not 0 <= head[4] < len(_MM_PER_UNIT):
        raise UserError(
            f"{path}, line {lines[0][0]}: it must be nx ny delx dely unitflag xdec ydec, with whole numbers "
            f"nx, ny above 0 (at most {MAX_NODES} nodes) and a unit flag from 0 (mm) to 3 (m)."
        )
    columns, rows, scale = int(head[0]), int(head[1]), _MM_PER_UNIT[int(head[4])]
    if head[5] or head[6]:
        raise UserError(f"{path}, line {lines[0][0]}: the grid is decentered, which is not supported.")
    if len(lines) - 1 != rows * columns:
        raise UserError(
            f"{path}: {rows} rows and {columns} columns are announced, {len(lines) - 1} nodes follow."
        )
    heights = np.empty(rows * columns)
    for node, (number, line) in enumerate(lines[1:]):
        values = _numbers(path, number, line.split())
        if len(values) > 4 and values[4]:
            raise UserError(f"{path}, line {number}: the node has no data; fill the holes of the grid first.")
        heights[node] = scale * values[0]
    spacing = (scale * abs(head[2]), scale * abs(head[3]))
    return SagTable(heights.reshape(rows, columns)[::-1].copy(), spacing)


def _numbers(path: Path, number: int, words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError:
        raise UserError(f"{path}, line {number}: {' '.join(words)[:40]!r} are not numbers.") from None
