"""How the light falls from the center of a pupil to its rim."""

from dataclasses import dataclass
from typing import Literal

from wavequake.errors import UserError

STRONGEST = 20.0
"""Largest factor of an apodization: its rim has 4e-18 of the central light."""


@dataclass(frozen=True)
class Apodization:
    """How the amplitude of the light falls from 1 at the pupil's center, as OpticStudio defines it.

    "gaussian": exp(-factor rho^2) at the share rho of the pupil's radius. "cosine_cubed": that of a point
    source which lights the plane of the entrance pupil, (1 + (rho tan(alpha))^2)^(-3/4) with the paraxial
    marginal ray's angle alpha in the object space; it has no factor, and is 1 for an object at infinity.
    Source: OpticStudio User Guide, "Apodization Type".
    """

    kind: Literal["gaussian", "cosine_cubed"]
    factor: float = 0.0


def require_apodization(given: Apodization, name: str) -> None:
    """Raise UserError unless an apodization of the system `name` is of a known kind and strength."""
    if given.kind not in ("gaussian", "cosine_cubed"):
        raise UserError(
            f"the apodization of {name} is {given.kind!r}; it can be 'gaussian' or 'cosine_cubed'"
        )
    if not 0.0 <= given.factor <= STRONGEST:
        raise UserError(
            f"the apodization of {name} has the factor {given.factor:g}; it must be from 0 to {STRONGEST:g}"
        )
