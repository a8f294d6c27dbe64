"""Bulk data of Nastran (``.bdf``, ``.pch``): cards in fields of 8 or 16 characters or parted by commas.

A line that begins with blanks, ``+`` or ``*`` continues the card before it (MSC Nastran Quick Reference
Guide, Format of Bulk Data Entries).
"""

from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Array, Integers, read_bytes

_FIELDS = 8  # of a line behind the name of its card
_MOST_REPEATED = 1_000_000
# meshio's names of elements, by how many nodes a card has; Nastran lists the middles of upright edges before
# those of the top, VTK after them.
_PRISM = [*range(9), 12, 13, 14, 9, 10, 11]
_BRICK = [*range(12), 16, 17, 18, 19, 12, 13, 14, 15]
_SOLIDS: dict[str, dict[int, tuple[str, list[int]]]] = {
    "CTETRA": {4: ("tetra", [*range(4)]), 10: ("tetra10", [*range(10)])},
    "CPENTA": {6: ("wedge", [*range(6)]), 15: ("wedge15", _PRISM)},
    "CHEXA": {8: ("hexahedron", [*range(8)]), 20: ("hexahedron20", _BRICK)},
    "CTRIA3": {3: ("triangle", [*range(3)])},
    "CTRIAR": {3: ("triangle", [*range(3)])},
    "CTRIA6": {3: ("triangle", [*range(3)]), 6: ("triangle6", [*range(6)])},
    "CQUAD4": {4: ("quad", [*range(4)])},
    "CQUADR": {4: ("quad", [*range(4)])},
    "CQUAD8": {4: ("quad", [*range(4)]), 8: ("quad8", [*range(8)])},
}


class Card(NamedTuple):
    """Name, fields behind it, and the line where it begins."""

    name: str
    fields: list[str]
    line: int


class Deck(NamedTuple):
    """Nodes and elements of a deck.

    ``turned`` are the numbers of nodes whose displacements stand in axes of their own, ``turns`` (k, 3, 3)
    these axes as columns, NaN where the deck lacks them; ``numbers`` are those of the elements of each kind;
    sets of elements are those of a property, by its number.
    """

    labels: Integers
    points: Array
    cells: dict[str, Integers]
    turned: Integers
    numbers: dict[str, Integers]
    element_sets: dict[str, Integers]
    turns: Array


def cards(path: Path) -> Iterator[Card]:
    """Yield the cards of a file, continuations joined, those of included files in place.

    Raises
    ------
    UserError
        If a file cannot be read or includes itself.
    """
    yield from _cards(path, (path,))


def _cards(path: Path, opened: tuple[Path, ...]) -> Iterator[Card]:
    text = read_bytes(path).decode("latin-1")
    lines = text.splitlines()
    begin = next((k for k, line in enumerate(lines) if line.strip().upper().startswith("BEGIN")), -1)
    held: Card | None = None
    steps: list[str] = []  # from one repeated card to the next
    for number, raw in enumerate(lines[begin + 1 :], start=begin + 2):
        line = raw.partition("$")[0].rstrip()
        if not line.strip():
            continue
        if line.lstrip().upper().startswith("ENDDATA"):
            break
        if line.lstrip().upper().startswith("INCLUDE"):
            if held is not None:
                yield held
                held = None
            other = path.parent / line.strip()[7:].strip(" '\"")
            if other in opened or len(opened) > 100:
                raise UserError(f"{path.name}, line {number}: {other.name} includes itself")
            yield from _cards(other, (*opened, other))
            continue
        name, fields = _split(line.upper())
        if name.startswith("="):
            if held is None:
                raise UserError(f"{path.name}, line {number}: there is no card before it that {name} repeats")
            for _ in range(_count(name, f"{path.name}, line {number}")):
                steps = fields if name == "=" else steps
                yield held
                held = Card(held.name, _repeated(held.fields, steps, f"{path.name}, line {number}"), number)
            continue
        if name and name[0] not in "+*":
            if held is not None:
                yield held
            held = Card(name, fields, number)
            steps = []
        elif held is not None:
            held.fields.extend(fields)
    else:  # there is no ENDDATA, and a number that is cut off may still read as one
        if not text.endswith(("\n", "\r")):
            raise UserError(
                f"{path.name}, line {len(lines)} has no end, and ENDDATA is missing: the file is cut off, or "
                "its last line needs an end"
            )
    if held is not None:
        yield held


def _split(line: str) -> tuple[str, list[str]]:
    """Return the name of a card, without the star of long fields, and the fields of a line."""
    if "," in line:
        name, *fields = (part.strip() for part in line.split(","))
        count = _FIELDS // 2 if name.endswith("*") or name.startswith("*") else _FIELDS
        fields = fields[:count] + [""] * (count - len(fields))
        return name if name.startswith("*") else name.strip("* "), fields
    line = line.expandtabs(8)
    width = 16 if "*" in line[:8] else 8
    fields = [line[k : k + width].strip() for k in range(8, 72, width)]
    name = line[:8].strip()
    return name if name.startswith("*") else name.strip("* "), fields


def _count(name: str, where: str) -> int:
    """Return how many cards ``=``, or ``=7`` or ``=(7)`` after it, stand for."""
    digits = name[1:].strip("()")
    if digits and not (digits.isdecimal() and 0 < int(digits) <= _MOST_REPEATED):
        raise UserError(f"{where}: {name!r} is not how often a card is repeated (1 to {_MOST_REPEATED})")
    return int(digits) if digits else 1


def _repeated(fields: list[str], steps: list[str], where: str) -> list[str]:
    """Return the fields of a card after those of the one before it.

    ``=`` keeps a field, ``==`` it and all that follow, ``*2`` or ``*(2)`` adds to it; others are new.
    """
    if not steps:
        raise UserError(f"{where}: no card (=) before it says what is repeated")
    found: list[str] = []
    for old, step in zip_longest(fields, steps, fillvalue=""):
        if step == "==":
            return found + fields[len(found) :]
        more = step[1:].strip("()") if step.startswith("*") else ""
        if more and old.lstrip("-").isdecimal() and more.lstrip("-").isdecimal():
            found.append(str(int(old) + int(more)))
        elif more:
            found.append(repr(real(old, where) + real(more, where)))
        else:
            found.append(old if step == "=" else step)
    return found


def real(word: str, where: str) -> float:
    """Return a number as Nastran writes it: ``1.5+3`` is 1500.

    Raises
    ------
    UserError
        If it is none; `where` says whose.
    """
    text = word.upper().replace("D", "E")
    if "E" not in text:
        head, sign = text[:1], max(text[1:].rfind("+"), text[1:].rfind("-"))
        text = head + (text[1:] if sign < 0 else f"{text[1:][:sign]}E{text[1:][sign:]}")
    try:
        return float(text)
    except ValueError as error:
        raise UserError(f"{where}: {word!r} is not a number; the file may be cut off") from error


def _whole(word: str, where: str) -> int:
    if not (word.isdecimal() and len(word) < 19):
        raise UserError(f"{where}: {word!r} is not the number of a node; the file may be cut off")
    return int(word)


def read_bulk(path: Path) -> Deck:
    """Return nodes, in basic axes, and solid and shell elements of a deck.

    Elements without all nodes in the middle of their edges count as linear ones.

    Raises
    ------
    UserError
        If it has no nodes, a card cannot be read, or a node stands in axes that are not known.
    """
    labels, places, frames, turned = [], [], [], {}
    axes: dict[str, Card] = {}
    cells: dict[str, list[list[int]]] = {}
    own: dict[str, list[int]] = {}
    properties: dict[str, list[int]] = {}
    standard = Card("GRDSET", [""] * _FIELDS, 0)
    grids, elements = [], []
    for short in cards(path):
        card = short._replace(fields=short.fields + [""] * _FIELDS)
        if card.name == "GRID":
            grids.append(card)
        elif card.name == "GRDSET":
            standard = card
        elif card.name in _SOLIDS:
            elements.append(card)
        elif card.name in ("CORD2R", "CORD2C", "CORD2S"):
            axes[card.fields[0]] = card
    for card in grids:
        where = f"{path.name}, line {card.line}"
        labels.append(_whole(card.fields[0], where))
        places.append([real(word, where) if word else 0.0 for word in card.fields[2:5]])
        frames.append(card.fields[1] or standard.fields[1] or "0")
        if (own_axes := card.fields[5] or standard.fields[5] or "0") not in ("0", "-1"):
            turned[len(labels) - 1] = own_axes
    if not grids:
        raise UserError(f"{path.name} has no nodes: no GRID card was found")
    points = np.array(places)
    for frame in sorted(set(frames) - {"0"}):
        mine = np.array([one == frame for one in frames])
        points[mine] = basic(points[mine], frame, axes, path.name)
    rows = np.array(list(turned), dtype=np.int64)
    turns = np.full((len(rows), 3, 3), np.nan)
    for frame in sorted(set(turned.values()) & set(axes)):
        mine = np.array([one == frame for one in turned.values()])
        turns[mine] = axes_at(points[rows[mine]], frame, axes, path.name)
    for card in elements:
        where = f"{path.name}, line {card.line}"
        kind, order = _shape(card, where)
        nodes = [_whole(card.fields[2 + place], where) for place in order]
        cells.setdefault(kind, []).append(nodes)
        own.setdefault(kind, []).append(_whole(card.fields[0], where))
        number = card.fields[1] or card.fields[0]
        properties.setdefault(number.lstrip("0") if number.isdecimal() else number, []).append(own[kind][-1])
    return Deck(
        np.array(labels, dtype=np.int64),
        points,
        {kind: np.array(nodes, dtype=np.int64) for kind, nodes in cells.items()},
        np.array(labels, dtype=np.int64)[rows],
        _whole_arrays(own),
        _whole_arrays(properties),
        turns,
    )


def _whole_arrays(given: dict[str, list[int]]) -> dict[str, Integers]:
    return {name: np.array(one, dtype=np.int64) for name, one in given.items()}


def _shape(card: Card, where: str) -> tuple[str, list[int]]:
    """Return the kind of an element, and where its nodes stand among those of the card."""
    given = card.fields[2:]
    for count in sorted(_SOLIDS[card.name], reverse=True):
        words = given[:count]
        if len(words) == count and all(word not in ("", "0") for word in words):
            return _SOLIDS[card.name][count]
    raise UserError(f"{where}: {card.name} has fewer nodes than corners; the file may be cut off")


def basic(points: Array, frame: str, axes: dict[str, Card], source: str, depth: int = 0) -> Array:
    """Return coordinates (p, 3) of a frame in basic axes.

    Raises
    ------
    UserError
        If the frame, or one in which it stands, is none of `axes`, or its three points lie on a line.
    """
    if frame in ("", "0"):
        return points
    card, origin, turn = _frame(frame, axes, source, depth)
    return np.asarray(origin + _rectangular(points, card.name) @ turn.T)


def axes_at(points: Array, frame: str, axes: dict[str, Card], source: str) -> Array:
    """Return the unit vectors (p, 3, 3), as columns, of a frame at points in basic axes; raises as `basic`.

    Those of cylindrical and spherical frames turn from point to point. On their axis x stands for r.
    """
    card, origin, turn = _frame(frame, axes, source, 0)
    found = np.broadcast_to(turn, (len(points), 3, 3)).copy()
    if card.name == "CORD2R":
        return found
    x, y, z = ((points - origin) @ turn).T
    angle, up = np.arctan2(y, x), np.arctan2(np.hypot(x, y), z)
    one, zero = np.ones_like(x), np.zeros_like(x)
    around = np.stack([-np.sin(angle), np.cos(angle), zero], axis=-1)
    if card.name == "CORD2C":
        columns = [np.stack([np.cos(angle), np.sin(angle), zero], axis=-1), around]
        columns.append(np.stack([zero, zero, one], axis=-1))
    else:  # r, theta from z, phi around it
        out = np.stack([np.cos(angle), np.sin(angle), zero], axis=-1)
        along = np.stack([zero, zero, one], axis=-1)
        sine, cosine = np.sin(up)[:, None], np.cos(up)[:, None]
        columns = [sine * out + cosine * along, cosine * out - sine * along, around]
    turned: Array = found @ np.stack(columns, axis=-1)
    return turned


def _frame(frame: str, axes: dict[str, Card], source: str, depth: int) -> tuple[Card, Array, Array]:
    """Return the card of a frame, its origin and its unit vectors as columns, in basic axes."""
    card = axes.get(frame)
    if card is None or depth > len(axes):
        raise UserError(f"{source}: nodes stand in the axes {frame}, which no CORD2R, CORD2C or CORD2S gives")
    where = f"{source}, line {card.line}"
    corners = np.array([real(word, where) if word else 0.0 for word in card.fields[2:11]])
    if len(corners) < 9 or not (np.isfinite(corners).all() and _spans(corners.reshape(3, 3))):
        raise UserError(f"{where}: {card.name} {frame} needs three points that are not on a line")
    corners = corners.reshape(3, 3)
    origin, above, beside = basic(corners, card.fields[1], axes, source, depth + 1)
    return card, origin, unit_vectors(origin, above, beside)


def _spans(corners: Array) -> bool:
    first, second = corners[1:] - corners[0]
    return bool(np.abs(np.cross(first, second)).max() > 1e-12 * np.abs(first).max() * np.abs(second).max())


def unit_vectors(origin: Array, above: Array, beside: Array) -> Array:
    """Return the axes of a frame as columns: z from `origin` to `above`, x toward `beside`."""
    z = (above - origin) / np.linalg.norm(above - origin)
    x = (beside - origin) - (beside - origin) @ z * z
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _rectangular(points: Array, name: str) -> Array:
    """Return x, y, z of cylindrical (r, theta, z) or spherical (r, theta, phi) coordinates, angles in deg."""
    if name == "CORD2R":
        return points
    first, second, third = points.T
    if name == "CORD2C":
        angle = np.deg2rad(second)
        return np.column_stack([first * np.cos(angle), first * np.sin(angle), third])
    theta, phi = np.deg2rad(second), np.deg2rad(third)
    across = first * np.sin(theta)
    return np.column_stack([across * np.cos(phi), across * np.sin(phi), first * np.cos(theta)])
