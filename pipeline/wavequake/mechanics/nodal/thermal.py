"""What a body is made of whose temperatures change, as a study says it or else its deck."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import inf
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from wavequake.errors import UserError
from wavequake.mechanics.importers.mesh import MeshFile, chosen_elements
from wavequake.mechanics.nodal.deck_materials import DeckMaterial
from wavequake.mechanics.nodal.expansion import Material, Solid

Nodes = str | Annotated[tuple[int | str, ...], Field(strict=False)]  # a study file has lists

_KEYS = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)


class _OfWhat(BaseModel):
    model_config = _KEYS

    expansion_per_k: float | None = Field(
        default=None,
        ge=-1e-2,
        le=1e-2,
        description="of length, 1/K; default: the mesh's",
    )
    poisson_ratio: float | None = Field(
        default=None, gt=-1, lt=0.5, description="default: the mesh's, where it has none 0.33"
    )
    youngs_modulus_gpa: float | None = Field(
        default=None, gt=0, description="of several materials; default: the mesh's"
    )
    density_kg_m3: float | None = Field(
        default=None,
        gt=0,
        description="of several materials, where the body floats; default: the mesh's, else equal",
    )


class ThermalMaterial(_OfWhat):
    """Elements that are of another material than the rest of a body."""

    elements: str | int | Annotated[tuple[int | str, ...], Field(strict=False, min_length=1)] = Field(
        description="element set (CalculiX, gmsh), property number (Nastran), or several"
    )


class Thermal(_OfWhat):
    """What temperatures of nodes do to a body that is held without strain, of one material or several."""

    material: Annotated[tuple[ThermalMaterial, ...], Field(strict=False)] = Field(
        default=(), description="other materials, by elements; of elements of several the last one counts"
    )
    # No default: files count in degrees Celsius or kelvin and do not say which.
    reference: float = Field(
        description="temperature at which the body has its shape, as the file counts them"
    )
    nodes: Nodes | None = Field(
        default=None, description="node set or node numbers of the surface; default: all nodes"
    )
    held: Nodes | None = Field(
        default=None,
        description="node set or node numbers at kinematic supports, whose mean motion is none; default: the "
        "body floats",
    )


def thermal_of(given: object) -> Thermal:
    """Return the section of a disturbance.

    Raises
    ------
    UserError
        If a key is missing or wrong.
    """
    try:
        return Thermal.model_validate(given)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(("thermal", *map(str, first["loc"])))
        raise UserError(f"{where}: {first['msg'][0].lower()}{first['msg'][1:]}") from None


_BARE = DeckMaterial("")  # of elements to which the deck gives none
_KEY = {
    "expansion": "expansion_per_k",
    "poisson": "poisson_ratio",
    "modulus": "youngs_modulus_gpa",
    "density": "density_kg_m3",
}
_WORDS = {"expansion": "expansion", "poisson": "Poisson's ratio", "modulus": "E", "density": "density"}


def body_materials(
    grid: MeshFile, body: Solid, thermal: Thermal, decks: Mapping[str, DeckMaterial]
) -> tuple[Solid, list[Material], str]:
    """Return a body whose elements know their materials, these, and what was taken from the deck.

    What `thermal` says of an element counts, else what the deck says.

    Raises
    ------
    UserError
        If elements or constants are not known, or moduli or densities stand in different units.
    """
    given, own = [thermal, *thermal.material], {"": _BARE} | {deck.name: deck for deck in decks.values()}
    layers = {kind: np.zeros((2, len(elements)), dtype=np.int64) for kind, elements in body.cells.items()}
    for number, one in enumerate(thermal.material, start=1):
        choice = one.elements if isinstance(one.elements, tuple) else (one.elements,)
        found = chosen_elements(grid, choice, "thermal.material")
        if not any(found[kind].any() for kind in layers):
            names = ", ".join(map(str, choice))
            raise UserError(f"{names} of {grid.source} (thermal.material) holds none of its solid elements")
        for kind, layer in layers.items():
            layer[0, found[kind]] = number
    sets = {name.upper(): numbers for name, numbers in grid.element_sets.items()}
    for name, deck in decks.items():
        for kind, layer in layers.items():
            members = np.isin(grid.numbers[kind], sets.get(name.upper(), ()))
            layer[1, members] = list(own).index(deck.name)
    pairs, inverse = np.unique(np.hstack(list(layers.values())), axis=1, return_inverse=True)
    ends = np.cumsum([layer.shape[1] for layer in layers.values()])[:-1]
    merged = dict(zip(layers, np.split(inverse.ravel(), ends), strict=True))
    chosen = [(given[first], list(own.values())[second]) for first, second in pairs.T]
    kept, note = _kept(grid.source, chosen, thermal.held is not None)
    return replace(body, layers=merged), [Material(**one) for one in kept], note


def _kept(
    source: str, chosen: Sequence[tuple[_OfWhat, DeckMaterial]], is_held: bool
) -> tuple[list[dict[str, float]], str]:
    """Return the constants of each material, those that are given or else the deck's, and which these are."""
    several = len(chosen) > 1
    counts = {"expansion": True, "poisson": True, "modulus": several, "density": several and not is_held}
    kept = [{"poisson": 0.33, "modulus": 1.0, "density": 1.0} for _ in chosen]
    taken: dict[str, list[str]] = {}
    for name in (one for one, is_so in counts.items() if is_so):
        found = [_constant(one, deck, name) for one, deck in chosen]
        bare = [deck for (_, deck), (_, value) in zip(chosen, found, strict=True) if value is None]
        if bare and (name in ("expansion", "modulus") or (name == "density" and len(bare) < len(chosen))):
            raise UserError(_missing(source, name, bare[0]))
        if name in ("modulus", "density") and len({by for by, value in found if value is not None}) > 1:
            raise UserError(
                f"thermal: {_KEY[name]} of some elements of {source} is given and of others the deck's, "
                "whose unit is not known; give it of all or of none"
            )
        for (_, deck), values, (by, value) in zip(chosen, kept, found, strict=True):
            if value is not None:
                values[name] = value
                if by == "deck":
                    _require_sound(source, deck, name)
                    taken.setdefault(deck.name, []).append(f"{_WORDS[name]} {value:g}")
    words = "; ".join(f"{deck} has {', '.join(dict.fromkeys(parts))}" for deck, parts in taken.items())
    return kept, f"as in {source}, in its units: {words}" if words else ""


def _constant(given: _OfWhat, deck: DeckMaterial, name: str) -> tuple[str, float | None]:
    """Return who gives a constant of a material, and its value."""
    value = getattr(given, _KEY[name])
    return ("user", value) if value is not None else ("deck", deck.values.get(name))


def _missing(source: str, name: str, deck: DeckMaterial) -> str:
    whose = f"that of {deck.name} in {source} {deck.lacks.get(name, 'is not there')}"
    if not deck.name:
        whose = f"{source} has no material of some of its solid elements"
    what = "is missing" if name == "expansion" else "is needed of each of several materials"
    return f"thermal: {_KEY[name]} {what}: {whose}"


def _require_sound(source: str, deck: DeckMaterial, name: str) -> None:
    """Refuse a constant of a deck that no material has."""
    low, high = {"expansion": (-1e-2, 1e-2), "poisson": (-1.0, 0.5)}.get(name, (0.0, inf))
    if not low < deck.values[name] < high:
        raise UserError(
            f"{source}: the material {deck.name} has {_KEY[name]} = {deck.values[name]:g}, which must be "
            f"between {low:g} and {high:g}"
        )
