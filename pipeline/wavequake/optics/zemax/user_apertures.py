"""User-defined apertures of .zmx files: polygons, whose corners stand in the file.

USAP lets light through them and USOB stops it. UDAD 0 names the file from which they came, and their scale;
each further line is a corner, and zeros end a polygon. Several polygons that lie beside each other become one
by slits between them that are narrower than any ray would meet.
"""

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from wavequake.optics.shapes.concave import crossing, signed_distance
from wavequake.optics.shapes.polygons import signed_areas
from wavequake.optics.zemax.rows import Line, Row, as_integer, as_number, fail

Array = NDArray[np.float64]

USER_DEFINED = ("USAP", "USOB")
_SLIT = 1e-9  # width of a slit, as a share of the edges that it cuts
_MOST_CORNERS = 1000
_FARTHEST_MM = 1e9


def user_polygon(row: Row, line: Line, scale: float) -> tuple[tuple[float, float], ...]:
    """Return the corners, counterclockwise, of a surface's user-defined aperture in mm.

    Raises
    ------
    UserError
        If there are none, a corner is no plain one, or polygons overlap or contain each other.
    """
    polygons = _polygons(row, line, scale)
    merged = polygons[0]
    for number, one in enumerate(polygons[1:], start=1):
        others = polygons[:number]
        if any(_inside(one, other) or _inside(other, one) for other in others):
            fail(line, f"{row.label} has an aperture with a polygon in another one, which is not supported")
        merged = _joined(row, line, merged, one)
    return tuple(map(tuple, merged.tolist()))


def _polygons(row: Row, line: Line, scale: float) -> list[Array]:
    found: list[list[tuple[float, float]]] = [[]]
    lines = sorted(row.lines.get("UDAD", []), key=lambda one: as_integer(one, 0))
    for before, one in pairwise(lines):
        if as_integer(one, 0) == as_integer(before, 0):
            fail(
                one, f"{row.label} has an aperture whose line {as_integer(one, 0)} (UDAD) stands there twice"
            )
    for one in lines:
        if as_integer(one, 0) == 0:
            scale *= _scale(one)
            continue
        x, y, kind = (as_number(one, place) if len(one.words) > place else 0.0 for place in (1, 2, 3))
        if kind:
            fail(one, f"{row.label} has an aperture with a corner of the kind {kind:g}, which is not known")
        if max(abs(x), abs(y)) * scale > _FARTHEST_MM:
            fail(one, f"{row.label} has an aperture with a corner more than {_FARTHEST_MM:g} mm away")
        if x or y:
            found[-1].append((x * scale, y * scale))
        else:
            found.append([])
    polygons = [np.array(corners) for corners in found if corners]
    if not polygons or any(len(corners) < 3 for corners in polygons):
        fail(line, f"{row.label} has a user-defined aperture whose polygons need three corners (UDAD) each")
    if sum(map(len, polygons)) > _MOST_CORNERS:
        fail(line, f"{row.label} has a user-defined aperture of more than {_MOST_CORNERS} corners")
    polygons = [one if signed_areas(one[None])[0] > 0.0 else one[::-1] for one in polygons]
    if any(crossing(one[None])[0] for one in polygons):
        fail(line, f"{row.label} has an aperture with a polygon that crosses itself")
    return polygons


def _scale(line: Line) -> float:
    words = line.rest.split('"')[-1].split() if '"' in line.rest else line.words[2:]
    try:
        found = float(words[0]) if words else 1.0
    except ValueError:
        found = math.nan
    if not 0.0 < found < math.inf:
        fail(line, f"{words[0]!r} is not the scale of an aperture, a positive number")
    return found


def _inside(one: Array, other: Array) -> bool:
    """Tell whether a corner of a polygon lies in or on another."""
    return bool((signed_distance(other, *one.T) <= 0.0).any())


def _joined(row: Row, line: Line, one: Array, other: Array) -> Array:
    """Return two polygons as one, by a slit between the nearest corners that see each other."""
    away = np.hypot(*(one[:, None] - other[None]).transpose(2, 0, 1))
    for place in np.argsort(away, axis=None, kind="stable").tolist():
        i, k = divmod(place, len(other))
        first, second = np.roll(one, -i - 1, axis=0), np.roll(other, -k, axis=0)  # ends, begins at the corner
        back = second[0] + _SLIT * (second[-1] - second[0])
        again = first[-1] + _SLIT * (first[0] - first[-1])
        trial = np.concatenate([first, second, [back, again]])
        if not crossing(trial[None])[0]:
            break
    else:
        fail(line, f"{row.label} has an aperture whose polygons touch or cross, which is not supported")
    return np.asarray(trial)
