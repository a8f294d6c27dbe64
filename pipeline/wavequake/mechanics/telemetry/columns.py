"""What a column of telemetry is: what is measured, where, and in which unit."""

import difflib
import re
from dataclasses import dataclass

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS

SIGHT, WAVEFRONT = "line_of_sight", "wavefront"
EXAMPLES = "line_of_sight.x_mas, wavefront.z4_nm, camera.ax_m_s2 or M2.dz_um"
MOST_TERM = 2016

LENGTHS = {"pm": 1e-12, "nm": 1e-9, "um": 1e-6, "mm": 1e-3, "m": 1.0}
ANGLES = {
    "uas": 1e-3 * RAD_PER_MAS,
    "mas": RAD_PER_MAS,
    "arcsec": 1e3 * RAD_PER_MAS,
    "nrad": 1e-9,
    "urad": 1e-6,
    "mrad": 1e-3,
    "rad": 1.0,
}
ACCELERATIONS = {"um_s2": 1e-6, "mm_s2": 1e-3, "m_s2": 1.0, "ug": 9.80665e-6, "mg": 9.80665e-3, "g": 9.80665}
_FORM = re.compile(r"(?P<axis>[xy]|z\d{1,4}|[dra][xyz])(?:_(?P<unit>\w+))?")
_FIELD = re.compile(r"(?P<name>.+?)\[(?P<number>\d{1,4})\]")


@dataclass(frozen=True)
class Channel:
    """One column of telemetry.

    Attributes
    ----------
    name : str
        As in the file.
    element : str
        `SIGHT`, `WAVEFRONT`, or what moves: a surface, body, segment or node of a body.
    axis : str
        x or y of the line of sight; z4 of a wavefront; dx, dy, dz, rx, ry, rz of an element, and its
        accelerations ax, ay, az.
    field : int
        Field point of wavefront and line of sight, from 0.
    unit : str
    si : float
        m, rad or m/s^2 per unit.
    """

    name: str
    element: str
    axis: str
    field: int
    unit: str
    si: float


def channel_of(name: str) -> Channel:
    """Return what a column is by its name, ``ELEMENT.AXIS_UNIT``.

    Raises
    ------
    UserError
        If it names nothing, has no unit, or one that does not fit.
    """
    element, _, kind = name.strip().rpartition(".")
    found = _FORM.fullmatch(kind)
    if not element or not found:
        raise UserError(f"the column {name!r} names nothing that is measured; write such as {EXAMPLES}.")
    axis, unit = found["axis"], found["unit"]
    field = 0
    if numbered := _FIELD.fullmatch(element):
        element, field = numbered["name"], int(numbered["number"]) - 1
        if element not in (SIGHT, WAVEFRONT) or field < 0:
            raise UserError(
                f"the column {name!r} names a field point, from 1; only {SIGHT}[2] and {WAVEFRONT}[2] do."
            )
    units = _units(name, element, axis)
    if unit not in units:
        known = ", ".join(f"{axis}_{one}" for one in units)
        said = f"the unit {unit!r}, which is none of it" if unit else "no unit"
        near = difflib.get_close_matches(unit or "", units, n=1)
        hint = f"did you mean {axis}_{near[0]}?" if near else f"write {known}."
        raise UserError(f"the column {name!r} has {said}; {hint}")
    return Channel(name, element, axis, field, unit, units[unit])


def _units(name: str, element: str, axis: str) -> dict[str, float]:
    """Return the units that a quantity may have."""
    if element == SIGHT and axis in ("x", "y"):
        return ANGLES | LENGTHS
    if element == WAVEFRONT and axis[0] == "z" and axis[1:].isdigit() and 1 <= int(axis[1:]) <= MOST_TERM:
        return LENGTHS
    if element not in (SIGHT, WAVEFRONT) and axis[0] in "dra" and len(axis) == 2:
        return {"d": LENGTHS, "r": ANGLES, "a": ACCELERATIONS}[axis[0]]
    raise UserError(
        f"the column {name!r} names nothing that is measured: {SIGHT} has x and y, {WAVEFRONT} Noll "
        "coefficients such as z4, and everything else dx, dy, dz, rx, ry, rz, ax, ay or az."
    )
