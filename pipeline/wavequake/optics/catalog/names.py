"""Optical systems by name: telescopes, lenses and a lithographic objective, without segments or disturbances.

Segmented telescopes stand in `wavequake.optics.segments.catalog`; here are their monolithic parents.
"""

import difflib
from importlib import import_module
from typing import TYPE_CHECKING

from wavequake.errors import UserError

if TYPE_CHECKING:
    from wavequake.optics.systems.system import OpticalSystem

# Name -> module beside this one, and its function, which load when the system is asked for: a list of names
# takes a fifth of what they do.
_BUILDERS = {
    "tmt-thesis": ("telescopes", "tmt_thesis"),
    "tmt": ("telescopes", "tmt"),
    "jwst": ("telescopes", "jwst"),
    "herschel": ("telescopes", "herschel"),
    "gregorian": ("telescopes", "gregorian"),
    "rubin": ("surveys", "rubin"),
    "hsc": ("surveys", "hsc"),
    "decam": ("surveys", "decam"),
    "sdss": ("surveys", "sdss"),
    "double-gauss": ("lenses", "double_gauss"),
    "six-lens": ("lenses", "six_lens"),
    "euv": ("lithography", "euv"),
}


def optical_system(name: str) -> "OpticalSystem":
    """Return a bundled optical system by name.

    Parameters
    ----------
    name : str
        One of `system_names`.

    Raises
    ------
    UserError
        If there is no such system; the message names the nearest.
    """
    home = _BUILDERS.get(name) if isinstance(name, str) else None
    if home is None:
        near = difflib.get_close_matches(str(name), _BUILDERS, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"choose one of {', '.join(_BUILDERS)}."
        raise UserError(f"There is no optical system {name!r}; {hint}")
    module, function = home
    system: OpticalSystem = getattr(import_module(f"wavequake.optics.catalog.{module}"), function)()
    return system


def system_names() -> tuple[str, ...]:
    """Return the names of the bundled systems."""
    return tuple(_BUILDERS)
