"""Materials that a deck gives its elements: MAT1 of Nastran, *MATERIAL of CalculiX and Abaqus.

Only what thermal expansion takes: constants of isotropic materials, in the deck's own units.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from wavequake.errors import UserError
from wavequake.mechanics.importers.bulk import Card, cards, real
from wavequake.mechanics.importers.entries import numbers
from wavequake.mechanics.importers.inp import blocks
from wavequake.mechanics.importers.mesh import BULK

_VARIES = "depends on the temperature"
_MATT1 = ("modulus", "modulus", "poisson", "density", "expansion")  # by field: E and G are one


@dataclass(frozen=True)
class DeckMaterial:
    """A material of a deck.

    Attributes
    ----------
    name : str
    values : mapping of str to float
        Of ``expansion``, ``poisson``, ``modulus`` and ``density`` those that are single numbers.
    lacks : mapping of str to str
        Why others are not, where the deck has them in another form.
    """

    name: str
    values: Mapping[str, float] = field(default_factory=dict)
    lacks: Mapping[str, str] = field(default_factory=dict)


def deck_materials(path: Path) -> dict[str, DeckMaterial]:
    """Return the material of each element set (``.inp``) or property, by its number (Nastran), of a deck.

    Other meshes have none.

    Raises
    ------
    UserError
        If a card of a material cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix in BULK:
        return _of_cards(path)
    return _of_blocks(path) if suffix == ".inp" else {}


def _of_cards(path: Path) -> dict[str, DeckMaterial]:
    materials: dict[str, DeckMaterial] = {}
    varying: dict[str, set[str]] = {}
    properties: dict[str, str] = {}
    for short in cards(path):
        card = short._replace(fields=[*short.fields, *[""] * 8])
        number, second = (_plain(word) for word in card.fields[:2])
        if card.name == "MAT1":
            materials[number] = _mat1(card, f"{path.name}, line {card.line}")
        elif card.name == "MATT1":
            tables = zip(_MATT1, card.fields[1:6], strict=True)
            varying[number] = {name for name, table in tables if table not in ("", "0")}
        elif card.name in ("MAT9", "MAT11", "MATHP"):
            materials.setdefault(number, _unlike(f"{card.name} {number}", "is not of an isotropic material"))
        elif card.name in ("PSOLID", "PLSOLID"):
            properties[number] = second
    for number, names in varying.items():
        if number in materials:
            one = materials[number]
            kept = {name: value for name, value in one.values.items() if name not in names}
            materials[number] = DeckMaterial(one.name, kept, dict.fromkeys(names, _VARIES) | dict(one.lacks))
    return {number: materials[material] for number, material in properties.items() if material in materials}


def _plain(word: str) -> str:
    return (word.lstrip("0") or "0") if word.isdecimal() else word


def _mat1(card: Card, where: str) -> DeckMaterial:
    """Return MAT1: two of E, G and NU give the third (MSC Nastran Quick Reference Guide)."""
    given: dict[str, float] = {}
    lacks: dict[str, str] = {}
    for name, word in zip(
        ("modulus", "shear", "poisson", "density", "expansion"), card.fields[1:6], strict=True
    ):
        try:
            given |= {name: real(word, where)} if word else {}
        except UserError as error:  # a place holder, perhaps: whoever gives a value needs none here
            lacks[name] = f"cannot be read ({error})"
    shear = given.pop("shear", None)
    if shear and "modulus" in given:
        given.setdefault("poisson", given["modulus"] / (2.0 * shear) - 1.0)
    if shear and "poisson" in given:
        given.setdefault("modulus", 2.0 * (1.0 + given["poisson"]) * shear)
    return DeckMaterial(f"MAT1 {_plain(card.fields[0])}", given, lacks)


def _unlike(name: str, why: str) -> DeckMaterial:
    return DeckMaterial(name, {}, dict.fromkeys(("expansion", "poisson", "modulus", "density"), why))


def _of_blocks(path: Path) -> dict[str, DeckMaterial]:
    materials: dict[str, DeckMaterial] = {}
    sections: dict[str, str] = {}
    current = ""
    for keyword, options, data, line in blocks(path):
        if keyword == "MATERIAL":
            current = options.get("NAME", "")
            materials[current] = DeckMaterial(current)
        elif keyword in _CONSTANTS and current:
            one = materials[current]
            found = dict(_constants(keyword, options, data, (path.name, line)))
            values = {name: value for name, value in found.items() if isinstance(value, float)}
            lacks = {name: why for name, why in found.items() if isinstance(why, str)}
            materials[current] = DeckMaterial(current, {**one.values, **values}, {**one.lacks, **lacks})
        elif keyword == "SOLID SECTION":
            sections[options.get("ELSET", "")] = options.get("MATERIAL", "")
    return {name: materials[material] for name, material in sections.items() if material in materials}


_CONSTANTS = {"ELASTIC": ("modulus", "poisson"), "EXPANSION": ("expansion",), "DENSITY": ("density",)}


def _constants(
    keyword: str, options: Mapping[str, str], data: bytes, place: tuple[str, int]
) -> Iterator[tuple[str, float | str]]:
    """Yield each constant of a block, or why it is none."""
    names = _CONSTANTS[keyword]
    if not options.get("TYPE", "ISO").startswith("ISO"):
        yield from ((name, f"is of the type {options['TYPE']}") for name in names)
        return
    if not data:
        raise UserError(f"{place[0]}, line {place[1]}: *{keyword} has no numbers; the file may be cut off")
    rows = [row.rstrip(b", ") for row in data.split(b"\n")]
    width = rows[0].count(b",") + 1
    table = numbers(b"\n".join(rows), place[0], max(width, len(names)), place[1])
    for column, name in enumerate(names):
        values = table[:, column]
        yield name, float(values[0]) if (values == values[0]).all() else _VARIES
