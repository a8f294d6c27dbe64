"""Optical systems by name: telescopes, lenses and a lithographic objective, without segments or disturbances.

Segmented telescopes stand in `wavequake.optics.segments.catalog`; here are their monolithic parents.
"""

import difflib
from collections.abc import Callable
from typing import TYPE_CHECKING

from wavequake.errors import UserError

if TYPE_CHECKING:
    from wavequake.optics.systems.system import OpticalSystem

_NAMES = (
    "tmt-thesis",
    "tmt",
    "jwst",
    "herschel",
    "gregorian",
    "rubin",
    "hsc",
    "decam",
    "sdss",
    "double-gauss",
    "six-lens",
    "euv",
)


def _builders() -> "dict[str, Callable[[], OpticalSystem]]":
    """Return what builds each; to load that takes five times as long as a list of names."""
    from wavequake.optics.catalog.lenses import double_gauss, six_lens
    from wavequake.optics.catalog.lithography import euv
    from wavequake.optics.catalog.surveys import decam, hsc, rubin, sdss
    from wavequake.optics.catalog.telescopes import gregorian, herschel, jwst, tmt, tmt_thesis

    found = (
        tmt_thesis, tmt, jwst, herschel, gregorian, rubin, hsc, decam, sdss, double_gauss, six_lens, euv,
    )  # fmt: skip
    return dict(zip(_NAMES, found, strict=True))


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
    if not isinstance(name, str) or name not in _NAMES:
        near = difflib.get_close_matches(str(name), _NAMES, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"choose one of {', '.join(_NAMES)}."
        raise UserError(f"There is no optical system {name!r}; {hint}")
    return _builders()[name]()


def system_names() -> tuple[str, ...]:
    """Return the names of the bundled systems."""
    return _NAMES
