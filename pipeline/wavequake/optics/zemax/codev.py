"""CODE V's sequence files (.seq) as the rows of a lens file.

Each command becomes the line of a .zmx file that says the same, with the number of its own line, so that all
that follows (glasses, fields, beams, problems) is that of `wavequake.optics.zemax.read`. Decenters and tilts
become coordinate breaks (`wavequake.optics.zemax.codev_tilts`), zoom positions are put in place before
(`wavequake.optics.zemax.codev_zooms`).
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from wavequake.errors import UserError
from wavequake.optics.media.glasses import Medium, catalogue, catalogues
from wavequake.optics.systems.system import OpticalSystem
from wavequake.optics.text_file import read_text
from wavequake.optics.zemax.codev_gratings import COMMANDS, Grating, with_grating
from wavequake.optics.zemax.codev_tilts import TILTS, Tilt, with_breaks
from wavequake.optics.zemax.codev_zooms import at_position
from wavequake.optics.zemax.lens_file import LensFile
from wavequake.optics.zemax.phases import MAX_EVEN_TERMS
from wavequake.optics.zemax.read import system_of
from wavequake.optics.zemax.rows import Line, Row, as_number, fail

_UNITS = {"M": "MM", "C": "CM", "I": "IN"}
_FAR = 1e9  # thicknesses from which an object is at infinity
_FIELDS = {"AN": "0", "OB": "1", "IM": "2", "RI": "3"}
_POWERS = "ABCDEFGHJ"  # of r^4, r^6, ...
_MOVES_LIGHT = frozenset(
    (
        *("RET", "GLB", "XOD", "YOD", "ZOD"),
        *("HOE", "SPS", "XTO", "YTO", "CYL", "AAS", "THI", "CUY", "RDY", "GLA", "DEL", "INS"),
        *("ELX", "ELY"),
    )
)
_SOLVED = ("CUY", "RDY", "THI")  # of which a solve may say the value
# Height, slope or angle of incidence of the marginal or chief ray; SO, SI, ... there are other surfaces.
_SOLVE = re.compile("[HUI][MC][XY]")
_HARMLESS = frozenset(
    (
        *(
            "LEN",
            "WTW",
            "WTF",
            "INI",
            "CCY",
            "THC",
            "GLC",
            "KC",
            "PUI",
            "PUX",
            "PUY",
            "AC",
            "BC",
            "CC",
            "DC",
            "SLB",
            "GO",
        ),
        *("BUF", "UID", "TEM", "DER", "PIM", "CUF", "THF", "CON", "ASP", "SPH", "IN", "OUT", "CUM", "NUM"),
        *("THM", "CLS", "PIK"),
    )
)
_MODEL = re.compile(r"^(\d{3,6})\.(\d{3,6})$")  # 517.642
_PAIR = re.compile(r"^(\d\.\d+):(\d+\.?\d*)$")  # 1.517:64.2


@dataclass
class _Draft:
    """What has been read so far; ``radii`` tells whether surfaces are given by radii or curvatures."""

    where: str
    header: dict[str, list[Line]] = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)
    radii: bool | None = None
    vignetting: dict[str, list[float]] = field(default_factory=dict)
    names: set[str] = field(default_factory=set)
    tilts: dict[int, Tilt] = field(default_factory=dict)
    rectangles: dict[int, dict[str, Line]] = field(default_factory=dict)
    gratings: dict[int, Grating] = field(default_factory=dict)

    def say(self, number: int, keyword: str, rest: str) -> None:
        self.header.setdefault(keyword, []).append(Line(self.where, number, keyword, rest))

    def add(self, number: int, keyword: str, rest: str) -> None:
        self.rows[-1].lines.setdefault(keyword, []).append(Line(self.where, number, keyword, rest))


def read_seq(
    path: str | Path, glasses: Mapping[str, Medium] | None = None, configuration: int | None = None
) -> OpticalSystem:
    """Read a system from CODE V's .seq file; as `wavequake.optics.zemax.read.read_zmx`.

    ``configuration`` is a zoom position, from 1.

    Raises
    ------
    UserError
        If the file cannot be read, or holds something that is not supported: names the line.
    """
    return system_of(sequence_file(read_text(path), str(path), configuration), glasses, configuration)


def sequence_file(text: str, where: str, position: int | None = None) -> LensFile:
    """Return the rows that the text of a .seq file describes at a zoom position.

    `where` names it in messages.
    """
    draft = _Draft(where)
    zoomed = at_position(list(_commands(text, where)), position)
    private = False
    for line in zoomed.commands:
        private = (private or line.keyword == "PRV") and line.keyword != "END"
        if not private and line.keyword not in ("PRV", "END"):
            _take(draft, line)
    if len(draft.rows) < 2:
        raise UserError(f"{where} is no sequence of surfaces: it needs SO, S and SI at least.")
    _complete(draft)
    behind = [Line(where, 0, "MNUM", f"{zoomed.count} {position or 1}")] if zoomed.count > 1 else []
    return LensFile(where, draft.header, with_breaks(draft.rows, draft.tilts), tuple(behind))


def _commands(text: str, where: str) -> Iterator[Line]:
    """Yield the commands, parted by semicolons, of lines that an ampersand continues."""
    held, begun = "", 0
    for number, raw in enumerate(text.splitlines(), start=1):
        line = _plain(raw)
        begun = begun if held else number
        if line.rstrip().endswith("&"):
            held += line.rstrip()[:-1] + " "
            continue
        for part in _parts(held + line):
            keyword, _, rest = part.partition(" ")
            yield Line(where, begun, keyword.upper(), rest.strip())
        held = ""


def _plain(raw: str) -> str:
    """Return a line without its comment."""
    quoted = ""
    for index, letter in enumerate(raw):
        if quoted:
            quoted = "" if letter == quoted else quoted
        elif letter in "'\"":
            quoted = letter
        elif letter == "!":
            return raw[:index]
    return raw


def _parts(line: str) -> list[str]:
    parts = re.findall(r"(?:'[^']*'|\"[^\"]*\"|[^;])+", line)
    return [part.strip() for part in parts if part.strip()]


def _take(draft: _Draft, line: Line) -> None:
    keyword, number = line.keyword, line.number
    if keyword in ("SO", "S0", "S", "SI") or re.fullmatch(r"S\d+", keyword):
        _surface(draft, line)
    elif keyword == "RDM":
        draft.radii = not line.rest.upper().startswith("N")
    elif keyword in ("TIT", "TITLE"):
        draft.say(number, "NAME", line.rest.strip("'\" "))
    elif keyword == "DIM":
        letter = line.rest[:1].upper()
        if letter not in _UNITS:
            fail(line, f"the unit {line.rest!r} is not known; M, C and I are")
        draft.say(number, "UNIT", _UNITS[letter])
    elif keyword == "EPD":
        draft.say(number, "ENPD", line.rest)
    elif keyword == "FNO":
        draft.say(number, "FNUM", f"{as_number(line, 0)!r} 1")
    elif keyword == "NA":
        draft.say(number, "FNUM", f"{0.5 / as_number(line, 0)!r} 1")
    elif keyword == "NAO":
        draft.say(number, "OBNA", f"{as_number(line, 0)!r} 0")
    elif keyword == "WL":
        microns = (repr(as_number(line, k) / 1000.0) for k in range(len(line.words)))
        draft.say(number, "WAVL", " ".join(microns))
    elif keyword == "REF":
        draft.say(number, "PWAV", line.rest)
    elif keyword[:1] in "XY" and keyword[1:] in _FIELDS:
        draft.say(number, f"{keyword[0]}FLN", line.rest)
        draft.names.add(keyword[1:])
    elif keyword in ("VUX", "VLX", "VUY", "VLY"):
        draft.vignetting[keyword] = [as_number(line, k) for k in range(len(line.words))]
    elif keyword == "PUI" and as_number(line, 0) != 1.0:
        fail(line, "the apodization of the pupil (PUI) is not supported; choose a uniform one")
    elif draft.rows and _of_surface(draft, line):
        return
    elif keyword in _SOLVED and draft.rows and _is_solve(line):
        return  # the number that it gave stands in the surface
    elif keyword in _MOVES_LIGHT:
        fail(line, f"{keyword} changes the light and is not supported")
    elif keyword not in _HARMLESS and not keyword.startswith(("^", "'", '"')):
        draft.header.setdefault(keyword, []).append(line)


def _is_solve(line: Line) -> bool:
    """Tell whether a command names a solve of the surface before it, such as ``THI HMY 0.0``."""
    return _SOLVE.fullmatch((line.words or [""])[0].upper()) is not None


def _of_surface(draft: _Draft, line: Line) -> bool:
    """Take a command that belongs to the surface before it; tell whether it is one."""
    keyword, number = line.keyword, line.number
    if keyword in ("STO", "STOP"):
        if line.rest:
            fail(line, "the stop of another surface is not supported; write STO behind the surface itself")
        draft.add(number, "STOP", "")
    elif keyword == "K":
        draft.add(number, "CONI", line.rest)
    elif keyword in tuple(_POWERS):
        if not as_number(line, 0):
            return True
        draft.rows[-1].lines["TYPE"] = [Line(line.where, number, "TYPE", "EVENASPH")]
        draft.add(number, "PARM", f"{_POWERS.index(keyword) + 2} {as_number(line, 0)!r}")
    elif keyword == "CIR":
        words = line.words
        if words[:1] == ["OBS"]:
            draft.add(number, "OBSC", f"0 {words[-1]}")
        elif words and words[0] not in ("EDG", "HOL"):
            draft.add(number, "CLAP", f"0 {words[-1]}")
    elif keyword in TILTS:
        draft.tilts.setdefault(len(draft.rows) - 1, Tilt()).take(line)
    elif keyword in COMMANDS:
        draft.gratings.setdefault(len(draft.rows) - 1, Grating(line)).take(line)
    elif keyword in ("REX", "REY", "ADX", "ADY"):
        draft.rectangles.setdefault(len(draft.rows) - 1, {})[keyword] = line
    else:
        return False
    return True


def _surface(draft: _Draft, line: Line) -> None:
    number, words = line.number, line.words
    draft.rows.append(Row(len(draft.rows), line, {}))
    if not words:
        return
    value = as_number(line, 0)
    if draft.radii is None and abs(value) >= 1.0:
        fail(line, "the file does not say whether it gives radii (RDM Y) or curvatures (RDM N); write which")
    curvature = (1.0 / value if value else 0.0) if draft.radii else value
    draft.add(number, "CURV", repr(curvature))
    endless = len(words) > 1 and words[1].lower() in ("inf", "infinity")
    thickness = as_number(line, 1) if len(words) > 1 and not endless else 0.0
    far = endless or (len(draft.rows) == 1 and abs(thickness) > _FAR)
    draft.add(number, "DISZ", "INFINITY" if far else repr(thickness))
    if len(words) > 2:
        draft.add(number, "GLAS", _glass(words[2].strip("'\"")))


def _glass(word: str) -> str:
    """Return how a .zmx file names a glass: NBK7_SCHOTT is N-BK7 of Schott, 517.642 a model glass."""
    if word.upper() in ("REFL", "AIR"):
        return {"REFL": "MIRROR", "AIR": "AIR"}[word.upper()]
    pair = _PAIR.match(word)
    if pair:
        return f"___BLANK 1 0 {pair[1]} {pair[2]} 0"
    model = _MODEL.match(word)
    if model:
        index, abbe = (float(f"0.{digits}") for digits in model.groups())
        return f"___BLANK 1 0 {1.0 + index!r} {100.0 * abbe!r} 0"
    name, _, maker = word.upper().partition("_")
    shelf = catalogue(maker, catalogues()) if maker else None
    if shelf is None:
        return name if not maker else word
    known = {key.replace("-", ""): medium.name for key, medium in shelf.items()}
    return f"{maker}:{known.get(name.replace('-', ''), name)}"


def _long_asphere(row: Row) -> Row:
    """Return a row whose even asphere goes beyond r^16 as one of the type that does."""
    powers = row.table("PARM")
    if row.type != "EVENASPH" or max(powers) <= MAX_EVEN_TERMS:
        return row
    at = row.lines["PARM"][0]
    values = [max(powers), 1.0, *(powers.get(k, 0.0) for k in range(1, max(powers) + 1))]
    extra = [Line(at.where, at.number, "XDAT", f"{k} {value!r}") for k, value in enumerate(values, start=1)]
    kept = {key: lines for key, lines in row.lines.items() if key != "PARM"}
    kind = Line(at.where, at.number, "TYPE", "XASPHERE")
    return replace(row, lines={**kept, "TYPE": [kind], "XDAT": extra})


def _complete(draft: _Draft) -> None:
    """Add what follows from several commands: apertures, fields, vignetting, the primary wavelength."""
    for number, given in draft.rectangles.items():
        row, numbers = draft.rows[number], {key: as_number(line, 0) for key, line in given.items()}
        line = next(iter(given.values()))
        if ("REX" in given) != ("REY" in given):
            fail(line, f"{row.label} has a rectangular aperture without both half widths, REX and REY")
        if "REX" in given:
            text = f"{numbers['REX']!r} {numbers['REY']!r}"
            row.lines.setdefault("SQAP", []).append(Line(line.where, line.number, "SQAP", text))
        text = f"{numbers.get('ADX', 0.0)!r} {numbers.get('ADY', 0.0)!r}"
        row.lines["OBDC"] = [Line(line.where, line.number, "OBDC", text)]
    unit = draft.header["UNIT"][-1].rest if "UNIT" in draft.header else "MM"
    for number, grating in draft.gratings.items():
        draft.rows[number] = with_grating(draft.rows[number], grating, unit)
    draft.rows = [_long_asphere(row) for row in draft.rows]
    if not any("STOP" in row.lines for row in draft.rows):  # by default the first surface is the stop
        draft.rows[1].lines["STOP"] = [Line(draft.where, draft.rows[1].line.number, "STOP", "")]
    if len(draft.names) > 1:
        raise UserError(f"{draft.where} gives fields in several ways: {', '.join(sorted(draft.names))}.")
    kind = _FIELDS[next(iter(draft.names), "AN")]
    lines = [line for key in ("XFLN", "YFLN") for line in draft.header.get(key, [])]
    count = max((len(line.words) for line in lines), default=1)
    waves = draft.header.get("WAVL")
    if not waves:
        raise UserError(f"{draft.where} gives no wavelength (WL).")
    draft.say(waves[0].number, "FTYP", f"{kind} 0 {count} {len(waves[0].words)} 0 0 0")
    if "PWAV" not in draft.header:
        draft.say(waves[0].number, "PWAV", str((len(waves[0].words) + 1) // 2))
    for axis in "XY":
        upper, lower = (draft.vignetting.get(f"V{side}{axis}", []) for side in "UL")
        pairs = [
            ((upper + [0.0] * count)[k], (lower + [0.0] * count)[k]) for k in range(count)
        ]  # shares of the half pupil that are cut
        draft.say(0, f"VD{axis}N", " ".join(repr((low - up) / 2.0) for up, low in pairs))
        draft.say(0, f"VC{axis}N", " ".join(repr((up + low) / 2.0) for up, low in pairs))
