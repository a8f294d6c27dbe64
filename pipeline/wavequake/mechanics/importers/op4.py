"""Matrices of Nastran's OUTPUT4 files (``.op4``), text or binary, dense, sparse or BIGMAT.

Each column is a record: column number, first row (0: sparse strings follow) and number of words. A sparse
string begins with its length and row, packed into one integer or, in BIGMAT, two (MSC Nastran Quick
Reference Guide, OUTPUT4; pyYeti documents the layouts as well).
"""

import re
from pathlib import Path

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Array, Contents, Entries, fixed_reals, read_bytes

SYMMETRIC = 6
BIG = 65536
"""From this number of rows on, strings have two integers even without the sign that says BIGMAT."""
_HEADER = 24  # bytes of a matrix's first record where integers have 32 bits
Run = tuple[int, int, int]  # column, first row, count; all from 0


def read_matrices(path: Path) -> Contents:
    """Return the square real matrices of an OUTPUT4 file by their names.

    Loads and recovery matrices (PA, VAX, ... of EXTSEOUT) are passed over.

    Raises
    ------
    UserError
        If the file is cut off, or all its matrices are complex or not square.
    """
    data = read_bytes(path)
    binary = min(data[:4]) == 0
    try:
        matrices, refused = _binary(data, path.name) if binary else _text(data, path.name)
    except (IndexError, ValueError, OverflowError) as error:
        raise UserError(f"{path.name} is no OUTPUT4 file, or is cut off: {error}") from error
    if not matrices:
        raise UserError(refused[0] if refused else f"{path.name} holds no matrix")
    return Contents(matrices)


def _entries(source: str, shape: tuple[int, int], runs: list[Run], values: Array) -> Entries:
    """Spread runs of entries over rows and columns; shape: columns and form."""
    table = np.array(runs, dtype=np.int64).reshape(-1, 3)
    columns, starts, counts = table.T
    if counts.sum() != len(values):
        raise ValueError(f"{source} announces {counts.sum()} entries and has {len(values)}")
    within = np.arange(len(values)) - np.repeat(np.cumsum(counts) - counts, counts)
    rows = np.repeat(starts, counts) + within
    return Entries(source, rows, np.repeat(columns, counts), values, shape[0], shape[1] == SYMMETRIC)


def _refusal(name: str, rows: int, columns: int, kind: int, source: str) -> str:
    """Return why a matrix is none of stiffness or mass; an empty text if it may be one."""
    if kind not in (1, 2):
        return f"{source}: the matrix {name} is complex (type {kind}), a real one is needed"
    if abs(rows) != columns:
        return f"{source}: the matrix {name} has {abs(rows)} rows and {columns} columns, not square"
    return ""


def _words(kind: int) -> int:
    """Return how many words a real number, or each part of a complex one, takes."""
    return 2 - kind % 2


def _text(data: bytes, source: str) -> tuple[dict[str, Entries], list[str]]:
    lines = [line.rstrip(b"\r") for line in data.split(b"\n")]
    matrices: dict[str, Entries] = {}
    refused: list[str] = []
    at = 0
    while at < len(lines) and lines[at].strip():
        head = lines[at].decode()
        columns, rows, form, kind = (int(head[k : k + 8]) for k in (0, 8, 16, 24))
        name = head[32:40].strip().upper()
        refusal = _refusal(name, rows, columns, kind, source)
        digits = re.search(r"(\d*)[ED](\d+)\.", head[40:].upper().replace("1P,", ""))
        per_line, width = (int(digits[1] or 1), int(digits[2])) if digits else (5, 16)
        runs, texts, at = _text_columns(lines, at + 1, columns, (rows, kind, per_line))
        if refusal:
            refused.append(refusal)
            continue
        fields = np.frombuffer(b"".join(texts), dtype=f"S{width}")
        values = fixed_reals(fields, source)
        matrices[name] = _entries(f"{name} of {source}", (columns, form), runs, values)
    return matrices, refused


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
                count = length // _words(kind)
                words -= length + (2 if big else 1)
            stop = at + -(-count // per_line)
            runs.append((column - 1, start, count))
            texts += lines[at:stop]
            at = stop


def _string(head: tuple[int, ...], big: bool) -> tuple[int, int]:
    """Return the number of words and the first row (from 0) of a sparse string."""
    length, row = (head[0] - 1, head[1] - 1) if big else ((head[0] >> 16) - 1, (head[0] & 0xFFFF) - 1)
    if length < 1:
        raise ValueError(f"a string of {length} words")
    return length, row


def _binary(data: bytes, source: str) -> tuple[dict[str, Entries], list[str]]:
    order = "<" if data[0] else ">"
    raw = np.frombuffer(data, order + "i4")
    if raw[0] != _HEADER:
        raise UserError(f"{source} has 64-bit integers (or is no OUTPUT4 file); write it with 32-bit ones")
    words = raw.astype(np.intc).data  # plain integers, several times faster than those of an array
    matrices: dict[str, Entries] = {}
    refused: list[str] = []
    at = 0
    while at < len(words):
        columns, rows, form, kind = words[at + 1 : at + 5].tolist()
        name = data[4 * at + 20 : 4 * at + 28].decode("latin-1").strip().upper()
        refusal = _refusal(name, rows, columns, kind, source)
        runs, starts, at = _binary_columns(words, at + _HEADER // 4 + 2, columns, (rows, kind))
        if refusal:
            refused.append(refusal)
            continue
        sizes = kind * np.array([run[2] for run in runs], dtype=np.int64)
        places = np.repeat(np.array(starts, dtype=np.int64) - np.cumsum(sizes) + sizes, sizes)
        values = raw[places + np.arange(len(places))].view(order + ("f4", "f8")[kind - 1]).astype(np.float64)
        matrices[name] = _entries(f"{name} of {source}", (columns, form), runs, values)
    return matrices, refused


def _binary_columns(
    words: memoryview, at: int, last: int, layout: tuple[int, int]
) -> tuple[list[Run], list[int], int]:
    """Return runs, the words where their values begin, and the word after the matrix; layout: rows, type."""
    rows, kind = layout
    big = rows < 0 or rows >= BIG
    runs: list[Run] = []
    starts: list[int] = []
    while True:
        length, column, row, count = words[at : at + 4].tolist()
        following = at + length // 4 + 2
        if length < 12 or following > len(words):
            raise ValueError(f"a record of {length} bytes begins at byte {4 * at}")
        at += 4
        if column > last:
            return runs, starts, following
        if row:  # dense
            if not 0 < count < following - at:
                raise ValueError(f"a column of {count} words does not fit its record")
            runs.append((column - 1, row - 1, count // _words(kind)))
            starts.append(at)
        while not row and count > 0:
            size, start = _string((words[at], words[at + 1]), big)
            at += 1 + big
            runs.append((column - 1, start, size // _words(kind)))
            starts.append(at)
            at += size
            if at >= following:
                raise ValueError(f"a string of {size} words is longer than its record")
            count -= size + 1 + big
        at = following
