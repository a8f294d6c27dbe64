"""Displacements, real modes and temperatures in Nastran's binary results (``.op2``), and its nodes.

The file is a sequence of Fortran records: a marker of one word, and after a positive one as many words of
data. A table is a name, a trailer, and records, each opened by a negative marker; a zero closes it (MSC
Nastran, OUTPUT2 and the data block OUG; pyNastran documents the layouts as well).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.importers.bulk import Card, axes_at, basic
from wavequake.mechanics.importers.entries import Array, Integers, read_bytes
from wavequake.mechanics.nodal.step import Kind, Step, Written, in_common_axes

Words = NDArray[np.int64]

# Tables of displacements in the basic axes, and in those that GRID cards name for each point.
_BASIC, _OWN = ("BOUGV1", "BOPHIG"), ("OUGV1", "OUGV2", "OUG1", "OUGV1PAT", "OPHIG")
_KINDS: dict[int, Kind] = {1: "case", 2: "mode", 6: "time", 10: "case"}
_DISPLACEMENT, _EIGENVECTOR = 1, 7
_GRID = (4501, 45)
_FRAMES: dict[tuple[int, ...], str] = {(2101, 21): "CORD2R", (2001, 20): "CORD2C", (2201, 22): "CORD2S"}
_ROW = 8  # words of a node: number, type, six displacements and rotations
_POINT = 1  # the type of a node; others are scalar points


@dataclass(frozen=True)
class _Format:
    """Length of a word, and the order of its bytes."""

    word: int
    order: str

    def integers(self, data: bytes) -> Words:
        return np.frombuffer(data, f"{self.order}i{self.word}", len(data) // self.word).astype(np.int64)

    def reals(self, data: bytes) -> Array:
        return np.frombuffer(data, f"{self.order}f{self.word}", len(data) // self.word).astype(np.float64)


def read_op2(path: Path) -> Written:
    """Return displacements, modes and temperatures of an ``.op2`` file, and its GRID points if it holds them.

    Complex results, velocities and other tables are passed over.

    Raises
    ------
    UserError
        If it is no such file or cut off, holds none of these, or points have axes that it does not hold.
    """
    data = read_bytes(path)
    form = _format(data, path.name)
    tables: dict[str, list[bytes]] = {}
    try:
        for name, records in _tables(data, form):
            tables.setdefault(name, []).extend(records)
    except (IndexError, ValueError, OverflowError) as error:
        raise UserError(f"{path.name} is no .op2 file, or is cut off ({error})") from None
    found = _BASIC if any(name in tables for name in _BASIC) else _OWN
    steps: list[Step] = []
    for name in found:
        steps += _steps(tables.get(name, []), form, path.name)
    if not steps:
        raise UserError(
            f"{path.name} holds no real displacements, modes or temperatures of points (tables OUG); it has "
            f"{', '.join(sorted(tables))[:200] or 'no tables'}"
        )
    grid = _grid(tables, form, path.name)
    if grid is None:
        return Written(path.name, tuple(steps), own_axes=found is _OWN)
    labels, points, turned, turns = grid
    if found is _OWN:
        steps = [in_common_axes(step, turned, turns) for step in steps]
    return Written(path.name, tuple(steps), labels, points)


def _format(data: bytes, source: str) -> _Format:
    for order in "<>":
        word = int(np.frombuffer(data[:4].ljust(4, b"\0"), f"{order}i4")[0])
        if word in (4, 8):
            return _Format(word, order)
    raise UserError(f"{source} is no .op2 file: it does not begin with a marker (OUTPUT2, unformatted)")


def _records(data: bytes, order: str) -> Iterator[bytes]:
    at, lengths = 0, np.dtype(f"{order}i4")
    while at < len(data):
        if at + 8 > len(data):
            raise ValueError(f"byte {at}")
        count = int(np.frombuffer(data, lengths, 1, at)[0])
        if count < 0 or at + 8 + count > len(data):
            raise ValueError(f"a record of {count} bytes at byte {at}")
        if int(np.frombuffer(data, lengths, 1, at + 4 + count)[0]) != count:
            raise ValueError(f"the record at byte {at} ends with another length")
        yield data[at + 4 : at + 4 + count]
        at += count + 8


def _tables(data: bytes, form: _Format) -> Iterator[tuple[str, list[bytes]]]:
    """Yield names and records of the tables, the name's own record first."""
    records = _records(data, form.order)
    name, kind_follows = "", False
    parts: list[list[bytes]] = []
    for record in records:
        if len(record) != form.word:
            raise ValueError(f"a marker of {len(record)} bytes")
        marker = int(form.integers(record)[0])
        if marker > 0:
            words = next(records, None)
            # Columns of matrices have the row where they begin besides.
            if words is None or len(words) // form.word not in (marker, marker + 1):
                raise ValueError(f"{marker} words are announced, {len(words or b'') // form.word} are there")
            if not name:
                name = _text(words) if marker == 2 else ""
            elif parts and not (kind_follows and marker == 1):
                parts[-1].append(words)
            kind_follows = False
        elif marker < 0:
            kind_follows = True
            if marker < -1:
                parts.append([])
        else:
            if name:
                yield name, [b"".join(part) for part in parts]
            name, parts, kind_follows = "", [], False


def _text(words: bytes) -> str:
    """Return characters; long words are filled up with blanks."""
    return words.replace(b" ", b"").replace(b"\0", b"").decode("latin-1")


def _steps(records: list[bytes], form: _Format, source: str) -> Iterator[Step]:
    """Yield the steps of a table OUG: pairs of a record that identifies one, and its rows."""
    at = 0
    while at + 1 < len(records):
        head, rows = records[at], records[at + 1]
        words = form.integers(head)
        if len(words) < 50:  # the name's record, or an empty one at the end
            at += 1
            continue
        at += 2
        kind, table, sort = _KINDS.get(int(words[0]) // 10), int(words[1]) % 1000, int(words[1]) // 1000
        if kind is None or table not in (_DISPLACEMENT, _EIGENVECTOR) or sort not in (0, 2):
            continue
        if sort == 2:
            raise UserError(f"{source} holds results by node (SORT2); write them by instant (SORT1)")
        if words[8] != 1 or words[9] != _ROW:
            continue  # complex
        if len(rows) % (_ROW * form.word):
            raise UserError(f"{source}: {len(rows)} bytes are no whole rows of a node; the file is damaged")
        whole = form.integers(rows).reshape(-1, _ROW)
        thermal = words[22] == 1
        point = (whole[:, 1] == _POINT) | thermal
        values = form.reals(rows).reshape(-1, _ROW)[point, 2 : 3 if thermal else _ROW]
        labels = whole[point, 0] // 10
        number, real = int(words[4]), form.reals(head)
        value = float(real[4])
        if kind == "mode":
            value = float(np.sqrt(max(real[5], 0.0)) / (2.0 * np.pi))
        elif kind == "case":
            number, value = int(words[3]), 0.0
        if len(labels):
            yield Step(kind, number, value, labels, np.ascontiguousarray(values))


def _grid(
    tables: dict[str, list[bytes]], form: _Format, source: str
) -> tuple[Integers, Array, Integers, Array] | None:
    """Return the nodes of the tables GEOM1: numbers and places, and which move in axes of their own (CD)."""
    records = [
        record for name in ("GEOM1", "GEOM1S", "GEOM1N", "GEOM1OLD") for record in tables.get(name, [])
    ]
    axes = _axes(records, form, source)
    parts = [_points(record, form, source) for record in records if _key(record, form) == _GRID]
    if not parts:
        return None
    labels, points, given, moving = (np.concatenate(one) for one in zip(*parts, strict=True))
    for frame in np.unique(given[given > 0]):
        points[given == frame] = basic(points[given == frame], str(frame), axes, source)
    turned = np.flatnonzero(moving > 0)
    turns = np.zeros((len(turned), 3, 3))
    for frame in np.unique(moving[turned]):
        mine = moving[turned] == frame
        turns[mine] = axes_at(points[turned[mine]], str(frame), axes, source)
    return labels, points, labels[turned], turns


def _key(record: bytes, form: _Format) -> tuple[int, ...]:
    words = form.integers(record[: 2 * form.word])
    return tuple(words.tolist())


def _points(record: bytes, form: _Format, source: str) -> tuple[Integers, Array, Integers, Integers]:
    """Return numbers, coordinates, and the axes of coordinates and displacements of GRID cards."""
    words = form.integers(record)
    card, long = 8, (len(words) - 3) % 8 != 0
    if long and form.word == 4 and (len(words) - 3) % 11 == 0:
        card = 11  # coordinates of eight bytes
    elif long:
        raise UserError(f"{source}: its GRID cards have {len(words) - 3} words; the file is damaged")
    whole, wide = words[3:].reshape(-1, card), 2 if card == 11 else 1
    xyz = _reals(record, form, card, 2, wide)
    return whole[:, 0], xyz, whole[:, 1], whole[:, 2 + 3 * wide]


def _reals(record: bytes, form: _Format, card: int, first: int, wide: int) -> Array:
    """Return the real numbers of cards from a word on: three of GRID, nine of axes."""
    count = (3 if first == 2 else 9) * wide
    body = np.frombuffer(record, np.uint8)[3 * form.word :].reshape(-1, card * form.word)
    part = np.ascontiguousarray(body[:, first * form.word : (first + count) * form.word])
    return part.view(np.dtype(f"{form.order}f{form.word * wide}")).astype(np.float64)


def _axes(records: list[bytes], form: _Format, source: str) -> dict[str, Card]:
    """Return the cards CORD2R, CORD2C and CORD2S: number, two kinds, the axes in which they stand, points."""
    found: dict[str, Card] = {}
    for record in records:
        name = _FRAMES.get(_key(record, form)) if len(record) >= 3 * form.word else None
        if name is None:
            continue
        words = form.integers(record)[3:]
        card = 13 if len(words) % 13 == 0 else 22  # places of eight bytes
        if len(words) % card or (card == 22 and form.word != 4):
            raise UserError(f"{source}: its {name} cards have {len(words)} words; the file is damaged")
        places = _reals(record, form, card, 4, 1 if card == 13 else 2)
        for whole, numbers in zip(words.reshape(-1, card), places, strict=True):
            fields = [str(whole[0]), str(whole[3]), *(repr(float(one)) for one in numbers)]
            found[fields[0]] = Card(name, fields, 0)
    return found
