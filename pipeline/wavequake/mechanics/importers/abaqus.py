"""Matrices of Abaqus' ``*MATRIX OUTPUT`` (``.mtx``), formats ``MATRIX INPUT`` and ``COORDINATE``.

``MATRIX INPUT`` lines are ``node, direction, node, direction, value``; one triangle or the symmetric square
(Abaqus Keywords Reference, ``*MATRIX INPUT``). ``COORDINATE`` lines are ``row, column, value``; which degree
of freedom a row is must come from a ``.dof`` file. Fixed degrees of freedom carry 1e36 on the diagonal.
"""

from pathlib import Path

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import DIRECTIONS, Contents, Entries, numbers, whole, whole_lines


def read_matrix(path: Path) -> Contents:
    """Return the matrix of a ``.mtx`` file of Abaqus.

    Raises
    ------
    UserError
        If its lines have neither 3 nor 5 numbers, or one cannot be read; it is named.
    """
    body, first = _without_comments(whole_lines(path))
    width = len(body.split(b"\n", 1)[0].replace(b",", b" ").split())
    if width not in (3, 5):
        raise UserError(
            f"{path.name}, line {first}: {width} numbers, but a matrix of Abaqus has 5 in each line "
            "(FORMAT=MATRIX INPUT) or 3 (FORMAT=COORDINATE)"
        )
    table = numbers(body, path.name, width, first)
    places = whole(table[:, :-1], path.name)
    if width == 3:
        entries = Entries(path.name, places[:, 0] - 1, places[:, 1] - 1, table[:, 2], int(places.max()), True)
    else:
        keys = DIRECTIONS * places[:, ::2] + places[:, 1::2]
        entries = Entries(path.name, keys[:, 0], keys[:, 1], table[:, 4], None, True)
    return Contents({"": entries})


def _without_comments(data: bytes) -> tuple[bytes, int]:
    """Return the data lines and the line where they begin; comments and keywords begin with ``*``."""
    if b"*" not in data:
        return data.strip(), 1
    lines = data.split(b"\n")
    kept = [line for line in lines if not line.lstrip().startswith(b"*") and line.strip()]
    first = next((k for k, line in enumerate(lines, 1) if line.strip() and not line.startswith(b"*")), 1)
    return b"\n".join(kept), first
