"""Displacements, modes and temperatures in CalculiX' results (``.frd``) as text (manual of CrunchiX)."""

from pathlib import Path

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Array, Integers, fixed_reals, whole_lines
from wavequake.mechanics.nodal.step import Kind, Step, Written

_WIDTH = 12  # of a number; the node's number before has 10 digits behind the line's key of 3


def read_frd(path: Path) -> Written:
    """Return nodes, and displacements per increment or mode, or temperatures.

    Raises
    ------
    UserError
        If it is no such file, cut off, binary, or with neither.
    """
    lines = whole_lines(path).replace(b"\r", b"").split(b"\n")
    if not lines[0].startswith(b"    1C"):
        raise UserError(f"{path.name} is no .frd file as text: its first line is not '    1C'")
    if not any(line.startswith(b" 9999") for line in lines[-3:]):
        raise UserError(f"{path.name} is cut off: its last line must be 9999")
    try:
        return _blocks(lines, path.name)
    except (ValueError, IndexError) as error:
        raise UserError(f"{path.name} cannot be read ({error}); the file may be damaged") from None


def _blocks(lines: list[bytes], source: str) -> Written:
    nodes: tuple[Integers, Array] | None = None
    steps: list[Step] = []
    kind: Kind = "case"
    mode, at = 0, 0
    while at < len(lines):
        line = lines[at]
        if line.startswith(b"    2C"):
            nodes, at = _rows(lines, at + 1, 3, source)
            continue
        if line.startswith(b"    1PMODE"):
            mode = int(line[10:].split()[0])
        if line.startswith(b"  100C"):
            value, procedure = float(line[12:24]), line[57:58]
            name = lines[at + 1][4:13].strip()
            wanted = 0
            while lines[at + 1].startswith((b" -4", b" -5")):
                wanted += lines[at + 1].startswith(b" -5") and lines[at + 1][5:8].strip() != b"ALL"
                at += 1
            if name in (b"DISP", b"NDTEMP"):
                found, at = _rows(lines, at + 1, wanted, source)
                kind = _kind(procedure, mode)
                alike = sum(one.is_thermal == (name == b"NDTEMP") for one in steps)
                number = mode if kind == "mode" else alike + 1
                steps.append(Step(kind, number, value, found[0], found[1][:, : 3 if name == b"DISP" else 1]))
                mode = 0
                continue
            mode = 0
        at += 1
    if nodes is None or not steps:
        what = "neither displacements (DISP) nor temperatures (NDTEMP)" if nodes else "no nodes"
        raise UserError(f"{source} holds {what}")
    return Written(source, tuple(steps), *nodes)


def _kind(procedure: bytes, mode: int) -> Kind:
    """Return the kind of a step from the key ITYPE: 0 static, 1 time, 2 frequency."""
    if mode or procedure == b"2":
        return "mode"
    return "time" if procedure == b"1" else "case"


def _rows(lines: list[bytes], first: int, count: int, source: str) -> tuple[tuple[Integers, Array], int]:
    """Return node numbers and values of the lines -1, and the line after the block."""
    last = first
    while lines[last].startswith(b" -1"):
        last += 1
    if not lines[last].startswith(b" -3"):
        raise ValueError(f"line {last + 1}: a block of nodes is not closed by -3")
    width = 13 + _WIDTH * count
    text = [line.ljust(width)[:width] for line in lines[first:last]]
    if not text:
        raise ValueError(f"line {first + 1}: an empty block")
    table = np.frombuffer(b"".join(text), np.uint8).reshape(len(text), width)
    labels = np.ascontiguousarray(table[:, 3:13]).view("S10").ravel().astype(np.int64)
    fields = np.ascontiguousarray(table[:, 13:]).view(f"S{_WIDTH}").reshape(len(text), count)
    return (labels, fixed_reals(fields, source)), last + 1
