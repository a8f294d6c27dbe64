"""Glass catalogues in AGF files, as makers of glass offer them for lens designers.

A glass is a line ``NM name formula code nd vd``, followed by ``CD`` (coefficients) ``TD`` (how it
follows temperature: D0, D1, D2, E0, E1, l_tk, and the temperature of the coefficients) and ``LD`` (the
shortest and longest wavelength, um); other lines hold prices, transmission and the like.
"""

from collections.abc import Mapping
from pathlib import Path

from wavequake.errors import UserError
from wavequake.optics.media.dispersion import AGF_FORMULAS
from wavequake.optics.media.environment import STANDARD_C, Thermal
from wavequake.optics.media.glasses import Medium
from wavequake.optics.text_file import read_text

_OF_A_ROD = 6
_MOST_OF_A_ROD = 1e3
EXPORTED = "CC glasses of an exported lens file"
"""The line that a catalogue written here begins with."""


def read_agf(path: str | Path) -> dict[str, Medium]:
    """Return the glasses of an .agf file (UTF-16, UTF-8 or Latin-1) by their names in upper case.

    A file .dat holds the materials of rods instead, as `parse_rods` takes them.

    Raises
    ------
    UserError
        If the file cannot be read, holds no glass, or a number or formula of a glass makes no sense; the
        message names file and line.
    """
    parse = parse_rods if Path(path).suffix.lower() == ".dat" else parse_agf
    return parse(read_text(path, "glass catalogue"), str(path))


def parse_agf(text: str, where: str) -> dict[str, Medium]:
    """Return the glasses that the text of an .agf file holds; `where` names it in messages."""
    found: dict[str, Medium] = {}
    catalogue = Path(where).stem.upper()
    name, formula, count = "", "", 0
    coefficients: tuple[float, ...] = ()
    thermal: Thermal | None = None
    for number, line in enumerate(text.splitlines(), start=1):
        keyword, *words = line.split() or [""]
        place = f"{where}, line {number} ({keyword})"
        if keyword == "NM":
            if len(words) < 2:
                raise UserError(f"{place}: a glass needs a name and the number of its formula.")
            name, coefficients, thermal = words[0], (), None
            kind = _number(words[1], place)
            if kind not in AGF_FORMULAS:
                raise UserError(
                    f"{place}: the dispersion of {name} has formula {kind:g}; formulas 1 to "
                    f"{max(AGF_FORMULAS)} are known."
                )
            formula, count = AGF_FORMULAS[int(kind)]
        elif keyword == "CD" and name:
            numbers = [_number(word, place) for word in words]
            if any(numbers[count:]):
                raise UserError(f"{place}: the formula of {name} takes {count} coefficients.")
            coefficients = tuple((numbers + [0.0] * count)[:count])
        elif keyword == "TD" and name:
            numbers = [*(_number(word, place) for word in words[:7]), *[0.0] * 7][:7]
            if any(numbers[:5]):  # without, nothing is known
                thermal = Thermal(tuple(numbers[:6]), numbers[6] if len(words) > 6 else STANDARD_C)
        elif keyword == "LD" and name and coefficients:
            if len(words) < 2:
                raise UserError(f"{place}: the range of {name} needs two wavelengths.")
            low, high = (1e3 * _number(word, place) for word in words[:2])
            found[name.upper()] = Medium(name, formula, coefficients, (low, high), catalogue, thermal)
    if not found:
        raise UserError(
            f"{where} holds no glass; each needs lines NM (name, formula), CD (coefficients), LD (range)."
        )
    return found


def parse_rods(text: str, where: str) -> dict[str, Medium]:
    """Return the materials of rods that GRADIENT_9.DAT holds: six lines each, name, B, C, K0, K1 and K2."""
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]
    found: dict[str, Medium] = {}
    for start in range(0, len(lines), _OF_A_ROD):
        (number, name), *rest = lines[start : start + _OF_A_ROD]
        if len(rest) < _OF_A_ROD - 1:
            raise UserError(
                f"{where}, line {number}: the rod {name[:20]} needs five lines of numbers below its name, B, "
                "C, K0, K1 and K2."
            )
        if name.upper() in found:
            raise UserError(
                f"{where}, line {number}: there is a rod {name[:20]} before; rods need names of their own."
            )
        numbers = tuple(_number(word, f"{where}, line {place}") for place, word in rest)
        for (place, word), value in zip(rest, numbers, strict=True):
            if abs(value) > _MOST_OF_A_ROD:
                raise UserError(
                    f"{where}, line {place}: {word!r} is no number of a rod; {_MOST_OF_A_ROD:g} is the most."
                )
        found[name.upper()] = Medium(name, "selfoc", numbers, catalogue=Path(where).stem.upper())
    if not found:
        raise UserError(f"{where} holds no material; each needs six lines: name, B, C, K0, K1 and K2.")
    return found


def has_formula(medium: Medium) -> bool:
    """Return whether a catalogue can hold the dispersion of a medium."""
    return (medium.formula, len(medium.coefficients)) in AGF_FORMULAS.values()


def agf_text(glasses: Mapping[str, Medium]) -> str:
    """Return the text of a catalogue of glasses by the names that they are to have there, without blanks.

    What is not known of them (density, price, transmission) is left out.
    """
    lines = [EXPORTED]
    for name, medium in glasses.items():
        kinds = [
            number
            for number, kind in AGF_FORMULAS.items()
            if kind == (medium.formula, len(medium.coefficients))
        ]
        low, high = (value * 1e-3 for value in medium.range_nm)
        lines += [
            f"NM {name} {kinds[0]} 0 1.5 50 0 0 0",
            "CD " + " ".join(repr(value) for value in medium.coefficients),
        ]
        if medium.thermal is not None:
            numbers = (*medium.thermal.coefficients, medium.thermal.at_c)
            lines.append("TD " + " ".join(repr(value) for value in numbers))
        lines.append(f"LD {max(low, 1e-3)!r} {min(high, 1e3)!r}")
    return "\n".join(lines) + "\n"


def _number(word: str, place: str) -> float:
    try:
        value = float(word)
    except ValueError:
        raise UserError(f"{place}: {word!r} is not a number.") from None
    if not abs(value) < 1e300:
        raise UserError(f"{place}: {word!r} is not a finite number.")
    return value
