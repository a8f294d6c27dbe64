"""Limits that users write with a unit."""

import re

import numpy as np

from wavequake.errors import UserError

_LEAST, _MOST = 1e-100, 1e100  # limits whose squares are numbers, too
_FORM = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(\S*)\s*")
_UNITS = {
    "nm": {"pm": 1e-3, "nm": 1.0, "um": 1e3, "µm": 1e3, "mm": 1e6, "m": 1e9},
    "µm": {"pm": 1e-6, "nm": 1e-3, "um": 1.0, "µm": 1.0, "mm": 1e3, "m": 1e6},
    "mm": {"pm": 1e-9, "nm": 1e-6, "um": 1e-3, "µm": 1e-3, "mm": 1.0, "m": 1e3},
    "mas": {
        "uas": 1e-3,
        "µas": 1e-3,
        "mas": 1.0,
        "arcsec": 1e3,
        "nrad": 0.648 / np.pi,
        "urad": 648.0 / np.pi,
    },
}


def unit_of(measure: str) -> str:
    """Return the unit in which a measure of rare events, or of allowances, is stored."""
    name = measure.partition("[")[0]
    return "mas" if name in ("los", "centroid") else "mm" if name in ("los_mm", "centroid_mm") else "nm"


def in_unit(text: str | float, unit: str, what: str = "The limit") -> float:
    """Return a number with its unit, as ``0.12 um``, in another unit; a number alone is in that.

    Raises
    ------
    UserError
        If it is no positive number within 1e-100 and 1e100, or of a unit of something else.
    """
    match = _FORM.fullmatch(str(text))
    try:
        value = float(match[1]) if match else np.nan
    except ValueError:
        value = np.nan
    if not match or not _LEAST < value < _MOST:
        bounds = f"; it must be between {_LEAST:g} and {_MOST:g}" if value > 0.0 else ""
        raise UserError(f"{what} {text!r} is no positive number with a unit, as '120 {unit}'{bounds}.")
    factors = _UNITS[unit]
    if match[2] and match[2] not in factors:
        raise UserError(f"{what} {text!r} has the unit {match[2]!r}; use one of {', '.join(factors)}.")
    return value * factors.get(match[2], 1.0)
