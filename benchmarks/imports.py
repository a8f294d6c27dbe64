"""How long finite-element models take to read and to factorize, and how well that is forecast.

Text files of one million entries, and displacements of a million directions of nodes (seconds of processor
time and the most memory that reading traces), then factorizations of mirrors by nested dissection
against SuperLU and, where it is installed, PARDISO: time and memory, and the forecast of both over what was
measured. One thread.
"""

import tempfile
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.sparse import csc_array
from threadpoolctl import threadpool_limits

from wavequake.mechanics.importers import abaqus, calculix, matrix_market, nastran, op4
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.mechanics.nodal import frd, tables
from wavequake.mechanics.vibration import factors, pardiso
from wavequake.mechanics.vibration.dissection import dissect
from wavequake.mechanics.vibration.forecast import by_dissection

ENTRIES = 1_000_000
BAND = 40  # entries of each column
MIRRORS = ((8, 2), (9, 2), (11, 3), (16, 2))  # elements along a side of the core, layers
PATIENCE = 30_000
"""Unknowns up to which SuperLU is tried: beyond, its minimum degree takes minutes."""


def banded() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns (from 1) and values of an upper band, column by column, as programs write them."""
    columns = np.repeat(np.arange(1, ENTRIES // BAND + 2), BAND)[: ENTRIES + BAND]
    rows = columns - BAND + 1 + np.tile(np.arange(BAND), len(columns) // BAND + 1)[: len(columns)]
    kept = rows > 0
    values = np.random.default_rng(0).standard_normal(int(kept.sum()))
    return rows[kept], columns[kept], values


def write_files(folder: Path) -> dict[str, tuple[Path, Callable[[Path], Any]]]:
    """Write the same matrix in every text format; return files and their readers."""
    rows, columns, values = banded()
    size = int(columns.max())
    entries = list(zip(rows.tolist(), columns.tolist(), values.tolist(), strict=True))
    files = {
        name: (folder / f"matrix{suffix}", reader)
        for name, suffix, reader in (
            ("CalculiX .sti", ".sti", calculix.read_matrix),
            ("Abaqus .mtx, five columns", "_five.mtx", abaqus.read_matrix),
            ("Matrix Market .mtx", "_market.mtx", matrix_market.read_matrix),
            ("Nastran .pch", ".pch", nastran.read_matrices),
            ("Nastran .op4, text", ".op4", op4.read_matrices),
        )
    }
    with open(files["CalculiX .sti"][0], "w") as file:
        file.writelines(f"{row} {column} {value:20.13e}\n" for row, column, value in entries)
    with open(files["Abaqus .mtx, five columns"][0], "w") as file:
        file.writelines(
            f"{column // 3 + 1},{column % 3 + 1}, {row // 3 + 1},{row % 3 + 1}, {value:.15e}\n"
            for row, column, value in entries
        )
    with open(files["Matrix Market .mtx"][0], "w") as file:
        file.write(f"%%MatrixMarket matrix coordinate real symmetric\n{size} {size} {len(entries)}\n")
        file.writelines(f"{column} {row} {value:.16e}\n" for row, column, value in entries)
    starts = np.searchsorted(columns, np.arange(1, size + 2))
    with open(files["Nastran .pch"][0], "w") as file:
        file.write(f"DMIG    KAAX    {0:8}{6:8}{2:8}{0:8}        {size:8}\n")
        for column in range(1, size + 1):
            file.write(f"DMIG*   KAAX            {column // 3 + 1:16}{column % 3 + 1:16}\n")
            file.writelines(
                f"*       {row // 3 + 1:16}{row % 3 + 1:16}{value:16.9E}\n"
                for row, _, value in entries[starts[column - 1] : starts[column]]
            )
    with open(files["Nastran .op4, text"][0], "w") as file:
        file.write(f"{size:8}{-size:8}{6:8}{2:8}KAA     1P,3E23.16\n")
        for column in range(1, size + 1):
            part = entries[starts[column - 1] : starts[column]]
            words = 2 * len(part)
            file.write(f"{column:8}{0:8}{words + 2:8}\n{words + 1:8}{part[0][0]:8}\n")
            texts = [f"{value:23.16E}" for _, _, value in part]
            file.writelines("".join(texts[k : k + 3]) + "\n" for k in range(0, len(texts), 3))
        file.write(f"{size + 1:8}{1:8}{1:8}\n{1.0:23.16E}\n")
    return files


def write_displacements(folder: Path) -> dict[str, tuple[Path, Callable[[Path], Any]]]:
    """Write ten instants of the same displacements in every format of nodal results that is easily made."""
    random = np.random.default_rng(1)
    steps, nodes = 10, ENTRIES // 30
    points, moved = random.standard_normal((nodes, 3)), random.standard_normal((steps, nodes, 3)) * 1e-6
    labels = np.arange(1, nodes + 1)
    files = {
        f"displacements, {suffix}": (folder / f"nodes{suffix}", reader)
        for suffix, reader in (
            (".csv", tables.read_csv),
            (".npz", tables.read_arrays),
            (".frd", frd.read_frd),
        )
    }
    rows = np.hstack([np.tile(np.column_stack([labels, points]), (steps, 1)), moved.reshape(-1, 3) * 1e6])
    table = np.column_stack([np.repeat(np.arange(steps) * 0.1, nodes), rows])
    np.savetxt(
        folder / "nodes.csv",
        table,
        "%.9g",
        ",",
        header="time_s,node,x_m,y_m,z_m,dx_um,dy_um,dz_um",
        comments="",
    )
    (folder / "nodes.npz").write_bytes(tables.packed(True, np.arange(steps) * 0.1, points, moved))

    def block(values: np.ndarray) -> str:
        lines = (
            f" -1{label:10d}{x:12.5E}{y:12.5E}{z:12.5E}\n"
            for label, (x, y, z) in zip(labels, values.tolist(), strict=True)
        )
        return "".join(lines) + " -3\n"

    with open(folder / "nodes.frd", "w") as file:
        file.write(f"    1C\n    2C{'':18}{nodes:12d}{'':37}1\n" + block(points))
        for number, values in enumerate(moved, 1):
            file.write(f"  100CL  101{number * 0.1:12.5E}{nodes:12d}{'':20} 1{number:5d}{'':10} 1\n")
            file.write(" -4  DISP        4    1\n" + "".join(f" -5  D{k}\n" for k in (1, 2, 3)))
            file.write(" -5  ALL\n" + block(values))
        file.write(" 9999\n")
    return files


def measured(job: Callable[[], Any]) -> tuple[float, float]:
    """Return the least processor time of three runs in s, and the most memory that one traces, in GB."""
    times = []
    for _ in range(3):
        start = time.process_time()
        job()
        times.append(time.process_time() - start)
    tracemalloc.start()
    job()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return min(times), peak / 1e9


def reading() -> Table:
    table = Table("file of a million entries", "MB", "s", "GB", box=None)
    with tempfile.TemporaryDirectory() as name:
        made = write_files(Path(name)) | write_displacements(Path(name))
        for format_name, (path, reader) in made.items():
            seconds, memory = measured(lambda path=path, reader=reader: reader(path))  # type: ignore[misc]
            size = path.stat().st_size / 1e6
            table.add_row(format_name, f"{size:.0f}", f"{seconds:.2f}", f"{memory:.2f}")
    return table


def factorizing() -> Table:
    table = Table(
        "unknowns",
        "entries",
        "factors",
        "s",
        "GB",
        "forecast/s",
        "forecast/GB",
        "SuperLU s",
        "PARDISO s",
        "GB",
        box=None,
    )
    for core, layers in MIRRORS:
        mirror = CircularMirror(core=core, rings=core, layers=layers, thickness=0.1)
        model = circular_mirror(mirror)
        matrix = csc_array(model.stiffness + 1e3 * model.mass)
        matrix.sum_duplicates()
        told = by_dissection(matrix)

        def ours(matrix: csc_array = matrix) -> None:
            factors._Multifrontal(matrix, dissect(matrix), True)

        seconds, memory = measured(ours)
        start = time.process_time()
        if told.order <= PATIENCE:
            factors._superlu(matrix, 0.0)
        superlu = time.process_time() - start
        table.add_row(
            str(told.order),
            f"{told.entries / 1e6:.1f} M",
            f"{told.factors / 1e6:.1f} M",
            f"{seconds:.2f}",
            f"{memory:.2f}",
            f"{told.seconds / seconds:.2f}",
            f"{told.memory / 1e9 / memory:.2f}",
            f"{superlu:.2f}" if told.order <= PATIENCE else "",
            *pardiso_of(matrix),
        )
    return table


def pardiso_of(matrix: csc_array) -> tuple[str, str]:
    """Return seconds and memory of PARDISO; empty where it is not installed."""
    if not pardiso.is_there():
        return "", ""
    start = time.process_time()
    found = pardiso.Pardiso(matrix, True)
    found.factorize()
    return f"{time.process_time() - start:.2f}", f"{found.memory / 1e9:.2f}"


def main() -> None:
    console = Console()
    with threadpool_limits(1):
        console.print(reading())
        console.print(factorizing())


if __name__ == "__main__":
    main()
