"""Glasses of a system that no catalogue has: a lens file names them, a catalogue beside it holds them."""

from dataclasses import replace

from wavequake.errors import UserError
from wavequake.optics.media.agf import has_formula
from wavequake.optics.media.glasses import AIR, Medium, catalogues, glasses
from wavequake.optics.systems.system import OpticalSystem


def own_glasses(system: OpticalSystem) -> dict[str, Medium]:
    """Return the glasses that no catalogue has by the names that they have in a lens file.

    Raises
    ------
    UserError
        If two would have the same name.
    """
    found: dict[str, Medium] = {}
    for one in (system.medium, *(surface.medium for surface in system.surfaces)):
        if not isinstance(one, Medium) or one == AIR:
            continue
        plain = replace(one, environment=None)
        if is_known(plain) or not has_formula(plain):
            continue
        if found.setdefault(own_name(plain), plain) != plain:
            raise UserError(
                f"{system.name} has two glasses named {plain.name}, which a lens file cannot tell apart."
            )
    return found


def own_name(medium: Medium) -> str:
    """Return the name of a medium in a lens file, in one word."""
    return "_".join(medium.name.upper().split())


def is_known(medium: Medium) -> bool:
    """Return whether a medium is a glass of the catalogues."""
    return medium in (glasses().get(medium.name.upper()), of_maker(medium))


def of_maker(medium: Medium) -> Medium | None:
    """Return the glass of that name of the maker of a medium."""
    return catalogues().get(medium.catalogue, {}).get(medium.name.upper())
