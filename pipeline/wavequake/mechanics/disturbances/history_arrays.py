"""A history as arrays: an .npz file of NumPy, for many instants and terms, and for figures on grids."""

import base64
import binascii

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.history_facts import (
    MOST_INSTANTS,
    MOST_NUMBERS,
    MOST_TEXT,
    ElementHistory,
    GridHistory,
    history_from,
    place_of,
    require_distinct,
)
from wavequake.prepared import prepared
from wavequake.user_files import read_npz

Array = NDArray[np.float64]

_GRID, _SPACING = "grid_nm", "grid_spacing_mm"
_MOST_BYTES = 9 * MOST_NUMBERS  # of all arrays, unpacked


@prepared(maxsize=4)
def read_arrays(text: str) -> ElementHistory:
    """Read the base64 text of an .npz file.

    It holds ``time_s`` (n,), and by the names of a table's columns (`read_table`) arrays (n,). Heights of a
    figure on a grid are ``SURFACE.grid_nm`` (n, rows, columns), rows from the lowest y upwards and centered
    about the vertex, with ``SURFACE.grid_spacing_mm``: one number, or those along x and y.

    Raises
    ------
    UserError
        If it is no such file, an array has another shape or numbers that are not finite, the instants do not
        increase, or it is too large; names the array.
    """
    if len(text) > MOST_TEXT:
        raise UserError(
            f"it has {len(text) / 1e6:.0f} MB as text, {MOST_TEXT / 1e6:.0f} MB are possible; compress it "
            "(numpy.savez_compressed), or leave out instants or digits."
        )
    arrays = read_numbers(text)
    if "time_s" not in arrays:
        raise UserError(f"it lacks time_s, the instants; it holds {', '.join(arrays)[:80] or 'nothing'}.")
    time = arrays.pop("time_s")
    require_instants(time)
    spacings = {name: arrays.pop(name) for name in list(arrays) if name.endswith(f".{_SPACING}")}
    heights = {name: arrays.pop(name) for name in list(arrays) if name.endswith(f".{_GRID}")}
    grids = {}
    for name, values in heights.items():
        element = name.removesuffix(f".{_GRID}")
        spacing = spacings.pop(f"{element}.{_SPACING}", None)
        grids[element] = _grid(element, len(time), values, spacing)
    if spacings:
        raise UserError(f"{next(iter(spacings))!r} has no grid: add the heights, SURFACE.{_GRID}.")
    places = [place_of(name) for name in arrays]
    require_distinct(list(arrays), places)
    if not places and not grids:
        raise UserError("there is nothing beside time_s that moves; add arrays.")
    for name, values in arrays.items():
        if values.shape != time.shape:
            raise UserError(f"{name!r} has the shape {values.shape}, but time_s has {time.shape}.")
        require_finite(name, values)
    values = np.array(list(arrays.values())).reshape(len(places), len(time))
    return history_from(time, places, values.T, grids)


def read_numbers(text: str) -> dict[str, Array]:
    """Return all arrays of an .npz file, given as base64, by name; UserError if they are no numbers."""
    try:
        found = read_npz(base64.b64decode(text, validate=True), _MOST_BYTES)
    except binascii.Error as error:
        raise UserError(f"it is no .npz file of arrays ({error}).") from None
    except UserError as error:
        raise UserError(f"{error}.") from None
    for name, values in found.items():
        if values.dtype.kind not in "fiu":
            raise UserError(f"{name!r} holds {values.dtype}; it must hold numbers.")
    return {name: np.array(values, dtype=np.float64) for name, values in found.items()}


def require_instants(time: Array) -> None:
    """Raise UserError if instants are no list, too many, not finite, or do not increase."""
    if time.ndim != 1 or not time.size:
        raise UserError(f"time_s has the shape {time.shape}; it must be a list of at least one instant.")
    if len(time) > MOST_INSTANTS:
        raise UserError(f"there are more than {MOST_INSTANTS} instants; divide them among several studies.")
    require_finite("time_s", time)
    back = np.flatnonzero(np.diff(time) <= 0.0)
    if back.size:
        first = int(back[0])
        raise UserError(
            f"time_s does not increase from instant {first} ({time[first]:.12g}) to the next "
            f"({time[first + 1]:.12g}); sort the instants."
        )


def require_finite(name: str, values: Array) -> None:
    """Raise UserError if an array over time holds a number that is not finite."""
    bad = ~np.isfinite(values)
    if bad.any():
        place = tuple(int(number) for number in np.argwhere(bad)[0])
        raise UserError(f"{name!r} is {values[place]} at instant {place[0]}; all numbers must be finite.")


def _grid(element: str, instants: int, heights: Array, spacing: Array | None) -> GridHistory:
    name = f"{element}.{_GRID}"
    if heights.ndim != 3 or len(heights) != instants or min(heights.shape[1:]) < 4:
        raise UserError(
            f"{name!r} has the shape {heights.shape}; it must be {instants} instants, rows and columns, at "
            "least 4 of each."
        )
    require_finite(name, heights)
    if spacing is None:
        raise UserError(f"{name!r} lacks its spacing: add {element}.{_SPACING}, one number or two.")
    if spacing.shape not in ((), (1,), (2,)) or not ((spacing > 0.0) & np.isfinite(spacing)).all():
        raise UserError(
            f"'{element}.{_SPACING}' is {spacing.tolist()}; it must be a positive number, or two (x and y)."
        )
    dx, dy = np.broadcast_to(spacing, 2).tolist()
    return GridHistory(heights * 1e-9, (dx, dy))
