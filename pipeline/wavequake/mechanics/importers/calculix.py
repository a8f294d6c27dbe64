"""Matrices that CalculiX stores with ``*FREQUENCY, SOLVER=MATRIXSTORAGE``: ``.sti``, ``.mas`` and ``.dof``.

Each line of the matrices is ``row column value`` of the upper triangle; line k of the ``.dof`` file is
``node.direction`` of degree of freedom k (CalculiX CrunchiX user's manual, keyword ``*FREQUENCY``).
"""

from pathlib import Path

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import (
    Contents,
    Entries,
    Integers,
    numbers,
    triples,
    whole,
    whole_lines,
)


def read_matrix(path: Path) -> Contents:
    """Return the upper triangle that a ``.sti`` or ``.mas`` file holds.

    Raises
    ------
    UserError
        If a line cannot be read; it is named.
    """
    data = whole_lines(path)
    last = data.rstrip().rsplit(b"\n", 1)[-1]
    # The last diagonal entry closes the upper triangle, so a file that ends elsewhere is cut off.
    tail = numbers(last, path.name, 3, data.rstrip().count(b"\n") + 1)[0]
    rows, columns, values = triples(data, path.name, int(max(tail[:2])))
    if tail[0] != tail[1]:
        raise UserError(
            f"{path.name} ends with row {tail[0]:.0f}, column {tail[1]:.0f}, not on the diagonal: "
            "the file is cut off, write it again"
        )
    entries = Entries(path.name, rows, columns, values, int(tail[0]), True)
    return Contents({"": entries}, keeps_fixed=True)


def read_dofs(path: Path) -> Integers:
    """Return the node numbers and directions 1..6 of a ``.dof`` file, shape (n, 2).

    Lines ``node.direction``, ``node direction`` and ``node,direction`` are all right.

    Raises
    ------
    UserError
        If a line is none of these; it is named.
    """
    data = whole_lines(path)
    # The point is no decimal point: 7.1 is node 7, direction 1.
    return whole(numbers(data.replace(b".", b" "), path.name, 2), path.name)
