"""Refractive media and glasses by name.

Two tables stand beside this module: ``glasses.csv``, crystals and silica by measurements that are published,
and ``catalogues.csv``, what makers of glass publish of theirs (`Catalogues`). Names collide: BAF2 is a
crystal, a glass of Hoya and one of CDGM. A name alone means the first of these tables, then the makers in
their order; ``"HOYA:BAF2"`` says which maker's.
"""

import csv
import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files

from wavequake.errors import UserError
from wavequake.optics.checks import number, require_kind
from wavequake.optics.media.dispersion import FORMULAS
from wavequake.optics.media.environment import STANDARD_C, Environment, Thermal, air_index, change
from wavequake.prepared import prepared


@dataclass(frozen=True)
class Medium:
    """A homogeneous medium: its name and the coefficients of its dispersion formula.

    ``formula`` is one of `wavequake.optics.media.dispersion.FORMULAS`, as "constant" (the index itself) or
    "sellmeier" (B1, C1, B2, C2, B3, C3 with the wavelength in um). ``range_nm`` is where it holds;
    ``catalogue`` the maker whose glass it is, empty for crystals and the like. ``thermal`` says how it
    follows temperature where its own catalogue does (`thermal_of` knows the makers'); with an ``environment``
    the index is that against the air there, for wavelengths in it.
    """

    name: str
    formula: str
    coefficients: tuple[float, ...]
    range_nm: tuple[float, float] = (0.0, float("inf"))
    catalogue: str = ""
    thermal: Thermal | None = None
    environment: Environment | None = None


AIR = Medium("air", "constant", (1.0,))

ALIASES = {
    "FUSED_SILICA": "SILICA",
    "FUSEDSILICA": "SILICA",
    "F_SILICA": "SILICA",
    "SI": "SILICON",
    "GE": "GERMANIUM",
    "SF57HTULTRA": "SF57",
}
"""Other names of glasses, in upper case, and the name that the catalogue has."""

SAME_MAKER = {"HIKARI": "NIKON", "NIKON-HIKARI": "NIKON", "SCHOTT_IRG": "SCHOTT"}
"""Other names of catalogues."""

Catalogues = Mapping[str, Mapping[str, Medium]]
"""Glasses by their name in upper case, by the catalogue in upper case."""

# What light meets lies within: X-rays 0.99, metals 0.1, lead telluride 6, water at millimeters 9.
_LEAST, _MOST = 0.01, 100.0


def constant(index: float) -> Medium:
    """Return a medium whose index is the same at all wavelengths, named by it."""
    return Medium(f"n={number(index, 'the refractive index')!r}", "constant", (index,))


def refractive_index(medium: Medium, wavelength_mm: float) -> float:
    """Return the refractive index at a wavelength in air.

    Parameters
    ----------
    medium : Medium
    wavelength_mm : float
        mm.

    Raises
    ------
    UserError
        Outside ``range_nm``, or if the coefficients give no real positive index that light could meet.
    """
    require_kind(medium, Medium, "the medium", ", such as glass('N-BK7') or constant(1.5)")
    if medium.environment is not None:
        return _index_in(medium.environment, medium, number(wavelength_mm, "the wavelength"))
    nm = 1e6 * number(wavelength_mm, "the wavelength")
    low, high = medium.range_nm
    if not (nm > 0 and low * (1 - 1e-12) <= nm <= high * (1 + 1e-12)):
        raise UserError(
            f"The index of {medium.name} is known from {low:g} to {high:g} nm, not at {nm:.6g} nm: choose a "
            "wavelength within that range or another glass."
        )
    try:
        squared = _squared_index(medium, (1e3 * wavelength_mm) ** 2)
    except OverflowError:
        squared = math.inf
    if not (math.isfinite(squared) and squared > 0):
        raise UserError(
            f"The coefficients of {medium.name} give no real refractive index at {nm:.6g} nm (its square "
            f"would be {squared:g})."
        )
    index = math.sqrt(squared)
    if not _LEAST <= index <= _MOST:
        raise UserError(
            f"The refractive index of {medium.name} at {nm:.6g} nm would be {index:g}; it must lie between "
            f"{_LEAST:g} and {_MOST:g}."
        )
    return index


def _index_in(environment: Environment, medium: Medium, wavelength_mm: float) -> float:
    """Return the index against the air of an environment, at a wavelength in that air."""
    thermal = thermal_of(medium)
    at = Environment(STANDARD_C if thermal is None else thermal.at_c)
    here, there = (air_index(1e3 * wavelength_mm, one) for one in (environment, at))
    measured = wavelength_mm * here / there
    index = refractive_index(replace(medium, environment=None), measured)
    absolute = index * air_index(1e3 * measured, at)
    if thermal is not None:
        absolute += change(index, thermal, 1e3 * measured, environment.temperature_c)
    return absolute / here


def in_environment(medium: Medium, environment: Environment) -> Medium:
    """Return a glass at a temperature and pressure.

    Raises
    ------
    UserError
        If nothing is known of how it follows temperature, and it is not that of its catalogue.
    """
    if medium == AIR:
        return medium
    if thermal_of(medium) is None and environment.temperature_c != STANDARD_C:
        raise UserError(
            f"nothing is known of how the index of {medium.name} follows temperature; give a catalogue that "
            "says it (lines TD) with --glass FILE.agf, or as system.glass_file of a study"
        )
    return replace(medium, environment=environment)


def thermal_of(medium: Medium) -> Thermal | None:
    """Return how a glass follows temperature, by its own catalogue or the makers'; None: it is not known."""
    return medium.thermal or _thermal().get((medium.catalogue, medium.name.upper()))


def _squared_index(medium: Medium, w2: float) -> float:
    formula = FORMULAS.get(medium.formula)
    if formula is None:
        raise UserError(
            f"The formula {medium.formula!r} of {medium.name} is unknown; choose one of "
            f"{', '.join(FORMULAS)}."
        )
    if len(medium.coefficients) not in formula.counts:
        raise UserError(
            f"The formula {medium.formula!r} of {medium.name} takes {' or '.join(map(str, formula.counts))} "
            f"coefficients, not {len(medium.coefficients)}."
        )
    return formula.squared(medium.coefficients, w2)


def glass(name: str) -> Medium:
    """Return a glass by name, as ``glass("N-BK7")`` or ``glass("HOYA:BAF2")``, in any case of letters.

    Raises
    ------
    UserError
        If no catalogue holds it; the message names the nearest that one does.
    """
    require_kind(name, str, "the name of a glass")
    maker, _, plain = name.upper().rpartition(":")
    if maker:
        return _of_maker(maker, plain, name)
    known = glasses()
    key = ALIASES.get(plain, plain)
    if key in known:
        return known[key]
    raise UserError(f"There is no glass {name!r} in the catalogue; {_nearest(key, [*known, *ALIASES])}.")


def medium_label(medium: Medium) -> str:
    """Return the name by which `glass` finds a medium: with its maker where the name alone means another."""
    medium = replace(medium, environment=None)
    if medium.catalogue and glasses().get(medium.name.upper()) != medium:
        return f"{medium.catalogue}:{medium.name}"
    return medium.name


def _of_maker(maker: str, name: str, asked: str) -> Medium:
    table = catalogue(maker, catalogues())
    if table is None:
        raise UserError(
            f"There is no catalogue {maker} for the glass {asked!r}; there are {', '.join(catalogues())}."
        )
    if name not in table:
        raise UserError(f"There is no glass {asked!r}; {_nearest(name, list(table))}.")
    return table[name]


def _nearest(name: str, names: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    which, shown = ("nearest", near) if near else ("first", sorted(names)[:3])
    return f"the {which} of its {len(names)} names are {', '.join(shown)}"


def catalogue(name: str, known: Catalogues) -> Mapping[str, Medium] | None:
    """Return the catalogue of a name such as "SCHOTT" or "SUMITA_AUG2011", or None if there is none."""
    words = name.upper().replace("-", "_").split("_")
    for key in (name.upper(), SAME_MAKER.get(name.upper(), ""), words[0], SAME_MAKER.get(words[0], "")):
        if key in known:
            return known[key]
    return None


@prepared(maxsize=None)
def glasses() -> dict[str, Medium]:
    """Return what a name alone means: crystals and silica, then the makers' glasses in their order."""
    found = dict(_crystals())
    for table in catalogues().values():
        for name, medium in table.items():
            found.setdefault(name, medium)
    return found


@prepared(maxsize=None)
def _crystals() -> dict[str, Medium]:
    keys = ("B1", "C1", "B2", "C2", "B3", "C3")
    return {
        row["name"].upper(): Medium(
            row["name"],
            "sellmeier",
            tuple(float(row[key]) for key in keys),
            (float(row["from_nm"]), float(row["to_nm"])),
        )
        for row in _rows("glasses.csv")
    }


@prepared(maxsize=None)
def catalogues() -> dict[str, dict[str, Medium]]:
    """Return the makers' catalogues that come with Wavequake, in their order."""
    found: dict[str, dict[str, Medium]] = {}
    for row in _rows("catalogues.csv"):
        found.setdefault(row["catalogue"], {})[row["name"].upper()] = Medium(
            row["name"],
            row["formula"],
            tuple(map(float, row["coefficients"].split())),
            (float(row["from_nm"]), float(row["to_nm"])),
            row["catalogue"],
        )
    return found


@prepared(maxsize=None)
def _thermal() -> dict[tuple[str, str], Thermal]:
    return {
        (row["catalogue"], row["name"].upper()): Thermal(
            tuple(map(float, row["coefficients"].split())), float(row["at_c"])
        )
        for row in _rows("thermal.csv")
    }


def _rows(name: str) -> list[dict[str, str]]:
    text = (files("wavequake.optics.media") / name).read_text(encoding="utf-8")
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
