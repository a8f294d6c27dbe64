"""Optical systems by name: telescopes, lenses and a lithographic objective, without segments or disturbances.

Segmented telescopes stand in `wavequake.optics.segments.catalog`; here are their monolithic parents.
"""

import difflib
from collections.abc import Callable

from wavequake.errors import UserError
from wavequake.optics.catalog.lenses import double_gauss, six_lens
from wavequake.optics.catalog.lithography import euv
from wavequake.optics.catalog.surveys import decam, hsc, rubin, sdss
from wavequake.optics.catalog.telescopes import gregorian, herschel, jwst, tmt, tmt_thesis
from wavequake.optics.systems.system import OpticalSystem

_BUILDERS: dict[str, Callable[[], OpticalSystem]] = {
    "tmt-thesis": tmt_thesis,
    "tmt": tmt,
    "jwst": jwst,
    "herschel": herschel,
    "gregorian": gregorian,
    "rubin": rubin,
    "hsc": hsc,
    "decam": decam,
    "sdss": sdss,
    "double-gauss": double_gauss,
    "six-lens": six_lens,
    "euv": euv,
}


def optical_system(name: str) -> OpticalSystem:
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
    builder = _BUILDERS.get(name) if isinstance(name, str) else None
    if builder is None:
        near = difflib.get_close_matches(str(name), _BUILDERS, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"choose one of {', '.join(_BUILDERS)}."
        raise UserError(f"There is no optical system {name!r}; {hint}")
    return builder()


def system_names() -> tuple[str, ...]:
    """Return the names of the bundled systems."""
    return tuple(_BUILDERS)
