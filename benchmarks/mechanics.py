"""How fast the built-in mirrors are built and solved, and how accurate they are.

Each mirror with its default mesh: assembly, and its first 36 modes (30 of them elastic) with the factors of
`wavequake.mechanics.vibration.eigen`, against the same with the defaults of SciPy and against CalculiX
(C3D20R, which computes stresses besides) where ccx is installed. One BLAS thread; measurements are
interleaved, medians of same-run ratios are what to compare between machines. The error is the largest of the
30 frequencies against refined meshes of two layers, 35 000 to 44 000 degrees of freedom, computed with
CalculiX.
"""

import csv
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.sparse.linalg import eigsh
from threadpoolctl import threadpool_limits

from wavequake.mechanics.mirrors.deck import write_deck
from wavequake.mechanics.mirrors.models import (
    AnnularMirror,
    CircularMirror,
    HexagonalSegment,
    Mirror,
    annular_mirror,
    circular_mirror,
    hexagonal_segment,
    mirror_mesh,
)
from wavequake.mechanics.model import FiniteElementModel
from wavequake.mechanics.vibration.eigen import eigenmodes

REPEATS = 5
MODES = 36
DATA = Path(__file__).parents[1] / "tests" / "data"
MIRRORS: dict[str, tuple[Mirror, Callable[[], FiniteElementModel]]] = {
    "circular": (CircularMirror(), circular_mirror),
    "annular": (AnnularMirror(), annular_mirror),
    "hexagonal": (HexagonalSegment(), hexagonal_segment),
}


def with_scipy_defaults(model: FiniteElementModel) -> Any:
    """Use the usual recipe: a small negative shift, and whatever factorization SciPy chooses."""
    return eigsh(model.stiffness, k=MODES, M=model.mass, sigma=-((2 * np.pi * 10.0) ** 2))


def with_calculix(mirror: Mirror) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_deck(Path(folder) / "job.inp", mirror_mesh(mirror), mirror.material, "C3D20R", MODES)
        subprocess.run(["ccx", "job"], cwd=folder, capture_output=True, check=True)


def error(name: str, frequencies: np.ndarray) -> float:
    """Largest relative error of the elastic frequencies."""
    with open(DATA / "calculix_refined.csv", newline="") as file:
        refined = np.array([float(row[f"{name} C3D20R"]) for row in csv.DictReader(file)])
    return float(np.abs(frequencies[6:] / refined[6:] - 1).max())


def seconds(job: Callable[[], Any]) -> float:
    start = time.perf_counter()
    job()
    return time.perf_counter() - start


def main() -> None:
    console = Console()
    table = Table(
        "mirror", "dof", "assembly s", "36 modes s", "error", "SciPy defaults", "CalculiX", box=None
    )
    calculix = shutil.which("ccx") is not None
    if not calculix:
        console.print("ccx is not installed (apt install calculix-ccx): that comparison is skipped")
    with threadpool_limits(1):
        for name, (mirror, build) in MIRRORS.items():
            model = build()
            jobs = {
                "assembly": build,
                "modes": partial(eigenmodes, model, MODES),
                "scipy": partial(with_scipy_defaults, model),
            }
            if calculix:
                jobs["calculix"] = partial(with_calculix, mirror)
            rounds = [{key: seconds(job) for key, job in jobs.items()} for _ in range(REPEATS)]
            times = {key: np.array([round_[key] for round_ in rounds]) for key in jobs}
            medians = {key: np.median(values) for key, values in times.items()}
            total = times["assembly"] + times["modes"]
            table.add_row(
                name,
                str(model.order),
                f"{medians['assembly']:.2f}",
                f"{medians['modes']:.2f}",
                f"{error(name, eigenmodes(model, MODES)[0]):.2%}",
                f"{np.median(times['scipy'] / times['modes']):.1f} x modes",
                f"{np.median(times['calculix'] / total):.1f} x both" if calculix else "",
            )
    console.print(table)


if __name__ == "__main__":
    main()
