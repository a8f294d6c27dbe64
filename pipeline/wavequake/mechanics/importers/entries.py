"""What every reader of matrix files returns, and fast reading of numbers from text."""

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import scipy  # its parts load when first used
from numpy.typing import NDArray

from wavequake import user_files
from wavequake.errors import UserError

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

DIRECTIONS = 16
"""A labeled degree of freedom has the key ``DIRECTIONS * node + direction``, direction 1 to 6."""


@dataclass(frozen=True)
class Entries:
    """Entries of one square matrix as a file holds them.

    Attributes
    ----------
    source : str
        File (and matrix) for messages.
    rows, columns : ndarray of int
        Positions from 0 or, where `size` is None, keys of degrees of freedom (see `DIRECTIONS`).
    values : ndarray
    size : int or None
        Order of the matrix; None where the format labels rows and columns by node and direction.
    one_triangle : bool
        The format gives each pair of symmetric entries once.
    """

    source: str
    rows: Integers
    columns: Integers
    values: Array
    size: int | None
    one_triangle: bool


@dataclass(frozen=True)
class Contents:
    """What one file holds: named matrices and perhaps degrees of freedom and node coordinates.

    Attributes
    ----------
    matrices : mapping of str to Entries
        A file of one matrix calls it by an empty name.
    dofs : ndarray of int, shape (n, 2), or None
        Number of the node and direction (1 to 6) of each degree of freedom.
    node_numbers, coordinates : ndarray, shapes (N,) and (N, 3), or None
    keeps_fixed : bool
        Degrees of freedom that the program holds fixed stay in its matrices, as empty rows.
    """

    matrices: Mapping[str, Entries] = field(default_factory=dict)
    dofs: Integers | None = None
    node_numbers: Integers | None = None
    coordinates: Array | None = None
    keeps_fixed: bool = False


def read_bytes(path: Path) -> bytes:
    """Return a file's bytes.

    Raises
    ------
    UserError
        If it cannot be read, is empty or too large.
    """
    data = user_files.read_bytes(path)
    if not data.strip():
        raise UserError(f"{path} is empty")
    return data


def whole_lines(path: Path) -> bytes:
    """Return the bytes of a text file that a program wrote line by line.

    A number that is cut off may still read as one, so the last line must have its end.

    Raises
    ------
    UserError
        If it cannot be read, is empty, holds zero bytes or ends within a line.
    """
    data = read_bytes(path)
    if b"\0" in data:  # SciPy's reader of triples would crash on it
        raise UserError(f"{path.name} holds zero bytes: it is no text file, or it is damaged")
    if not data.endswith(b"\n"):
        line = data.count(b"\n") + 1
        raise UserError(f"{path.name}, line {line} has no end: the file is cut off, write it again")
    return data


def numbers(data: bytes, source: str, columns: int, first_line: int = 1) -> Array:
    """Return a table of numbers separated by blanks or commas, shape (lines, columns).

    Parameters
    ----------
    data : bytes
    source : str
        File, for messages.
    columns : int
        Numbers in each line.
    first_line : int
        Where `data` begins in the file.

    Raises
    ------
    UserError
        If a line has not `columns` numbers; the line is named.
    """
    from pandas import read_csv  # studies that read no file spare its 0.3 s

    try:
        table = read_csv(io.BytesIO(data.replace(b",", b" ")), sep=r"\s+", header=None, dtype=np.float64)
        values = table.to_numpy()
    except ValueError:  # among them pandas' own errors: the search below finds the line
        values = np.zeros((0, 0))
    if values.shape[1] == columns and not np.isnan(values).any():
        return np.ascontiguousarray(values)
    number, line = _bad_line(data, columns)
    if number < 0:  # what pandas does not read: nan, and Fortran's exponents D
        words = data.replace(b",", b" ").upper().replace(b"D", b"E").split()
        return np.array(words, dtype=np.bytes_).astype(np.float64).reshape(-1, columns)
    raise UserError(
        f"{source}, line {number + first_line}: {columns} numbers expected, found "
        f"{line.decode(errors='replace').strip()[:60]!r}; the file may be cut off"
    )


def whole(values: Array, source: str) -> Integers:
    """Return numbers of nodes, directions or rows; UserError if they are not whole or too large for one."""
    if not (np.abs(values) < 2.0**53).all() or (values != np.rint(values)).any():
        bad = values[~((np.abs(values) < 2.0**53) & (values == np.rint(values)))][0]
        raise UserError(f"{source}: {bad:g} is no number of a node, direction or row")
    return values.astype(np.int64)


def triples(data: bytes, source: str, size: int, first_line: int = 1) -> tuple[Integers, Integers, Array]:
    """Return rows, columns (from 0) and values of lines ``row column value``; several times 100 MB/s.

    Raises
    ------
    UserError
        If a line is not two positions within 1..size and a number; the line is named.
    """
    data = data.rstrip() + b"\n"
    count = data.count(b"\n")
    head = b"%%%%MatrixMarket matrix coordinate real general\n%d %d %d\n" % (size, size, count)
    try:
        matrix = scipy.io.mmread(io.BytesIO(head + data), spmatrix=False)
    except (ValueError, OverflowError):
        table = numbers(data, source, 3, first_line)
        bad = np.flatnonzero(~((table[:, :2] >= 1) & (table[:, :2] <= size)).all(axis=1))
        if not len(bad):
            places = whole(table[:, :2], source) - 1
            return places[:, 0], places[:, 1], table[:, 2]
        raise UserError(
            f"{source}, line {bad[0] + first_line}: row {table[bad[0], 0]:.0f}, column "
            f"{table[bad[0], 1]:.0f} lies outside the matrix of order {size}"
        ) from None
    rows, columns = matrix.coords
    return rows.astype(np.int64), columns.astype(np.int64), np.asarray(matrix.data, dtype=np.float64)


def _bad_line(data: bytes, columns: int) -> tuple[int, bytes]:
    """Return the first line (from 0) that is not `columns` numbers, or -1 if all are."""
    for number, line in enumerate(data.split(b"\n")):
        words = line.replace(b",", b" ").split()
        if words and (len(words) != columns or not all(map(_is_number, words))):
            return number, line
    return -1, b""


def _is_number(word: bytes) -> bool:
    return (
        re.fullmatch(rb"[+-]?(\d+\.?\d*([eEdD][+-]?\d+)?|\.\d+([eEdD][+-]?\d+)?|nan|inf(inity)?)", word)
        is not None
    )


def fixed_reals(fields: NDArray[np.bytes_], source: str) -> Array:
    """Return numbers of fixed fields as Fortran writes them: ``1.5D+03`` and ``1.5+3`` are 1500.

    Raises
    ------
    UserError
        If a field is not a number; it is quoted.
    """
    if not fields.size:
        return np.zeros(fields.shape)
    plain = np.char.replace(np.char.strip(fields), b"D", b"E")
    try:
        return np.asarray(plain.astype(np.float64))
    except ValueError:
        pass
    texts = [re.sub(rb"(?<=[\d.])([+-]\d+)$", rb"E\1", word) for word in plain.ravel().tolist()]
    for text in texts:
        if not _is_number(text):
            raise UserError(
                f"{source}: {text.decode(errors='replace')!r} is not a number; the file may be cut off"
            )
    return np.array([float(text) for text in texts]).reshape(fields.shape)
