"""Make tests/data/plate.* and calculix_*.csv with CalculiX (2.20; Debian package calculix-ccx).

plate: a flat circular plate of aluminum, 1 m wide and 20 mm thick, mounted at three points of its rim.
plate.sti is the stiffness matrix of C3D20R, plate.mas the mass matrix of C3D20 (that of C3D20R is singular).
calculix_frequencies.csv: eigenfrequencies (Hz) of our meshes; calculix_refined.csv: of refined meshes in two
layers of C3D20R (35 000 to 44 000 degrees of freedom; minutes).
"""

import csv
import subprocess
import tempfile
from math import inf
from pathlib import Path

from wavequake.mechanics.mirrors.deck import write_deck
from wavequake.mechanics.mirrors.models import AnnularMirror, CircularMirror, HexagonalSegment, mirror_mesh

DATA = Path(__file__).parents[1] / "data"
PLATE = CircularMirror(focal_length=inf, mount_radius=0.5, core=1, rings=1)
MIRRORS = {
    "circular": CircularMirror(),
    "annular": AnnularMirror(),
    "hexagonal": HexagonalSegment(),
    "circular_two_layers": CircularMirror(core=3, rings=3, layers=2),
}
REFINED = {
    "circular": CircularMirror(core=12, rings=12, layers=2),
    "annular": AnnularMirror(around=84, rings=12, layers=2),
    "hexagonal": HexagonalSegment(divisions=20, layers=2),
}


def ccx(folder, mirror, element, modes=0):
    """Run CalculiX in `folder`; its files are called job.*."""
    write_deck(folder / "job.inp", mirror_mesh(mirror), mirror.material, element, modes)
    run = subprocess.run(["ccx", "job"], cwd=folder, capture_output=True, text=True, check=False)
    assert "Job finished" in run.stdout, run.stdout[-2000:]


def frequencies(text):
    """Eigenfrequencies in Hz, as printed, from the text of a .dat file."""
    rows = text.partition("E I G E N V A L U E   O U T P U T")[2].partition("P A R T")[0].splitlines()
    return [words[3] for words in map(str.split, rows) if len(words) == 5 and words[0].isdigit()]


def write_table(name, columns):
    with open(DATA / name, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def main():
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for element, ending in (("C3D20R", "sti"), ("C3D20", "mas")):
            ccx(folder, PLATE, element)
            (DATA / f"plate.{ending}").write_text((folder / f"job.{ending}").read_text())
        for ending in ("inp", "dof"):
            (DATA / f"plate.{ending}").write_text((folder / f"job.{ending}").read_text())

        def table(mirrors, elements, modes):
            columns = {}
            for mirror_name, mirror in mirrors.items():
                for element in elements:
                    ccx(folder, mirror, element, modes)
                    columns[f"{mirror_name} {element}"] = frequencies((folder / "job.dat").read_text())
            return columns

        write_table("calculix_frequencies.csv", table(MIRRORS, ("C3D20R", "C3D20"), 46))
        write_table("calculix_refined.csv", table(REFINED, ("C3D20R",), 36))


if __name__ == "__main__":
    main()
