"""Matrices as DMIG cards of Nastran (punch files ``.pch``), in fixed fields of 8 or 16 characters.

A header card names the matrix and its form (6: symmetric, each pair of entries once; 1: square); a column
card gives node and direction of one column, its continuations the rows and values (MSC Nastran Quick
Reference Guide, bulk data entry DMIG).
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import (
    DIRECTIONS,
    Array,
    Contents,
    Entries,
    Integers,
    fixed_reals,
    whole_lines,
)

Texts = NDArray[np.bytes_]
SQUARE, SYMMETRIC = 1, 6


def read_matrices(path: Path) -> Contents:
    """Return the square real matrices of a punch file by their names; others (PAX, VAX, ...) are passed over.

    Raises
    ------
    UserError
        If there is no DMIG card, all matrices are complex or rectangular, or a card cannot be read.
    """
    source = path.name
    lines = [line.rstrip() for line in whole_lines(path).upper().split(b"\n")]
    cards = [line for line in lines if line and not line.startswith(b"$")]
    if any(b"," in line for line in cards if line.startswith(b"DMIG")):
        raise UserError(f"{source}: DMIG cards in free fields (commas) are not read, write fixed fields")
    text = np.array(cards, dtype="S80").view("S1").reshape(len(cards), 80)
    first = np.char.strip(_field(text, 0, 8))
    continued = np.isin(text[:, 0], [b"*", b"+", b""]) | (text[:, 0] == b" ")
    owner = np.maximum.accumulate(np.where(continued, 0, np.arange(len(cards))))
    head = np.char.startswith(first, b"DMIG") & (np.char.strip(_field(text, 16, 24)) == b"0")
    head &= first == b"DMIG"
    if not head.any():
        raise UserError(f"{source} holds no matrix: no DMIG card with its header was found")
    matrices = {}
    refused = []
    for card in text[head]:
        name, symmetric, refusal = _header(card[None], source)
        if refusal:
            refused.append(refusal)
            continue
        large = np.char.startswith(first, b"DMIG*") & (np.char.strip(_field(text, 8, 24)) == name)
        small = (first == b"DMIG") & (np.char.strip(_field(text, 8, 16)) == name) & ~head
        wide, narrow = text[large[owner]], text[small[owner]]
        parts = [_large(wide, large[large[owner]], source), _small(narrow, small[small[owner]], source)]
        rows, columns, values = (np.concatenate(pair) for pair in zip(*parts, strict=True))
        label = f"{name.decode()} of {source}"
        matrices[name.decode()] = Entries(label, rows, columns, values, None, symmetric)
    if not matrices:
        raise UserError(refused[0])
    return Contents(matrices)


def _header(card: NDArray[np.bytes_], source: str) -> tuple[bytes, bool, str]:
    """Return the name, whether the matrix is symmetric, and why it is refused, if it is."""
    name = _field(card, 8, 16)[0].strip()
    form, kind = (_integers(_field(card, a, a + 8), source, blank=1)[0] for a in (24, 32))
    refusal = ""
    if kind not in (1, 2):
        refusal = f"{source}: the matrix {name.decode()} is complex (TIN {kind}), a real one is needed"
    elif form not in (SQUARE, SYMMETRIC):
        refusal = f"{source}: the matrix {name.decode()} is rectangular (IFO {form}), it must be square"
    return name, bool(form == SYMMETRIC), refusal


def _large(text: Texts, begins: NDArray[np.bool_], source: str) -> tuple[Integers, Integers, Array]:
    """Return row keys, column keys and values of cards with fields of 16 characters."""
    column = _keys(text[begins], 24, 40, 16, source)[np.cumsum(begins) - 1] if len(text) else _none()[0]
    rest, column = text[~begins], column[~begins]
    full = np.char.strip(_field(rest, 8, 24)) != b""
    rest, column = rest[full], column[full]
    return _keys(rest, 8, 24, 16, source), column, fixed_reals(_field(rest, 40, 56), source)


def _small(text: Texts, begins: NDArray[np.bool_], source: str) -> tuple[Integers, Integers, Array]:
    """Return the same of cards with fields of 8 characters: one or two entries in a line."""
    if not len(text):
        return _none()
    column = _keys(text[begins], 16, 24, 8, source)[np.cumsum(begins) - 1]
    parts = []
    for start, mask in ((8, ~begins), (40, np.ones(len(text), dtype=bool))):
        full = mask & (np.char.strip(_field(text, start, start + 8)) != b"")
        values = fixed_reals(_field(text[full], start + 16, start + 24), source)
        parts.append((_keys(text[full], start, start + 8, 8, source), column[full], values))
    rows, columns, entries = (np.concatenate(pair) for pair in zip(*parts, strict=True))
    return rows, columns, entries


def _none() -> tuple[Integers, Integers, Array]:
    return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0)


def _field(text: Texts, start: int, stop: int) -> Texts:
    """Return the characters start..stop of each line as one string each."""
    return np.ascontiguousarray(text[:, start:stop]).view(f"S{stop - start}").reshape(len(text))


def _keys(text: Texts, start: int, stop: int, width: int, source: str) -> Integers:
    """Return the keys of node and direction in two fields beside each other."""
    nodes = _integers(_field(text, start, stop), source)
    return DIRECTIONS * nodes + _integers(_field(text, stop, stop + width), source, blank=0)


def _integers(fields: Texts, source: str, blank: int | None = None) -> Integers:
    if blank is not None:
        fields = np.where(np.char.strip(fields) == b"", str(blank).encode(), fields)
    try:
        return fields.astype(np.int64)
    except ValueError as error:
        raise UserError(f"{source}: a DMIG card cannot be read ({error}); the file may be cut off") from error
