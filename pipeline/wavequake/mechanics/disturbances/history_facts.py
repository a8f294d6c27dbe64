"""What tables and arrays of motions over time say: names, units and instants, checked."""

import difflib
import re
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS

Array = NDArray[np.float64]
Place = tuple[str, str, int]

MOST_INSTANTS = 100_000
MOST_TERMS = 2016  # of a figure, as everywhere
MOST_NUMBERS = 2**24  # of all motions and figures: 134 MB, of which a trace has a few copies
MOST_TEXT = 2**26  # characters of a file's text: it becomes a part of the study, and of its store
RIGID = ("dx_um", "dy_um", "dz_um", "rx_urad", "ry_urad", "rz_urad")
SIGHT, SIGHT_AXES = "line_of_sight", ("x_mas", "y_mas")
COLUMNS = "SURFACE.dx_um, .dy_um, .dz_um, .rx_urad, .ry_urad, .rz_urad or .zN_nm"
_MICRO, _NANO = 1e-6, 1e-9
_TERM = re.compile(r"z(-?\d{1,9})_nm")


@dataclass(frozen=True)
class GridHistory:
    """Heights (n, rows, columns) of a figure in m, rows towards +y, about the vertex.

    ``spacing_mm`` is (dx, dy) between columns and rows.
    """

    heights: Array
    spacing_mm: tuple[float, float]


@dataclass(frozen=True)
class ElementHistory:
    """Motions and figures at n instants, SI units; nobody may write into the arrays.

    Attributes
    ----------
    time : ndarray, shape (n,)
        s, increasing.
    rigid : dict of ndarray, shape (n, 6)
        By the element's name: dx, dy, dz in m and rx, ry, rz in rad in its own frame at rest.
    figure : dict of ndarray, shape (n, terms)
        By the surface's name: Noll coefficients from j = 1 in m.
    grid : dict of GridHistory
        By the surface's name: heights that come on top of that.
    sight : ndarray, shape (n, 2)
        Rotation of the incoming bundle on the sky, rad, along x and y.
    """

    time: Array
    rigid: dict[str, Array]
    figure: dict[str, Array]
    sight: Array
    grid: dict[str, GridHistory] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the elements, those that move before those that deform only."""
        return tuple(dict.fromkeys((*self.rigid, *self.figure, *self.grid)))


def place_of(column: str) -> tuple[str, str, int]:
    """Return the element, "rigid", "figure" or "sight", and which number of it a column holds."""
    element, _, kind = column.rpartition(".")
    term = _TERM.fullmatch(kind)
    if not element:
        raise UserError(f"the column {column!r} does not say what moves; write {COLUMNS}.")
    if (element == SIGHT) != (kind in SIGHT_AXES):
        raise UserError(
            f"the column {column!r} is unknown; light turns by {SIGHT}.x_mas and {SIGHT}.y_mas alone."
        )
    if element == SIGHT:
        return element, "sight", SIGHT_AXES.index(kind)
    if term:
        if not 1 <= int(term[1]) <= MOST_TERMS:
            raise UserError(
                f"the column {column!r} is no Noll coefficient; they are counted from 1, to {MOST_TERMS}."
            )
        return element, "figure", int(term[1]) - 1
    if kind == "grid_nm":
        raise UserError(f"the column {column!r} cannot hold a grid; give its heights in an .npz file.")
    if kind in RIGID:
        return element, "rigid", RIGID.index(kind)
    near = difflib.get_close_matches(kind, (*RIGID, "z4_nm"), n=1)
    hint = f"{element}.{near[0]} would be one." if near else f"write {COLUMNS}."
    raise UserError(f"the column {column!r} is no motion with a known unit; {hint}")


def require_distinct(names: list[str], places: list[Place]) -> None:
    """Raise UserError if two names mean the same."""
    known: dict[Place, str] = {}
    for name, place in zip(names, places, strict=True):
        if place in known:
            raise UserError(f"there are two columns {known[place]!r}; keep one of them.")
        known[place] = name


def history_from(
    time: Array, places: list[Place], values: Array, grids: dict[str, GridHistory]
) -> ElementHistory:
    """Return the motions in SI units that the columns of `values` (n, columns) hold, with those on grids.

    Raises
    ------
    UserError
        If they are too many numbers.
    """
    terms: dict[str, int] = {}
    for element, kind, number in places:
        if kind == "figure":
            terms[element] = max(terms.get(element, 0), number + 1)
    moving = dict.fromkeys(element for element, kind, _ in places if kind == "rigid")
    nodes = sum(one.heights[0].size for one in grids.values())
    size = len(time) * (6 * len(moving) + sum(terms.values()) + nodes)
    if size > MOST_NUMBERS:
        raise UserError(
            f"{len(time)} instants of {len(moving)} moving elements, {sum(terms.values())} coefficients (up "
            f"to the highest of each figure) and {nodes} heights are {size} numbers; {MOST_NUMBERS} are "
            "possible."
        )
    rigid = {element: np.zeros((len(time), 6)) for element in moving}
    figure = {element: np.zeros((len(time), count)) for element, count in terms.items()}
    sight = np.zeros((len(time), 2))
    for (element, kind, number), column in zip(places, values.T, strict=True):
        if kind == "rigid":
            rigid[element][:, number] = column * _MICRO
        elif kind == "figure":
            figure[element][:, number] = column * _NANO
        else:
            sight[:, number] = column * RAD_PER_MAS
    for one in (time, *rigid.values(), *figure.values(), *(one.heights for one in grids.values()), sight):
        one.flags.writeable = False
    return ElementHistory(time, rigid, figure, sight, grids)
