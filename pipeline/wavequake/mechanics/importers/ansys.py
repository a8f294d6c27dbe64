"""Matrices (``.full``) and results (``.rst``) of Ansys, through the optional package ansys-mapdl-reader."""

import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from wavequake import user_files
from wavequake.errors import UserError
from wavequake.mechanics.importers.entries import Contents, Entries

READER = Path(__file__).with_name("ansys_reader.py")


def read_matrices(path: Path) -> Contents:
    """Return stiffness, mass and degrees of freedom of a ``.full`` file.

    Raises
    ------
    UserError
        If ansys-mapdl-reader is not installed, or the file is no ``.full`` file.
    """
    return _contents(reader_arrays(path, ""), path.name)


def reader_arrays(path: Path, what: str) -> user_files.Arrays:
    """Return what ansys-mapdl-reader reads of a file: "displacements", "temperatures" or (empty) matrices.

    Raises
    ------
    UserError
        If the library is not installed, or cannot read the file.
    """
    if not _is_installed():
        raise UserError(
            f"reading {path.name} needs the package ansys-mapdl-reader: pip install ansys-mapdl-reader"
        )
    user_files.require_file(path)
    try:
        return _arrays(path, what)
    except UserError as error:
        raise UserError(f"{path.name} cannot be read as an Ansys {path.suffix} file: {error}") from None


def _is_installed() -> bool:
    try:
        return find_spec("ansys.mapdl.reader") is not None
    except (ImportError, ValueError):
        return False


def _arrays(path: Path, what: str) -> user_files.Arrays:
    """Return what the library reads, in a process of its own, which a damaged file may end."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "matrices.npz"
        code, said = run([str(path.resolve()), str(out), str(int(user_files.most_bytes())), what])
        if code > 0 or not out.exists():
            last = (said.splitlines() or [""])[-1] if code > 0 else ""
            raise UserError(last or f"its reader was ended by {signal.Signals(-code).name}")
        return user_files.read_npz(out.read_bytes())


def run(words: list[str]) -> tuple[int, str]:
    """Run `READER` with these arguments; return its exit code (of a signal: negative) and what it printed."""
    done = subprocess.run([sys.executable, "-P", READER, *words], capture_output=True, check=False)
    return done.returncode, done.stdout.decode(errors="replace")


def _contents(arrays: user_files.Arrays, name: str) -> Contents:
    matrices = {}
    for matrix in ("stiffness", "mass"):
        rows, columns, values = (arrays[f"{matrix}_{part}"] for part in ("rows", "columns", "values"))
        matrices[matrix] = Entries(
            f"{matrix} of {name}", rows, columns, values, int(arrays[f"{matrix}_size"]), True
        )
    # Its directions count from 0, ours from 1.
    return Contents(matrices, dofs=arrays["dofs"] + np.array([0, 1]), keeps_fixed=True)
