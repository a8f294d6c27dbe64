"""Refractive media: dispersion formulas and a catalogue of glasses.

The catalogue, ``glasses.csv`` beside this module, holds published Sellmeier coefficients: those of
Schott's and Ohara's data sheets, Malitson's for fused silica and calcium fluoride, and the like; its
``source`` column says whose.
"""

import csv
import difflib
import math
from dataclasses import dataclass
from importlib.resources import files
from typing import Literal

from wavequake.errors import UserError
from wavequake.optics.checks import number, require_kind
from wavequake.prepared import prepared


@dataclass(frozen=True)
class Medium:
    """A homogeneous medium: its name and the coefficients of its dispersion formula.

    ``formula`` is "constant" (the index itself), "sellmeier" (B1, C1, B2, C2, B3, C3 with the wavelength in
    um) or "schott" (a0 ... a5). ``range_nm`` is where the formula holds.
    """

    name: str
    formula: Literal["constant", "sellmeier", "schott"]
    coefficients: tuple[float, ...]
    range_nm: tuple[float, float] = (0.0, float("inf"))


AIR = Medium("air", "constant", (1.0,))

ALIASES = {
    "FUSED_SILICA": "SILICA",
    "F_SILICA": "SILICA",
    "SI": "SILICON",
    "GE": "GERMANIUM",
    # Grades of higher transmission, with the dispersion of their glass.
    **{f"{base}HT": base for base in ("F2", "N-BAK4", "N-BK7", "N-KZFS4", "N-LASF45", "N-LASF9", "N-SK2")},
    **{f"{base}HT": base for base in ("N-SF57", "N-SF6", "SF6")},
    **{f"{base}HTULTRA": base for base in ("N-SF57", "N-SF6", "SF57")},
    "N-BK7HTI": "N-BK7",
}
"""Other names of glasses, in upper case, and the name that the catalogue has."""

# What light meets lies within: X-rays 0.99, metals 0.1, lead telluride 6, water at millimeters 9.
_LEAST, _MOST = 0.01, 100.0


def constant(index: float) -> Medium:
    """Return a medium whose index is the same at all wavelengths, named by it."""
    return Medium(f"n={number(index, 'the refractive index')!r}", "constant", (index,))


def refractive_index(medium: Medium, wavelength_mm: float) -> float:
    """Return the refractive index at a wavelength in air.

    Sellmeier: n^2 = 1 + sum_i B_i w^2 / (w^2 - C_i). Schott: n^2 = a0 + a1 w^2 + a2 w^-2 + a3 w^-4 + a4 w^-6
    + a5 w^-8. The wavelength w is in um.

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


def _squared_index(medium: Medium, w2: float) -> float:
    numbers = medium.coefficients
    counts = {"constant": 1, "sellmeier": 6, "schott": 6}
    expected = counts.get(medium.formula)
    if expected is None:
        raise UserError(
            f"The formula {medium.formula!r} of {medium.name} is unknown; choose one of {', '.join(counts)}."
        )
    if len(numbers) != expected:
        raise UserError(
            f"The formula {medium.formula!r} of {medium.name} takes {expected} coefficients, "
            f"not {len(numbers)}."
        )
    if medium.formula == "constant":
        return math.copysign(numbers[0] ** 2, numbers[0])
    if medium.formula == "sellmeier":
        terms = zip(numbers[::2], numbers[1::2], strict=True)
        return 1 + sum(b * w2 / (w2 - c) if w2 != c else math.inf for b, c in terms)
    return numbers[0] + numbers[1] * w2 + sum(a * w2**-k for k, a in enumerate(numbers[2:], 1))


def glass(name: str) -> Medium:
    """Return a glass of the catalogue, for example ``glass("N-BK7")``; upper and lower case are the same.

    Raises
    ------
    UserError
        If the catalogue does not hold it; the message names the nearest that it does.
    """
    require_kind(name, str, "the name of a glass")
    catalogue = glasses()
    key = ALIASES.get(name.upper(), name.upper())
    if key in catalogue:
        return catalogue[key]
    near = difflib.get_close_matches(key, [*catalogue, *ALIASES], n=3, cutoff=0.5)
    which, names = ("nearest", near) if near else ("first", sorted(catalogue)[:3])
    raise UserError(
        f"There is no glass {name!r} in the catalogue; the {which} of its {len(catalogue)} names are "
        f"{', '.join(names)}."
    )


@prepared(maxsize=None)
def glasses() -> dict[str, Medium]:
    """Return the catalogue: media by their name."""
    text = (files("wavequake.optics.media") / "glasses.csv").read_text(encoding="utf-8")
    rows = csv.DictReader(line for line in text.splitlines() if not line.startswith("#"))
    keys = ("B1", "C1", "B2", "C2", "B3", "C3")
    media = (
        Medium(
            row["name"],
            "sellmeier",
            tuple(float(row[key]) for key in keys),
            (float(row["from_nm"]), float(row["to_nm"])),
        )
        for row in rows
    )
    return {medium.name.upper(): medium for medium in media}
