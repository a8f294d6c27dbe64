"""Matrices of Nastran's OUTPUT4 files (``.op4``), text or binary, dense, sparse or BIGMAT.

Each column is a record: column number, first row (0: sparse strings follow) and number of words. A sparse
string begins with its length and row, packed into one integer or, in BIGMAT, two (MSC Nastran Quick
Reference Guide, OUTPUT4; pyYeti documents the layouts as well).
"""

import re
import struct
from pathlib import Path

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Array, Contents, Entries, fixed_reals, read_bytes

SYMMETRIC = 6
BIG = 65536
"""From this number of rows on, strings have two integers even without the sign that says BIGMAT."""
Run = tuple[int, int, int]  # column, first row, count; all from 0


def read_matrices(path: Path) -> Contents:
    """Return the matrices of an OUTPUT4 file by their names.

    Raises
    ------
    UserError
        If the file is cut off, or a matrix is complex or not square.
    """
    data = read_bytes(path)
    binary = min(data[:4]) == 0
    try:
        matrices = _binary(data, path.name) if binary else _text(data, path.name)
    except (struct.error, IndexError, ValueError) as error:
        raise UserError(f"{path.name} is no OUTPUT4 file, or is cut off: {error}") from error
    if not matrices:
        raise UserError(f"{path.name} holds no matrix")
    return Contents(matrices)


def _entries(source: str, size: int, runs: list[Run], values: Array) -> Entries:
    """Spread runs of entries over rows and columns."""
    table = np.array(runs, dtype=np.int64).reshape(-1, 3)
    columns, starts, counts = table.T
    if counts.sum() != len(values):
        raise ValueError(f"{source} announces {counts.sum()} entries and has {len(values)}")
    within = np.arange(len(values)) - np.repeat(np.cumsum(counts) - counts, counts)
    rows = np.repeat(starts, counts) + within
    return Entries(source, rows, np.repeat(columns, counts), values, size, False)


def _check(name: str, rows: int, columns: int, kind: int, source: str) -> None:
    if kind not in (1, 2):
        raise UserError(f"{source}: the matrix {name} is complex (type {kind}), a real one is needed")
    if abs(rows) != columns:
        raise UserError(f"{source}: the matrix {name} has {abs(rows)} rows and {columns} columns, not square")


def _text(data: bytes, source: str) -> dict[str, Entries]:
    lines = [line.rstrip(b"\r") for line in data.split(b"\n")]
    matrices: dict[str, Entries] = {}
    at = 0
    while at < len(lines) and lines[at].strip():
        head = lines[at].decode()
        columns, rows, _, kind = (int(head[k : k + 8]) for k in (0, 8, 16, 24))
        name = head[32:40].strip().upper()
        _check(name, rows, columns, kind, source)
        form = re.search(r"(\d*)[ED](\d+)\.", head[40:].upper().replace("1P,", ""))
        per_line, width = (int(form[1] or 1), int(form[2])) if form else (5, 16)
        runs, texts, at = _text_columns(lines, at + 1, columns, (rows, kind, per_line))
        fields = np.frombuffer(b"".join(texts), dtype=f"S{width}")
        matrices[name] = _entries(f"{name} of {source}", columns, runs, fixed_reals(fields, source))
    return matrices


def _text_columns(
    lines: list[bytes], at: int, last: int, layout: tuple[int, int, int]
) -> tuple[list[Run], list[bytes], int]:
    """Return runs, their text and the line after the matrix; layout: rows, type and numbers in a line."""
    rows, kind, per_line = layout
    big = rows < 0 or rows >= BIG
    runs: list[Run] = []
    texts: list[bytes] = []
    while True:
        if at >= len(lines) or not lines[at].strip():
            raise ValueError(f"the last column is missing at line {at + 1}")
        column, row, words = (int(lines[at][k : k + 8]) for k in (0, 8, 16))
        at += 1
        if column > last:
            return runs, texts, at + -(-words // per_line)
        while words > 0:
            if row:  # dense
                start, count, words = row - 1, words, 0
            else:
                length, start = _string(tuple(int(part) for part in lines[at].split()), big)
                at += 1
                count = length // kind
                words -= length + (2 if big else 1)
            stop = at + -(-count // per_line)
            runs.append((column - 1, start, count))
            texts += lines[at:stop]
            at = stop


def _string(head: tuple[int, ...], big: bool) -> tuple[int, int]:
    """Return the number of words and the first row (from 0) of a sparse string."""
    if big:
        return head[0] - 1, head[1] - 1
    return (head[0] >> 16) - 1, (head[0] & 0xFFFF) - 1


def _binary(data: bytes, source: str) -> dict[str, Entries]:
    order = "<" if data[0] else ">"
    if struct.unpack_from(order + "i", data)[0] != 24:
        raise UserError(f"{source} has 64-bit integers (or is no OUTPUT4 file); write it with 32-bit ones")
    matrices: dict[str, Entries] = {}
    at = 0
    while at < len(data):
        columns, rows, _, kind = struct.unpack_from(order + "4i", data, at + 4)
        name = data[at + 20 : at + 28].decode("latin-1").strip().upper()
        _check(name, rows, columns, kind, source)
        runs, parts, at = _binary_columns(data, at + 32, columns, (rows, kind, order))
        values = np.concatenate([np.zeros(0), *parts]).astype(np.float64)
        matrices[name] = _entries(f"{name} of {source}", columns, runs, values)
    return matrices


def _binary_columns(
    data: bytes, at: int, last: int, layout: tuple[int, int, str]
) -> tuple[list[Run], list[Array], int]:
    """Return runs, their values and the byte after the matrix; layout: rows, type and byte order."""
    rows, kind, order = layout
    big = rows < 0 or rows >= BIG
    runs: list[Run] = []
    parts: list[Array] = []
    while True:
        length, column, row, words = struct.unpack_from(order + "4i", data, at)
        following = at + length + 8
        if following > len(data):
            raise ValueError(f"a record of {length} bytes begins at byte {at}, {len(data) - at} are left")
        at += 16
        if column > last:
            return runs, parts, following
        while words > 0:
            if row:  # dense
                start, size, words = row - 1, words, 0
            else:
                head = struct.unpack_from(order + ("2i" if big else "i"), data, at)
                size, start = _string(head, big)
                at += 4 * len(head)
                words -= size + len(head)
            runs.append((column - 1, start, size // kind))
            parts.append(np.frombuffer(data, order + ("f4", "f8")[kind - 1], size // kind, at))
            at += 4 * size
        at = following
