"""Displacements or temperatures of nodes in tables: CSV with names of columns, text as of Zemax STAR."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wavequake import user_files
from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Array, Integers, numbers, whole
from wavequake.mechanics.nodal.step import Kind, Step, Written

_UNITS = {"nm": 1e-9, "um": 1e-6, "mm": 1e-3, "m": 1.0}
_PLACES, _SHIFTS = ("x", "y", "z"), ("dx", "dy", "dz")
_TEMPERATURE = "temperature_c"
COLUMNS = (
    "x_mm, y_mm, z_mm, dx_um, dy_um, dz_um (or in _nm, _mm, _m) or temperature_c, and perhaps node, and "
    "time_s or case"
)


def read_csv(path: Path) -> Written:
    """Return what a CSV holds whose first line names its columns, see `COLUMNS`.

    Each row is a node at an instant or in a load case; without either there is one load case.

    Raises
    ------
    UserError
        If a column or value is not what it must be, or a step lacks a node.
    """
    names, table = _table(path)
    where, measured, factors = _columns(names, path.name)
    points = table[:, where] * factors[: len(where)] if where else None
    moved = table[:, measured] * factors[len(where) :]
    key = next((name for name in ("time_s", "case") if name in names), None)
    given = table[:, names.index(key)] if key else np.zeros(len(table))
    kind: Kind = "time" if key == "time_s" else "case"
    values, step = np.unique(given, return_inverse=True)
    if points is None or "node" in names:
        labels = whole(table[:, names.index("node")], path.name)
    else:
        labels = _numbered(points)
    parts = np.split(np.argsort(step, kind="stable"), np.cumsum(np.bincount(step))[:-1])
    chosen = parts[0]
    steps = []
    for number, (value, rows) in enumerate(zip(values.tolist(), parts, strict=True)):
        case = int(value) if key == "case" else number + 1
        steps.append(Step(kind, case, value if key == "time_s" else 0.0, labels[rows], moved[rows]))
    return Written(path.name, tuple(steps), labels[chosen], None if points is None else points[chosen], 1.0)


def _numbered(points: Array) -> Integers:
    """Return numbers from 1 for places in the order in which they come; equal ones have the same."""
    import pandas as pd  # which is slow to load

    return np.asarray(pd.factorize(pd.MultiIndex.from_arrays(list(points.T)))[0] + 1, dtype=np.int64)


def _table(path: Path) -> tuple[list[str], Array]:
    """Return the names of the columns and the rows of a CSV; lines that begin with # are left out."""
    lines = user_files.read_text(path).splitlines()
    first = next((k for k, line in enumerate(lines) if line.strip() and not line.startswith("#")), 0)
    try:
        names = [cell.strip() for cell in next(csv.reader(lines[first : first + 1]), [])]
    except csv.Error as error:
        raise UserError(f"{path.name}, line {first + 1} is no CSV ({error})") from None
    body = "\n".join(line for line in lines[first + 1 :] if not line.startswith("#")).encode() + b"\n"
    if not body.strip():
        raise UserError(f"{path.name} has no rows below the line that names its columns")
    table = numbers(body, path.name, len(names), first + 2)
    if not np.isfinite(table).all():
        row, column = np.argwhere(~np.isfinite(table))[0]
        raise UserError(f"{path.name}, row {row + 1}: {names[column]} is {table[row, column]}")
    return names, table


def _columns(names: list[str], source: str) -> tuple[list[int], list[int], Array]:
    """Return where coordinates and displacements or temperatures stand, and what makes them m.

    Temperatures of numbered nodes need no coordinates.
    """
    found: dict[str, tuple[int, float]] = {}
    for place, name in enumerate(names):
        axis, _, unit = name.rpartition("_")
        if name == _TEMPERATURE and name not in found:
            found[name] = (place, 1.0)
        elif axis in (*_PLACES, *_SHIFTS) and unit in _UNITS and axis not in found:
            found[axis] = (place, _UNITS[unit])
        elif name not in ("node", "time_s", "case") or names.count(name) > 1:
            raise UserError(f"{source}: the column {name!r} is not known or given twice; write {COLUMNS}")
    thermal = _TEMPERATURE in found
    places = () if thermal and "node" in names and not found.keys() & set(_PLACES) else _PLACES
    wanted = (*places, *((_TEMPERATURE,) if thermal else _SHIFTS))
    missing = [axis for axis in wanted if axis not in found]
    if missing:
        raise UserError(f"{source} has no column {missing[0]} with a unit; write {COLUMNS}")
    if "time_s" in names and "case" in names:
        raise UserError(f"{source} has both time_s and case; keep one of them")
    both = [found[axis] for axis in wanted]
    where = [place for place, _ in both]
    return where[: len(places)], where[len(places) :], np.array([factor for _, factor in both])


def read_modes(path: Path) -> tuple[Integers, Array, Array, Array, Array]:
    """Return the modes of a CSV, a row for each node in each mode, for modal masses of 1 kg.

    Columns are mode, frequency_hz, node, x_mm, y_mm, z_mm, and the shape dx, dy, dz in 1/sqrt(kg); perhaps
    damping_ratio, and the rotations rx, ry, rz in 1/(m sqrt(kg)).

    Returns
    -------
    labels, points, frequencies, ratios, shapes : ndarray
        Shapes (p,), (p, 3) in m, (r,) in Hz, (r,), (r, p, 3 or 6).

    Raises
    ------
    UserError
        If a column or value is not what it must be, or a mode lacks a node.
    """
    names, table = _table(path)
    needed = ["mode", "frequency_hz", "node", "x_mm", "y_mm", "z_mm", *_SHIFTS]
    turns = ["rx", "ry", "rz"] if "rx" in names else []
    for name in (*needed, *turns, *names):
        if names.count(name) != 1 or name not in (*needed, *turns, "damping_ratio"):
            raise UserError(
                f"{path.name}: the column {name!r} is missing, given twice or not known; write "
                f"{', '.join(needed)}, and perhaps damping_ratio, rx, ry, rz"
            )
    column = {name: table[:, place] for place, name in enumerate(names)}
    modes, row = np.unique(column["mode"], return_inverse=True)
    labels, place = np.unique(whole(column["node"], path.name), return_inverse=True)
    if len(table) != len(modes) * len(labels) or len(np.unique(row * len(labels) + place)) < len(table):
        raise UserError(
            f"{path.name}: {len(modes)} modes of {len(labels)} nodes are {len(modes) * len(labels)} rows, "
            f"one for each node in each mode; it has {len(table)}"
        )
    order = np.argsort(row * len(labels) + place)
    grid = (len(modes), len(labels))

    def arranged(wanted: Sequence[str]) -> Array:
        return np.stack([column[name][order].reshape(grid) for name in wanted], axis=-1)

    points, frequencies = arranged(["x_mm", "y_mm", "z_mm"]), arranged(["frequency_hz"])[..., 0]
    ratios = arranged(["damping_ratio"])[..., 0] if "damping_ratio" in names else np.zeros(grid)
    for what, values, axis in (("place", points, 0), ("frequency", frequencies, 1), ("damping", ratios, 1)):
        if (np.diff(values, axis=axis) != 0.0).any():
            of = "a node is not the same in all modes" if axis == 0 else "a mode is not the same at all nodes"
            raise UserError(f"{path.name}: the {what} of {of}")
    return labels, points[0] * 1e-3, frequencies[:, 0], ratios[:, 0], arranged([*_SHIFTS, *turns])


def read_text(path: Path) -> Written:
    """Return what lines ``x y z dx dy dz`` or ``x y z T`` hold, as of Zemax STAR, in a unit to be said.

    Lines of words, and those that begin with # or !, are left out.

    Raises
    ------
    UserError
        If a line has not six numbers, or all have not four.
    """
    lines = user_files.read_text(path).replace(";", " ").replace("\t", " ").splitlines()
    first = next((k for k, line in enumerate(lines) if _is_row(line)), None)
    if first is None:
        raise UserError(f"{path.name} has no lines of six numbers, x y z dx dy dz, or of four, x y z T")
    rows = [line for line in lines[first:] if line.strip() and line.lstrip()[0] not in "#!"]
    width = 4 if len(rows[0].replace(",", " ").split()) == 4 else 6
    table = numbers(("\n".join(rows) + "\n").encode(), path.name, width, first + 1)
    if not np.isfinite(table).all():
        raise UserError(f"{path.name}, row {int(np.argwhere(~np.isfinite(table))[0, 0]) + 1} is not finite")
    labels = np.arange(1, len(table) + 1)
    return Written(path.name, (Step("case", 1, 0.0, labels, table[:, 3:]),), labels, table[:, :3])


def _is_row(line: str) -> bool:
    try:
        return len([float(word) for word in line.replace(",", " ").split()]) > 0
    except ValueError:
        return False


def read_arrays(path: Path) -> Written:
    """Return the displacements or temperatures of an ``.npz`` file.

    ``nodes_mm`` (p, 3), ``displacements_um`` (n, p, 3) or, of one load case, (p, 3), or ``temperatures_c``
    (n, p) or (p,); perhaps ``time_s`` (n,) or numbers of ``cases`` (n,), and ``node_numbers`` (p,).

    Raises
    ------
    UserError
        If it is no such file, an array is missing or has another shape or numbers that are not finite.
    """
    try:
        found = user_files.read_npz(user_files.read_bytes(path))
        return from_arrays(found, path.name)
    except UserError as error:
        words = str(error)
        raise UserError(words if path.name in words else f"{path.name}: {words}") from None


def from_arrays(found: user_files.Arrays, source: str) -> Written:
    """Return what arrays hold, see `read_arrays`."""
    note = found.get("note", np.array(""))
    if note.dtype.kind != "U" or note.ndim:
        raise UserError("'note' is no text")
    found = {name: values for name, values in found.items() if name != "note"}
    given = "temperatures_c" if "temperatures_c" in found else "displacements_um"
    known = ("nodes_mm", given, "time_s", "node_numbers", "cases")
    for name in ("nodes_mm", given, *found):
        if name not in found or name not in known:
            raise UserError(
                f"{'the array' if name in known else 'there is no meaning of'} {name!r}"
                f"{' is missing' if name in known else ''}; it takes {', '.join(known)}"
            )
        values = found[name]
        if values.dtype.kind not in "fiu" or not np.isfinite(values).all():
            raise UserError(f"{name!r} holds what is no finite number")
    points, moved = (np.asarray(found[name], dtype=np.float64) for name in ("nodes_mm", given))
    width = 3 if given == "displacements_um" else 1
    if width == 1:
        moved = moved[..., None]
    moved = moved[None] if moved.ndim == 2 else moved
    shape = (len(moved), len(points), width)
    if points.shape != (len(points), 3) or moved.shape != shape or not moved.size:
        raise UserError(
            f"'nodes_mm' has the shape {points.shape} and {given!r} {found[given].shape}; they must be "
            f"(p, 3) and {'(n, p, 3)' if width == 3 else '(n, p)'}"
        )
    if "time_s" in found and "cases" in found:
        raise UserError("it has both 'time_s' and 'cases'; keep one of them")
    for name, count in (("time_s", len(moved)), ("cases", len(moved)), ("node_numbers", len(points))):
        if name in found and found[name].shape != (count,):
            raise UserError(f"{name!r} has the shape {found[name].shape}; it must be ({count},)")
    time = found.get("time_s")
    labels, cases = (
        whole(np.asarray(found.get(name, np.arange(1, count + 1)), dtype=np.float64), source)
        for name, count in (("node_numbers", len(points)), ("cases", len(moved)))
    )
    kind: Kind = "case" if time is None else "time"
    steps = [
        Step(
            kind, number, 0.0 if time is None else float(time[row]), labels, one * 1e-6 if width == 3 else one
        )
        for row, (number, one) in enumerate(zip(cases.tolist(), moved, strict=True))
    ]
    return Written(source, tuple(steps), labels, points * 1e-3, 1.0, str(note))


def packed(over_time: bool, values: Array, points: Array, displacements: Array, note: str = "") -> bytes:
    """Return an ``.npz`` of `read_arrays` of points (p, 3) and displacements (n, p, 3) in m.

    ``values`` (n,) are instants, or else the numbers of load cases; ``note`` says where they are from.
    """
    out = io.BytesIO()
    arrays: dict[str, Any] = {"nodes_mm": points * 1e3, "displacements_um": displacements * 1e6}
    arrays["time_s" if over_time else "cases"] = values
    arrays |= {"note": np.array(note)} if note else {}
    np.savez_compressed(out, **arrays)
    return out.getvalue()
