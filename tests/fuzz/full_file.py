"""A small file as Ansys writes its matrices (.full), laid out as ansys-mapdl-reader reads it."""

import os
import signal
import sys
from pathlib import Path

import numpy as np

_HEADER = 100
_VERSION = int.from_bytes(b"1520"[::-1], "little")  # 15.2, revision 0


def record(values: list[int] | np.ndarray) -> bytes:
    """Return one record: its length in words, its type, its numbers, its length."""
    array = np.asarray(values)
    whole = array.dtype.kind == "i"
    data = array.astype("<i4" if whole else "<f8").tobytes()
    length = np.array([len(data) // 4], "<i4").tobytes()
    return length + (0x80000000 if whole else 0).to_bytes(4, "little") + data + length


def columns(matrix: np.ndarray) -> list[bytes]:
    """Return a symmetric matrix by columns: the rows from the diagonal on, and their numbers."""
    found = []
    for column in range(len(matrix)):
        rows = np.flatnonzero(matrix[column:, column]) + column
        rows = np.append(rows[rows != column], column)  # the diagonal stands last
        found += [record(rows + 1), record(matrix[rows, column])]
    return found


def full_file(stiffness: np.ndarray, mass: np.ndarray, fixed: int = 0) -> bytes:
    """Return a .full file of nodes with three directions each, of which the first `fixed` equations are."""
    count = len(stiffness)
    nodes = count // 3
    free = np.arange(count) - fixed + 1
    parts = {
        "standard": [record(np.array([4, -1, 0, 20170530, *[0] * 5, _VERSION, *[0] * (_HEADER - 10)]))],
        "header": [record(np.zeros(_HEADER, dtype=int))],
        "directions": [record(np.array([1, 2, 3]))],
        "equivalence": [record(np.arange(1, nodes + 1))],
        "stiffness": columns(stiffness),
        "dofs": [record(np.full(nodes, 3)), record(np.where(free < 1, free - 1, free))],
        "mass": columns(mass),
    }
    starts, place = {}, 0
    for name, records in parts.items():
        starts[name], place = place, place + sum(map(len, records)) // 4
    terms = [np.count_nonzero(np.tril(one)) for one in (stiffness, mass)]
    header = np.zeros(_HEADER, dtype=int)
    header[[0, 1, 3, 7, 8, 33, 32, 22]] = [-4, count, 2, 3, *terms, nodes, place]
    header[[18, 26, 35]] = [starts[name] for name in ("stiffness", "mass", "dofs")]
    parts["header"] = [record(header)]
    return b"".join(b"".join(records) for records in parts.values())


def small() -> bytes:
    stiffness = 4.0 * np.eye(9) - np.eye(9, k=1) - np.eye(9, k=-1)
    return full_file(stiffness, 2.0 * np.eye(9) + 0.1 * (np.eye(9, k=3) + np.eye(9, k=-3)), fixed=3)


def forked(words: list[str]) -> tuple[int, str]:
    """Run `ansys_reader.main` in a fork of this process, which has its libraries already."""
    from wavequake.mechanics.importers import ansys_reader

    said, into = os.pipe()
    if not (child := os.fork()):
        os.dup2(into, 1)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(8)  # a fork may hang where threads held locks, which a process of its own has not
        try:
            ansys_reader.main(words[0], words[1], int(words[2]), words[3])
        except SystemExit as end:
            sys.stdout.flush()
            os._exit(int(str(end)))
        os._exit(0)
    os.close(into)
    try:
        with open(said, errors="replace") as file:
            text = file.read()
    except BaseException:  # the harness has no more time
        os.kill(child, signal.SIGKILL)
        raise
    finally:
        _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status), text


def read(path: Path) -> object:
    """Read a .full file and put its matrices together."""
    from wavequake.mechanics.importers import ansys
    from wavequake.mechanics.importers.checks import assemble

    ansys.run = forked
    contents = ansys.read_matrices(path)
    return [assemble(part, contents.dofs) for part in contents.matrices.values()]
