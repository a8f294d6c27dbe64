"""Decks of our own with what CalculiX makes of quadratic tetrahedra, shells, beams and cyclic symmetry.

`python tests/mechanics/calculix_decks.py` runs CalculiX (2.20) on TETRAHEDRA and SHELL and stores their
matrices, and the eigenfrequencies of the former, in tests/data. SI units; aluminum of 70 GPa,
0.33, 2700 kg/m^3.
"""

import csv
import shutil
import subprocess
import tempfile
from itertools import permutations, product
from pathlib import Path

import numpy as np

DATA = Path(__file__).parents[1] / "data"
MATERIAL = "*MATERIAL, NAME=AL\n*ELASTIC\n70e9, 0.33\n*DENSITY\n2700.\n"
STORE = "*STEP\n*FREQUENCY, SOLVER=MATRIXSTORAGE\n1\n*END STEP\n"


def _tetrahedra():
    """A block of 0.3 x 0.2 x 0.1 m of six C3D10 (Kuhn's division), numbered 10, 20, ..."""
    grid = {place: 10 * (index + 1) for index, place in enumerate(product(range(3), repeat=3))}
    lines = ["*NODE, NSET=ALL"]
    lines += [f"{number}, {0.15 * x}, {0.1 * y}, {0.05 * z}" for (x, y, z), number in grid.items()]
    lines.append("*ELEMENT, TYPE=C3D10, ELSET=BODY")
    for count, axes in enumerate(permutations(range(3)), 1):
        corners = [np.zeros(3, dtype=int)]
        for axis in axes:
            corners.append(corners[-1] + 2 * np.eye(3, dtype=int)[axis])
        if np.linalg.det(np.array(corners[1:]) - corners[0]) < 0:
            corners[2], corners[3] = corners[3], corners[2]
        pairs = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
        nodes = [*corners, *((corners[a] + corners[b]) // 2 for a, b in pairs)]
        lines.append(f"{count}, " + ", ".join(str(grid[tuple(map(int, node))]) for node in nodes))
    top = [number for (_, _, z), number in grid.items() if z == 2]
    lines += ["*NSET, NSET=TOP", *(f"{number}," for number in top)]
    return "\n".join(lines) + f"\n{MATERIAL}*SOLID SECTION, ELSET=BODY, MATERIAL=AL\n"


TETRAHEDRA = _tetrahedra()
SHELL = f"""*NODE, NSET=ALL
1, 0., 0., 0.
2, 0.4, 0., 0.
3, 0.4, 0.3, 0.05
4, 0., 0.3, 0.05
5, 0.2, 0., 0.
6, 0.4, 0.15, 0.025
7, 0.2, 0.3, 0.05
8, 0., 0.15, 0.025
*ELEMENT, TYPE=S8, ELSET=BODY
1, 1, 2, 3, 4, 5, 6, 7, 8
{MATERIAL}*SHELL SECTION, ELSET=BODY, MATERIAL=AL
0.02
"""
BEAM = f"""*NODE, NSET=ALL
1, 0., 0., 0.
2, 0., 0., 0.5
3, 0., 0., 1.
4, 0., 0.25, 1.25
5, 0., 0.5, 1.5
*ELEMENT, TYPE=B32R, ELSET=BODY
1, 1, 2, 3
2, 3, 4, 5
{MATERIAL}*BEAM SECTION, SECTION=BOX, ELSET=BODY, MATERIAL=AL
0.05, 0.05, 0.003, 0.003, 0.003, 0.003
1., 0., 0.
*BOUNDARY
1, 1, 6
"""
CLAMPED_SHELL = SHELL + "*BOUNDARY\n1, 1, 6\n4, 1, 6\n8, 1, 6\n"


def run(folder, deck, modes=0):
    """Run CalculiX in `folder`: it stores the matrices, or writes so many eigenfrequencies."""
    step = STORE if not modes else f"*STEP\n*FREQUENCY\n{modes}\n*END STEP\n"
    (folder / "job.inp").write_text(deck + step)
    done = subprocess.run(["ccx", "job"], cwd=folder, capture_output=True, text=True, check=False)
    assert "Job finished" in done.stdout, done.stdout[-2000:]


def frequencies(folder):
    """Eigenfrequencies in Hz, as printed."""
    text = (folder / "job.dat").read_text().partition("E I G E N V A L U E")[2].partition("P A R T")[0]
    rows = [words for words in map(str.split, text.splitlines()) if len(words) >= 5 and words[0].isdigit()]
    return [words[-2] for words in rows]


def main():
    for name, deck in (("tetrahedra", TETRAHEDRA), ("shell", SHELL)):
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            run(folder, deck)
            for ending in ("sti", "mas", "dof", "inp"):
                shutil.copy(folder / f"job.{ending}", DATA / f"{name}.{ending}")
            if deck == SHELL:  # the program finds no modes of free shells
                continue
            run(folder, deck, 16)
            with open(DATA / f"{name}_frequencies.csv", "w", newline="") as file:
                csv.writer(file, lineterminator="\n").writerows([["frequency_Hz"], *zip(frequencies(folder))])


if __name__ == "__main__":
    main()
