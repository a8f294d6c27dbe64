"""Refractive media."""

from dataclasses import dataclass
from typing import Literal


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
