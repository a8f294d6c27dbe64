"""Nodes, sets and elements of CalculiX and Abaqus input decks (``.inp``), with their node numbers.

meshio reads these decks too but renumbers the nodes, and matrices are labeled by the numbers of the deck.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Array, Integers, numbers, read_bytes, whole

MOST_NODES = 20_000_000
Block = tuple[str, dict[str, str], bytes, int]  # keyword, options, data lines, first line

# Nodes of solid, shell, plane and beam elements, by the names of meshio.
KINDS = {
    "C3D4": ("tetra", 4),
    "C3D10": ("tetra10", 10),
    "C3D8": ("hexahedron", 8),
    "C3D20": ("hexahedron20", 20),
    "C3D6": ("wedge", 6),
    "C3D15": ("wedge15", 15),
    "S3": ("triangle", 3),
    "S4": ("quad", 4),
    "S6": ("triangle6", 6),
    "S8": ("quad8", 8),
    "B31": ("line", 2),
    "B32": ("line3", 3),
    "T3D2": ("line", 2),
    "T3D3": ("line3", 3),
} | {
    f"{family}{count}": (name, count)
    for family in ("CPS", "CPE", "CAX", "M3D")
    for name, count in (("triangle", 3), ("quad", 4), ("triangle6", 6), ("quad8", 8))
}


class Read(NamedTuple):
    """Node numbers, coordinates, node sets, and the nodes and numbers of elements by kind, element sets."""

    labels: Integers
    points: Array
    sets: dict[str, Integers]
    cells: dict[str, Integers]
    numbers: dict[str, Integers]
    element_sets: dict[str, Integers]


def read_deck(path: Path) -> Read:
    """Return what a deck holds.

    Raises
    ------
    UserError
        If a block cannot be read; its line is named.
    """
    labels: list[Integers] = []
    points: list[Array] = []
    sets: dict[str, list[Integers]] = {}
    cells: dict[str, list[Integers]] = {}
    members: dict[str, list[Integers]] = {}
    own: dict[str, list[Integers]] = {}
    element_sets: dict[str, list[Integers]] = {}
    for keyword, options, data, line in blocks(path):
        if keyword == "NODE" and data:
            table = _padded(data, path.name, line)
            labels.append(whole(table[:, 0], path.name))
            points.append(table[:, 1:4])
            if "NSET" in options:
                sets.setdefault(options["NSET"], []).append(labels[-1])
        elif keyword == "ELEMENT":
            name, count = _kind(options.get("TYPE", ""))
            if count:
                read = _elements(data, count, path.name, line)
                own.setdefault(name, []).append(read[:, 0])
                cells.setdefault(name, []).append(read[:, 1:])
                members.setdefault(options.get("ELSET", ""), []).append(np.unique(read[:, 1:]))
                element_sets.setdefault(options.get("ELSET", ""), []).append(read[:, 0])
        elif keyword == "ELSET":  # of elements that are not read, too: they are left out
            names = [word for word in data.replace(b",", b" ").split() if not word.isdigit()]
            if "GENERATE" in options or all(name.decode().upper() in element_sets for name in names):
                found = _set(data, options, element_sets, (path.name, line))
                element_sets.setdefault(options.get("ELSET", ""), []).append(found)
        elif keyword == "NSET":
            found = _set(data, options, sets, (path.name, line))
            sets.setdefault(options.get("NSET", ""), []).append(found)
    if not labels:
        raise UserError(f"{path.name} has no nodes: no *NODE block with coordinates was found")
    for name, parts in members.items():  # an element set names its nodes too, unless a node set has the name
        if name and name not in sets:
            sets[name] = parts
    return Read(
        np.concatenate(labels),
        np.concatenate(points),
        {name: _unique(np.concatenate(parts)) for name, parts in sets.items()},
        *({name: np.concatenate(parts) for name, parts in one.items()} for one in (cells, own, element_sets)),
    )


def blocks(path: Path) -> list[Block]:
    """Return the keyword blocks of a deck, includes in place.

    Raises
    ------
    UserError
        If a file cannot be read or is cut off.
    """
    found: list[Block] = []
    keyword, options, data, first = "", dict[str, str](), list[bytes](), 0
    for number, line in enumerate(read_bytes(path).split(b"\n"), 1):
        text = line.strip()
        if not text or text.startswith(b"**"):
            continue
        if not text.startswith(b"*"):
            data.append(text)
            continue
        found.append((keyword, options, b"\n".join(data), first))
        words = [word.strip() for word in text[1:].decode(errors="replace").split(",")]
        pairs = [word.partition("=") for word in words[1:]]
        options = {key.strip().upper(): value.strip().strip('"') for key, _, value in pairs}
        options |= {key: value.upper() for key, value in options.items() if key != "INPUT"}
        keyword, data, first = words[0].upper(), [], number + 1
        if keyword == "INCLUDE" and options.get("INPUT"):
            found += blocks(path.parent / options["INPUT"])
    if text and not text.startswith(b"*"):  # a number that is cut off may still read as one
        raise UserError(
            f"{path.name}, line {number} has no end: the file is cut off, or its last line needs an end"
        )
    return [*found, (keyword, options, b"\n".join(data), first)]


def _kind(name: str) -> tuple[str, int]:
    """Return meshio's name and the number of nodes of an element; 0 for one without known facets."""
    for stem in sorted(KINDS, key=len, reverse=True):
        if name.startswith(stem) and not name[len(stem) : len(stem) + 1].isdigit():
            return KINDS[stem]
    return "", 0


def _padded(data: bytes, source: str, line: int) -> Array:
    """Return number and three coordinates of each node; those that are left out are 0."""
    rows = data.split(b"\n")
    if len(data.replace(b",", b" ").split()) != 4 * len(rows):
        rows = [row if len(row.replace(b",", b" ").split()) == 4 else _filled(row) for row in rows]
    return numbers(b"\n".join(rows), source, 4, line)


def _filled(row: bytes) -> bytes:
    fields = [field.strip() or b"0" for field in row.strip(b", ").split(b",")]
    return b",".join(fields + [b"0"] * (4 - len(fields)))


def _elements(data: bytes, count: int, source: str, line: int) -> Integers:
    """Return numbers and nodes of elements, one a row.

    An element may go over several lines, and more may stand on the last of them, as beams have the node of
    their direction there: CalculiX passes it over.
    """
    try:
        words = np.array(data.replace(b",", b" ").split(), dtype=np.bytes_).astype(np.int64)
        first = len(data.partition(b"\n")[0].replace(b",", b" ").split())
        if first <= count + 1 and not len(words) % (count + 1):
            return words.reshape(-1, count + 1)
        rows, have = [], list[int]()
        for row in data.split(b"\n"):
            have += map(int, row.replace(b",", b" ").split())
            if len(have) > count:
                rows.append(have[: count + 1])
                have = []
        if have:
            raise ValueError(f"element {have[0]} has {len(have) - 1}")
        return np.array(rows, dtype=np.int64)
    except ValueError as error:
        raise UserError(
            f"{source}, line {line}: elements of {count} nodes expected ({error}); the file may be cut off"
        ) from error


def _set(
    data: bytes, options: dict[str, str], sets: dict[str, list[Integers]], place: tuple[str, int]
) -> Integers:
    """Return the numbers of a node set given by numbers, ranges (GENERATE) and names of earlier sets."""
    if "GENERATE" in options:
        ranges = [[int(word) for word in row.split(b",") if word.strip()] for row in data.split(b"\n")]
        spans = [range(row[0], row[1] + 1, *row[2:3]) for row in ranges]
        if max((max(abs(one.start), abs(one.stop)) for one in spans), default=0) > MOST_NODES:
            raise UserError(f"{place[0]}, line {place[1]}: node numbers go up to {MOST_NODES}")
        return np.concatenate([np.arange(span.start, span.stop, span.step) for span in spans])
    words = data.replace(b",", b" ").split()
    names = [word.decode().upper() for word in words if not word.isdigit()]
    unknown = [name for name in names if name not in sets]
    if unknown:
        raise UserError(f"{place[0]}, line {place[1]}: the node set {unknown[0]!r} is not defined before")
    plain = np.array([int(word) for word in words if word.isdigit()], dtype=np.int64)
    return np.concatenate([plain, *(part for name in names for part in sets[name])])


def _unique(values: Integers) -> Integers:
    """Return the values without repetitions, in the order of their first appearance."""
    _, first = np.unique(values, return_index=True)
    return values[np.sort(first)]
