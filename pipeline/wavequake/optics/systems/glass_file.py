"""Glasses of the user's own in a study file: by a dispersion formula or by index and Abbe number.

::

    [system.glass.melt-7]
    formula = "sellmeier"
    coefficients = [1.04, 0.006, 0.232, 0.02, 1.01, 103.6]
    range_nm = [312.0, 2325.0]

    [system.glass.crown]
    index = 1.523
    abbe = 58.6
"""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from wavequake.optics.media.agf import read_agf
from wavequake.optics.media.dispersion import FORMULAS
from wavequake.optics.media.environment import STANDARD_C, Thermal
from wavequake.optics.media.glasses import Medium
from wavequake.optics.media.model_glass import model_glass
from wavequake.optics.sections import FileSection, Pair

_LENS_FILE_GLASS = re.compile(r"^\s*GLAS\s+(\S+)", re.MULTILINE)


class GlassSection(FileSection):
    """A glass: a formula with coefficients, or the index at 587.6 nm with the Abbe number."""

    formula: str | None = Field(default=None, description=f"one of {', '.join(FORMULAS)}; wavelengths in um")
    coefficients: tuple[float, ...] = Field(default=(), strict=False)
    range_nm: Pair | None = Field(default=None, description="where the formula holds")
    index: float | None = Field(default=None, gt=1, description="at 587.6 nm")
    abbe: float | None = Field(default=None, gt=0)
    thermal: tuple[float, ...] = Field(
        default=(),
        strict=False,
        description="D0, D1, D2, E0, E1, l_tk of Schott's formula",
    )
    thermal_at_c: float = Field(default=STANDARD_C, description="temperature of the coefficients")
    partial_dispersion: float = Field(default=0.0, description="P_gF, beside the normal line of glasses")

    @model_validator(mode="after")
    def _one_way(self) -> "GlassSection":
        if (self.formula is None) == (self.index is None) or (self.index is None) != (self.abbe is None):
            raise ValueError("it needs either formula and coefficients, or index and abbe")
        if self.formula is not None:
            known = FORMULAS.get(self.formula)
            if known is None:
                raise ValueError(f"the formula {self.formula!r} is unknown; choose of {', '.join(FORMULAS)}")
            if len(self.coefficients) not in known.counts:
                raise ValueError(
                    f"the formula {self.formula} takes {' or '.join(map(str, known.counts))} coefficients"
                )
        if len(self.thermal) not in (0, 6):
            raise ValueError("thermal takes the six coefficients D0, D1, D2, E0, E1, l_tk")
        return self


def own_glasses(sections: Mapping[str, GlassSection]) -> dict[str, Medium]:
    """Return the media of the sections by their names in upper case."""
    return {name.upper(): _medium(name, section) for name, section in sections.items()}


def _medium(name: str, section: GlassSection) -> Medium:
    if section.index is not None and section.abbe is not None:
        model = model_glass(section.index, section.abbe, section.partial_dispersion)
        formula, numbers, span = model.formula, model.coefficients, model.range_nm
    else:
        formula, numbers, span = section.formula or "", section.coefficients, (0.0, float("inf"))
    thermal = Thermal(section.thermal, section.thermal_at_c) if section.thermal else None
    return Medium(name, formula, numbers, section.range_nm or span, "own", thermal)


def embed_glasses(record: dict[str, Any], base: Path) -> None:
    """Put the glasses of the record's catalogue file that its surfaces or its lens file name beside them.

    Raises
    ------
    UserError
        If the catalogue cannot be read.
    """
    if not isinstance(record.get("glass_file"), str):
        return
    text, surfaces = record.get("file_text"), record.get("surface")
    named: Iterable[str] = _LENS_FILE_GLASS.findall(text) if isinstance(text, str) else ()
    if isinstance(surfaces, list | tuple):
        named = [*named, *(str(one.get("glass")) for one in surfaces if isinstance(one, dict))]
    catalogue = read_agf(base / record["glass_file"])
    given = dict(record.get("glass") or {})
    for name in sorted({one.upper() for one in named} & catalogue.keys()):
        medium = catalogue[name]
        numbers: dict[str, Any] = {"formula": medium.formula, "coefficients": list(medium.coefficients)}
        if medium.thermal is not None:
            numbers |= {"thermal": list(medium.thermal.coefficients), "thermal_at_c": medium.thermal.at_c}
        given.setdefault(medium.name, {**numbers, "range_nm": list(medium.range_nm)})
    record["glass"] = given
