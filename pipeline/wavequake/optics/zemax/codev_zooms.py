"""Zoom positions of CODE V's sequence files: what ``ZOO`` puts in the place of numbers of other commands.

``ZOO 3`` says how many positions there are; ``ZOO EPD a b c``, ``ZOO YAN F2 a b c`` and ``ZOO THI S5 a b c``
give a number of the lens, of a field and of a surface in each. The commands themselves have the numbers of
the first one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from wavequake.errors import UserError
from wavequake.optics.zemax.rows import Line, as_number, fail

_OF_LENS = ("EPD", "FNO", "NA", "NAO")
_OF_FIELDS = tuple(f"{axis}{kind}" for axis in "XY" for kind in ("AN", "OB", "IM", "RI"))
_VIGNETTING = ("VUX", "VLX", "VUY", "VLY")
_OF_THE_SURFACE_LINE = {"RDY": 0, "CUY": 0, "THI": 1}
_BEHIND_A_SURFACE = ("K", *"ABCDEFGHJ", "XDE", "YDE", "ZDE", "ADE", "BDE", "CDE", "CIR")
_VARIABLES = ("TIT", "CCY", "THC", "GLC", "KC", "WTF", "WTW", "TAR")
READ = (*_OF_LENS, *_OF_FIELDS, *_VIGNETTING, *_OF_THE_SURFACE_LINE, *_BEHIND_A_SURFACE)


@dataclass(frozen=True)
class Zoomed:
    """Commands at one position, and how many positions there are."""

    commands: tuple[Line, ...]
    count: int


def at_position(commands: Sequence[Line], position: int | None) -> Zoomed:
    """Return the commands of a file at a zoom position, from 1; None: the first.

    Raises
    ------
    UserError
        If there is no such position, or one changes what is not read.
    """
    zooms = [line for line in commands if line.keyword in ("ZOO", "ZOOM")]
    plain = [line for line in commands if line.keyword not in ("ZOO", "ZOOM")]
    count = next((int(line.words[0]) for line in zooms if line.words and line.words[0].isdigit()), 1)
    chosen = 1 if position is None else position
    if not 1 <= chosen <= count:
        where = commands[0].where if commands else "the file"
        raise UserError(f"{where} has {count} zoom positions; there is no number {chosen}.")
    for line in zooms:
        if line.words and not line.words[0].isdigit():
            plain = _changed(plain, line, count, chosen)
    return Zoomed(tuple(plain), count)


def _changed(commands: list[Line], line: Line, count: int, position: int) -> list[Line]:
    what, *rest = line.words
    what = what.upper()
    # Of a number's variable, as THC of THI, ADC of ADE.
    if what in _VARIABLES or (len(what) == 3 and what.endswith("C") and what[:2] + "E" in _BEHIND_A_SURFACE):
        return commands
    place = rest[0].upper() if rest and not _is_number(rest[0]) else ""
    values = rest[1:] if place else rest
    if len(values) == 1:  # the same at all positions
        values = values * count
    if len(values) != count:
        fail(line, f"{what} has {len(values)} values for {count} zoom positions")
    if what not in READ:
        if len(set(values)) == 1 and what != "STO":  # STO S1 S2 names surfaces alone
            return commands
        fail(line, f"the zoom position changes {what}, which is not supported; {', '.join(READ)} are")
    place_of = Line(line.where, line.number, what, values[position - 1])
    if what in _OF_LENS:
        return _with_rest(commands, what, 0, place_of, range(len(commands)))
    if what in (*_OF_FIELDS, *_VIGNETTING):
        return _with_rest(commands, what, _numbered(line, place, "F") - 1, place_of, range(len(commands)))
    first, last = _section(commands, line, place)
    if what in ("RDY", "CUY") and (what == "RDY") != _gives_radii(commands):
        value = as_number(place_of, 0)
        place_of = Line(line.where, line.number, what, repr(1.0 / value if value else 0.0))
    if what in _OF_THE_SURFACE_LINE:
        return _replaced(commands, first, _OF_THE_SURFACE_LINE[what], place_of)
    return _with_rest(commands, what, -1 if what == "CIR" else 0, place_of, range(first + 1, last))


def _gives_radii(commands: Sequence[Line]) -> bool:
    """Return whether lines of surfaces begin with radii, not curvatures."""
    said = [line for line in commands if line.keyword == "RDM"]
    return bool(said) and not said[-1].rest.upper().startswith("N")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _numbered(line: Line, place: str, letter: str) -> int:
    if not (place.startswith(letter) and place[1:].isdigit() and (letter == "S" or int(place[1:]))):
        fail(line, f"{place or 'nothing'} does not say which it is; {letter}1, {letter}2, ... do")
    return int(place[1:])


def _section(commands: Sequence[Line], line: Line, place: str) -> tuple[int, int]:
    """Return where a surface's own command stands, and where the next one's."""
    starts = [
        k for k, one in enumerate(commands) if one.keyword in ("SO", "S", "SI") or _is_surface(one.keyword)
    ]
    names = {"SO": 0, "SI": len(starts) - 1}
    number = names[place] if place in names else _numbered(line, place, "S")
    if not 0 <= number < len(starts):
        fail(line, f"there is no surface {number}")
    return starts[number], [*starts, len(commands)][number + 1]


def _is_surface(keyword: str) -> bool:
    return keyword[:1] == "S" and keyword[1:].isdigit()


def _with_rest(commands: list[Line], what: str, word: int, value: Line, places: range) -> list[Line]:
    """Return commands with a number of one of them changed, or with a new one where `places` end."""
    found = next((k for k in places if commands[k].keyword == what), None)
    if found is not None:
        return _replaced(commands, found, word, value)
    if word > 0:
        fail(value, f"the lens gives no {what} whose number {word + 1} could change")
    end = places.stop
    return [*commands[:end], value, *commands[end:]]


def _replaced(commands: list[Line], place: int, word: int, value: Line) -> list[Line]:
    line = commands[place]
    as_number(value, 0)
    words = line.words
    if word >= len(words):
        fail(value, f"line {line.number} has no number {word + 1} that could change")
    words[word] = value.rest
    return [
        *commands[:place],
        Line(line.where, line.number, line.keyword, " ".join(words)),
        *commands[place + 1 :],
    ]
