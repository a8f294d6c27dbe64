"""Our hexahedra against those of CalculiX: stored results of 2.20, and the program where it is installed."""

import csv
import re
import shutil
from dataclasses import replace
from pathlib import Path

import calculix_oracle
import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.deck import write_deck
from wavequake.mechanics.mirrors.hexahedra import assemble
from wavequake.mechanics.mirrors.models import (
    CircularMirror,
    HexagonalSegment,
    annular_mirror,
    circular_mirror,
    hexagonal_segment,
    mirror_mesh,
)
from wavequake.mechanics.vibration.eigen import eigenmodes

DATA = Path(__file__).parents[1] / "data"

BUILD = {"circular": circular_mirror, "annular": annular_mirror, "hexagonal": hexagonal_segment}
POINTS = {"C3D20R": 2, "C3D20": 3}

needs_ccx = pytest.mark.skipif(
    shutil.which("ccx") is None, reason="ccx is not installed (Debian package calculix-ccx)"
)


def read_matrix(path, size):
    entries = np.loadtxt(path)
    rows, columns = entries[:, :2].astype(int).T - 1
    matrix = np.zeros((size, size))
    matrix[rows, columns] = matrix[columns, rows] = entries[:, 2]
    return matrix


def assert_equal_as_printed(ours, printed):
    """14 significant digits of each printed number; rounding of the largest where numbers cancel."""
    np.testing.assert_allclose(ours, printed, rtol=1e-12, atol=1e-12 * np.abs(printed).max())


def stored(name):
    with open(DATA / name, newline="") as file:
        rows = list(csv.DictReader(file))
    return {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}


def elastic_frequencies(mirror, points, count):
    """With the same Gauss points for stiffness and mass, as CalculiX has them."""
    mesh = mirror_mesh(mirror)
    mass, stiffness = assemble(mesh.nodes, mesh.elements, mirror.material, points, points)
    model = BUILD[type(mirror).__name__.removesuffix("Mirror").removesuffix("Segment").lower()](mirror)
    return eigenmodes(replace(model, mass=mass, stiffness=stiffness), count)[0][6:]


def test_matrices_of_the_plate_are_those_of_calculix():
    mesh = mirror_mesh(calculix_oracle.PLATE)
    mass, stiffness = assemble(mesh.nodes, mesh.elements, calculix_oracle.PLATE.material)
    assert_equal_as_printed(stiffness.toarray(), read_matrix(DATA / "plate.sti", 243))
    assert_equal_as_printed(mass.toarray(), read_matrix(DATA / "plate.mas", 243))


@pytest.mark.parametrize("element", POINTS)
@pytest.mark.parametrize("name", calculix_oracle.MIRRORS)
def test_frequencies_are_those_of_calculix_in_all_printed_digits(name, element):
    expected = stored("calculix_frequencies.csv")[f"{name} {element}"][6:26]
    found = elastic_frequencies(calculix_oracle.MIRRORS[name], POINTS[element], 26)
    np.testing.assert_allclose(found, expected, rtol=6e-7)


@pytest.mark.parametrize("name", BUILD)
def test_thirty_frequencies_of_the_default_meshes_are_within_a_percent(name):
    """Against two layers of 24 elements across, computed by CalculiX."""
    model = BUILD[name]()
    assert model.order <= 8000
    expected = stored("calculix_refined.csv")[f"{name} C3D20R"][6:36]
    found = eigenmodes(model, 36)[0][6:]
    np.testing.assert_allclose(found, expected, rtol=8e-3)
    np.testing.assert_allclose(found[:10], expected[:10], rtol=3.5e-3)


@needs_ccx
@pytest.mark.parametrize("element", POINTS)
@pytest.mark.parametrize(
    "mirror",
    [
        CircularMirror(core=1, rings=2, focal_length=0.5),
        HexagonalSegment(divisions=2, parent_radius=2.0, layers=2, mount_radius=0.4),
    ],
    ids=["circular", "hexagonal"],
)
def test_curved_meshes_agree_with_calculix(mirror, element, tmp_path):
    calculix_oracle.ccx(tmp_path, mirror, element)
    mesh = mirror_mesh(mirror)
    points = POINTS[element]
    # The deck has 13 digits of each coordinate.
    nodes = np.array([[float(f"{value:.12e}") for value in node] for node in mesh.nodes])
    mass, stiffness = assemble(nodes, mesh.elements, mirror.material, points, points)
    places = [f"{node}.{direction}" for node in range(1, len(nodes) + 1) for direction in (1, 2, 3)]
    assert (tmp_path / "job.dof").read_text().split() == places
    assert_equal_as_printed(stiffness.toarray(), read_matrix(tmp_path / "job.sti", 3 * len(nodes)))
    assert_equal_as_printed(mass.toarray(), read_matrix(tmp_path / "job.mas", 3 * len(nodes)))


@needs_ccx
def test_calculix_finds_our_frequencies(tmp_path):
    mirror = CircularMirror(core=2, rings=2)
    calculix_oracle.ccx(tmp_path, mirror, "C3D20R", 20)
    expected = [float(word) for word in calculix_oracle.frequencies((tmp_path / "job.dat").read_text())]
    np.testing.assert_allclose(elastic_frequencies(mirror, 2, 20), expected[6:], rtol=6e-7)


def test_a_deck_holds_the_mesh(tmp_path):
    mirror = CircularMirror(core=1, rings=2)
    mesh = mirror_mesh(mirror)
    path = tmp_path / "mirror.inp"
    write_deck(path, mesh, mirror.material, node_sets={"RIM": np.array([4, 2])})
    blocks = re.split(r"^\*", path.read_text(), flags=re.MULTILINE)
    bodies = {block.partition("\n")[0]: block.partition("\n")[2] for block in blocks}

    def numbers(name):
        return np.array([float(word) for word in bodies[name].replace(",", " ").split()])

    nodes = numbers("NODE, NSET=ALL").reshape(-1, 4)
    np.testing.assert_array_equal(nodes[:, 0], np.arange(1, len(mesh.nodes) + 1))
    np.testing.assert_allclose(nodes[:, 1:], mesh.nodes, rtol=1e-12, atol=1e-15)
    elements = numbers("ELEMENT, TYPE=C3D20R, ELSET=BODY").reshape(-1, 21)
    np.testing.assert_array_equal(elements[:, 1:], mesh.elements + 1)
    np.testing.assert_array_equal(numbers("NSET, NSET=INTERFACES"), mesh.mounts + 1)
    np.testing.assert_array_equal(numbers("NSET, NSET=SURFACE"), mesh.front_nodes + 1)
    np.testing.assert_array_equal(numbers("NSET, NSET=RIM"), [5, 3])
    np.testing.assert_array_equal(numbers("ELASTIC"), [70e9, 0.33])
    assert max(map(len, path.read_text().splitlines())) <= 132


def test_an_unknown_element_is_refused(tmp_path):
    mirror = CircularMirror(core=1, rings=2)
    with pytest.raises(UserError, match=r"'C3D8' is not known; use C3D20 or C3D20R"):
        write_deck(tmp_path / "a.inp", mirror_mesh(mirror), mirror.material, "C3D8")
