"""What CalculiX writes of quadratic tetrahedra, shells, beams and cyclic symmetry, and singular masses."""

import csv
import shutil
from dataclasses import replace
from pathlib import Path

import calculix_decks
import numpy as np
import pytest
import scipy.linalg
import tetrahedron
from numpy.testing import assert_allclose
from scipy.sparse import csc_array

from wavequake.errors import UserError
from wavequake.mechanics.importers import import_model
from wavequake.mechanics.importers import model as importer
from wavequake.mechanics.model import rigid_modes, selection
from wavequake.mechanics.vibration.eigen import dense_modes, eigenmodes, mass_normalized_rigid_modes
from wavequake.reduction.metrics import receptance
from wavequake.reduction.reduce import reduce
from wavequake.workflows.mirrors.imported_facts import total_mass

DATA = Path(__file__).parents[1] / "data"
needs_ccx = pytest.mark.skipif(
    shutil.which("ccx") is None, reason="ccx is not installed (Debian package calculix-ccx)"
)


def raw(path):
    """Both matrices as the files have them, by a reader of three lines."""
    found = []
    for ending in (".sti", ".mas"):
        rows, columns, values = np.loadtxt(path.with_suffix(ending)).T
        upper = np.zeros((int(rows.max()),) * 2)
        upper[rows.astype(int) - 1, columns.astype(int) - 1] = values
        found.append(upper + np.triu(upper, 1).T)
    return found


@pytest.fixture(scope="module")
def block():
    return import_model(DATA / "tetrahedra.sti", units="m,kg,s,N", interfaces=[10, 70, 190], surface="TOP")


def test_quadratic_tetrahedra_have_the_frequencies_that_calculix_prints(block):
    _, mass = raw(DATA / "tetrahedra.sti")
    spectrum = np.linalg.eigvalsh(mass)
    assert np.sum(spectrum < 1e-12 * spectrum[-1]) >= 3  # a null vector per direction at least
    assert len(block.notes) == 1
    assert "tetrahedra.mas is singular" in block.notes[0]
    with open(DATA / "tetrahedra_frequencies.csv") as file:
        printed = np.array([float(row["frequency_Hz"]) for row in csv.DictReader(file)])
    found, _ = eigenmodes(block.model, 16)
    assert np.all(found[:6] == 0.0)
    assert_allclose(found[6:], printed[6:], rtol=5e-7)  # 7 digits


@pytest.mark.parametrize("variant", ["craigb18", "rubin24", "krylov27(300)"])
def test_reduced_models_of_singular_masses_are_definite_and_right(block, variant):
    reduced = reduce(block.model, variant)
    assert np.linalg.eigvalsh(reduced.mass)[0] > 0.0
    stiffness, mass = raw(DATA / "tetrahedra.sti")
    held = block.model.inputs.toarray()
    shift = 2 * np.pi * 300.0
    exact = held.T @ np.linalg.solve(stiffness * (1 + 5e-6j * shift) - shift**2 * mass, held)
    assert_allclose(receptance(reduced, [300.0])[0], exact, atol=2e-3 * np.abs(exact).max())


def test_shells_move_by_the_mean_of_their_nodes():
    imported = import_model(DATA / "shell.sti", units="m,kg,s,N", interfaces=[1, 2, 3], surface=[1, 2, 3, 4])
    model = imported.model
    assert any("8 nodes of beams or shells" in note for note in imported.notes)
    stiffness, mass = raw(DATA / "shell.sti")
    elastic = scipy.linalg.eigh(stiffness + 1e9 * mass, mass, eigvals_only=True)[6:12] - 1e9
    rigid = mass_normalized_rigid_modes(model)
    assert rigid.shape[1] == 6
    assert_allclose(eigenmodes(model, 12)[0][6:], np.sqrt(elastic) / (2 * np.pi), rtol=1e-6)
    # The middle of the shell moves as a rigid plane does, though its inner coordinates have no place.
    nodes = np.arange(8)
    moved = selection(model, nodes) @ rigid
    motions = rigid_modes(model.nodes[nodes], np.zeros(3))
    left = moved - motions @ np.linalg.lstsq(motions, moved)[0]
    assert np.abs(left).max() < 1e-9 * np.abs(moved).max()
    area = 0.4 * np.hypot(0.3, 0.05)
    assert total_mass(model) == pytest.approx(2700.0 * area * 0.02, rel=1e-9)


@needs_ccx
@pytest.mark.parametrize("name", ["BEAM", "CLAMPED_SHELL"])
def test_beams_and_shells_have_the_frequencies_that_calculix_prints(name, tmp_path, monkeypatch):
    deck = getattr(calculix_decks, name)
    calculix_decks.run(tmp_path, deck)
    chosen = [2, 3, 4] if name == "BEAM" else [2, 3, 6]
    monkeypatch.setattr(importer, "area_shares", lambda grid, nodes: np.ones(len(nodes)) / len(nodes))
    model = import_model(tmp_path / "job.sti", units="m,kg,s,N", interfaces=chosen, surface=chosen).model
    calculix_decks.run(tmp_path, deck, 6)
    printed = np.array([float(word) for word in calculix_decks.frequencies(tmp_path)])
    assert_allclose(eigenmodes(model, 6)[0], printed, rtol=2e-6)


def test_a_node_of_a_shell_that_a_support_has_taken_is_refused(tmp_path):
    for ending in ("sti", "mas", "inp"):
        shutil.copy(DATA / f"shell.{ending}", tmp_path)
    rows = (DATA / "shell.dof").read_text().splitlines()
    rows[0], rows[1] = rows[1], rows[0]  # no x, y, z in a row: constraints have been at work
    (tmp_path / "shell.dof").write_text("\n".join(rows) + "\n")
    choice = {"units": "m,kg,s,N", "surface": [2, 3, 4]}
    imported = import_model(tmp_path / "shell.sti", interfaces=[2, 3, 4], **choice)
    assert any("unknown at node 1)" in note for note in imported.notes)
    with pytest.raises(UserError, match="node 1 of interfaces"):
        import_model(tmp_path / "shell.sti", interfaces=[1, 2, 3], **choice)


K, M = tetrahedron.matrices()


@pytest.mark.parametrize("coupling", [0.0, 1.0])
def test_cyclic_symmetry_is_read_where_neighbors_move_alike(coupling, tmp_path):
    tetrahedron.write_deck(tmp_path / "truss.inp")
    tetrahedron.write_dofs(tmp_path / "truss.dof")
    phase = np.zeros((12, 12))
    phase[0, 4], phase[4, 0] = 1e3 * coupling, -1e3 * coupling
    for name, part, turned in (("sti", K, phase), ("mas", M, 0 * phase)):
        tetrahedron.write_triangle(tmp_path / f"truss.{name}", np.block([[part, -turned], [turned, part]]))
    choice = {"units": "m,kg,s,N", "interfaces": "MOUNTS", "surface": "MIRROR"}
    if coupling:
        with pytest.raises(UserError, match=r"move with a phase .* write the matrices of the whole body"):
            import_model(tmp_path / "truss.sti", **choice)
        return
    imported = import_model(tmp_path / "truss.sti", **choice)
    assert_allclose(imported.model.stiffness.toarray(), K, rtol=1e-15, atol=0)
    assert "nodal diameter 0" in imported.notes[0]


def test_modes_of_a_singular_mass_are_those_of_the_condensed_one():
    rng = np.random.default_rng(1)
    root = rng.standard_normal((9, 9))
    stiffness = root @ root.T + np.eye(9)
    mass = np.diag([1.0, 2.0, 0.0, 3.0, 0.0, 1.5, 1.0, 0.0, 2.0])
    heavy, light = np.flatnonzero(mass.diagonal()), np.flatnonzero(mass.diagonal() == 0)
    part = np.linalg.solve(stiffness[np.ix_(light, light)], stiffness[np.ix_(light, heavy)])
    condensed = stiffness[np.ix_(heavy, heavy)] - stiffness[np.ix_(heavy, light)] @ part
    wanted = scipy.linalg.eigh(condensed, mass[np.ix_(heavy, heavy)], eigvals_only=True)
    squared, modes = dense_modes(stiffness, mass)
    assert_allclose(squared[:6], wanted, rtol=1e-10)
    assert squared[6] > 1e9 * wanted[-1]
    flexibility = modes @ np.diag(1.0 / squared) @ modes.T
    assert_allclose(flexibility, np.linalg.inv(stiffness), rtol=1e-9)


def beam(count, length):
    """A free Euler-Bernoulli beam along x (100 N m^2 in both planes, 0.5 kg/m), SI units."""
    step = length / count
    bending = (
        100.0
        / step**3
        * np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]], dtype=float)
    )
    inertia = (
        0.5
        * step
        / 420
        * np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]], dtype=float)
    )
    turns = np.array([1.0, step, 1.0, step])
    rod, size = np.array([[1.0, -1.0], [-1.0, 1.0]]), 6 * (count + 1)
    K, M = np.zeros((size, size)), np.zeros((size, size))
    for first in range(0, 6 * count, 6):
        for rows, sign in (([1, 5, 7, 11], 1.0), ([2, 4, 8, 10], -1.0)):
            signs = turns * np.array([1.0, sign, 1.0, sign])
            place = np.ix_(first + np.array(rows), first + np.array(rows))
            K[place] += bending * np.outer(signs, signs)
            M[place] += inertia * np.outer(signs, signs)
        for rows, k, m in (([0, 6], 1e6 / step, 0.5 * step), ([3, 9], 5e3 / step, 1e-3 * step)):
            place = np.ix_(first + np.array(rows), first + np.array(rows))
            K[place] += k * rod
            M[place] += m / 6 * np.array([[2.0, 1.0], [1.0, 2.0]])
    return K, M


@pytest.mark.parametrize(("units", "unit"), [("m,kg,s,N", 1.0), ("mm,t,s,N", 1e-3)])
def test_rotations_of_beams_are_degrees_of_freedom(units, unit, tmp_path):
    """A free beam: beta l = 4.7300, 7.8532, 10.9956 (Blevins 1979), twice each."""
    count, length = 40, 1.2
    stiffness, mass = beam(count, length)
    scale = np.tile([unit] * 3 + [1.0] * 3, count + 1)
    spread = np.outer(scale, scale)
    points = np.zeros((count + 1, 3))
    points[:, 0] = np.linspace(0.0, length, count + 1)
    points[1, 1] = 1e-9  # no lines: a surface needs three corners
    energy = unit if units.startswith("mm") else 1.0  # N mm; and t mm^2/s^2 is the same
    np.savez(
        tmp_path / "beam.npz",
        stiffness=stiffness * spread / energy,
        mass=mass * spread / energy,
        dofs=[(node, direction) for node in range(1, count + 2) for direction in range(1, 7)],
        nodes=points / unit,
    )
    model = import_model(tmp_path / "beam.npz", units=units, interfaces=[1, 2, 41], surface=[1, 2, 41]).model
    found = eigenmodes(model, 12)[0]
    wanted = np.repeat([4.730041, 7.853205, 10.995608], 2) ** 2 / length**2 * np.sqrt(100.0 / 0.5)
    assert np.all(found[:6] == 0.0)
    assert_allclose(found[6:], wanted / (2 * np.pi), rtol=2e-5)
    assert_allclose(model.stiffness.toarray(), stiffness, rtol=1e-9, atol=1e-6)
    assert total_mass(model) == pytest.approx(0.6, rel=1e-9)
    # Without the inertia of their rotations lumped beams are a little off, but no mode is lost.
    bends = model.dof_direction >= 4
    lumped = model.mass.toarray()
    lumped[bends] = lumped[:, bends] = 0.0
    assert_allclose(eigenmodes(replace(model, mass=csc_array(lumped)), 10)[0][6:], found[6:10], rtol=1e-2)


def test_a_motion_without_mass_and_stiffness_is_refused(tmp_path):
    """The beam turns about its axis freely: without the inertia of rotations nothing resists."""
    stiffness, mass = beam(20, 1.2)
    turns = np.tile(np.arange(6) >= 3, 21)
    mass[turns] = mass[:, turns] = 0.0
    points = np.zeros((21, 3))
    points[:, 0] = np.linspace(0.0, 1.2, 21)
    np.savez(
        tmp_path / "beam.npz",
        stiffness=stiffness,
        mass=mass,
        dofs=[(node, direction) for node in range(1, 22) for direction in range(1, 7)],
        nodes=points,
    )
    with pytest.raises(UserError, match=r"singular together: .* direction 4 has neither mass nor"):
        import_model(tmp_path / "beam.npz", units="m,kg,s,N", interfaces=[1, 2, 3], surface=[1, 2, 3])
