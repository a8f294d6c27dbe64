"""Pads of nodes as interfaces, against solutions with Lagrange multipliers and distributed loads."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from wavequake.errors import UserError
from wavequake.mechanics.importers import import_model
from wavequake.mechanics.importers.areas import area_shares
from wavequake.mechanics.importers.mesh import read_mesh
from wavequake.mechanics.model import check_model, places, rigid_modes
from wavequake.mechanics.vibration.eigen import eigenmodes, rigid_motions
from wavequake.reduction.metrics import receptance
from wavequake.reduction.reduce import reduce

DATA = Path(__file__).parents[1] / "data"
PADS = ("PAD1", "PAD2", "PAD3")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The block of six tetrahedra on three pads of its lower face (two of three nodes, one of two)."""
    folder = tmp_path_factory.mktemp("pads")
    deck = (DATA / "tetrahedra.inp").read_text()
    sets = "*NSET, NSET=PAD1\n10, 40, 100\n*NSET, NSET=PAD2\n70, 160, 130\n*NSET, NSET=PAD3\n220, 250\n"
    (folder / "block.inp").write_text(deck.replace("*MATERIAL", sets + "*MATERIAL", 1))
    for ending in ("sti", "mas", "dof"):
        (folder / f"block.{ending}").write_text((DATA / f"tetrahedra.{ending}").read_text())
    return folder / "block.sti"


def load(files, interfaces=PADS, surface="TOP", **more):
    return import_model(files, units="m,kg,s,N", interfaces=interfaces, surface=surface, **more)


def pad_nodes(files, name):
    mesh = read_mesh(files.with_suffix(".inp"))
    return np.searchsorted(mesh.labels, mesh.sets[name]), mesh


def test_the_mean_of_a_pad_is_driven_by_a_load_spread_over_it(files):
    plain, averaged = load(files).model, load(files, pads="average").model
    assert averaged.order == plain.order
    assert averaged.inputs.shape[1] == 9
    check_model(averaged)
    weights = np.zeros((plain.order, 9))
    for k, name in enumerate(PADS):
        nodes, mesh = pad_nodes(files, name)
        shares = area_shares(mesh, nodes) if len(nodes) > 2 else np.full(len(nodes), 1 / len(nodes))
        weights[places(plain)[nodes, :3], 3 * k + np.arange(3)] = shares[:, None]
        assert_allclose(averaged.nodes[averaged.interfaces[k]], shares @ plain.nodes[nodes], rtol=1e-14)
    shift = (2 * np.pi * 800.0) ** 2
    exact, found = (
        b.T @ np.linalg.solve((m.stiffness - shift * m.mass).toarray(), b)
        for m, b in ((plain, weights), (averaged, averaged.inputs.toarray()))
    )
    assert_allclose(found, exact, rtol=0, atol=1e-9 * np.abs(exact).max())
    seen, moved = (
        m.surface @ np.linalg.solve((m.stiffness - shift * m.mass).toarray(), b)
        for m, b in ((plain, weights), (averaged, averaged.inputs.toarray()))
    )
    assert_allclose(moved, seen, rtol=0, atol=1e-9 * np.abs(seen).max())
    assert_allclose(eigenmodes(averaged, 12)[0], eigenmodes(plain, 12)[0], rtol=1e-7)


def test_a_rigid_pad_is_a_constraint(files):
    """The same by Lagrange multipliers: nodes follow displacement and rotation of a massless point."""
    choice = ("PAD1", "PAD2", 220)
    plain, rigid = load(files, choice).model, load(files, choice, pads="rigid").model
    assert rigid.order == plain.order - 2 * 9 + 2 * 6
    assert rigid.inputs.shape[1] == 9
    shift = (2 * np.pi * 800.0) ** 2
    dynamic = (plain.stiffness - shift * plain.mass).toarray()
    size, constraints = plain.order, []
    for k, name in enumerate(("PAD1", "PAD2")):
        nodes, _ = pad_nodes(files, name)
        follow = rigid_modes(plain.nodes[nodes], rigid.nodes[rigid.interfaces[k]])
        rows = np.zeros((9, size + 12))
        rows[np.arange(9), places(plain)[nodes, :3].ravel()] = 1.0
        rows[:, size + 6 * k : size + 6 * k + 6] = -follow
        constraints.append(rows)
    held = np.vstack(constraints)
    system = np.block(
        [[np.pad(dynamic, ((0, 12), (0, 12))), held.T], [held, np.zeros((len(held), len(held)))]]
    )
    loads = np.zeros((len(system), 9))
    for column, row in enumerate([size, size + 1, size + 2, size + 6, size + 7, size + 8]):
        loads[row, column] = 1.0
    loads[places(plain)[np.searchsorted(pad_nodes(files, "PAD1")[1].labels, 220), :3], [6, 7, 8]] = 1.0
    exact = loads.T @ np.linalg.solve(system, loads)
    inputs = rigid.inputs.toarray()
    found = inputs.T @ np.linalg.solve((rigid.stiffness - shift * rigid.mass).toarray(), inputs)
    assert_allclose(found, exact, rtol=0, atol=1e-8 * np.abs(exact).max())


@pytest.mark.parametrize("pads", ["average", "rigid"])
def test_models_on_pads_are_free_and_reduced_as_any(pads, files):
    model = load(files, PADS if pads == "average" else ("PAD1", "PAD2", 220), pads=pads).model
    strain = model.stiffness @ rigid_motions(model, model.nodes.mean(axis=0))
    assert np.abs(strain).max() < 1e-8 * np.abs(model.stiffness).max()
    reduced = reduce(model, "craigb24")
    inputs = model.inputs.toarray()
    omega = 2 * np.pi * 400.0
    dynamic = model.stiffness * (1 + 5e-6j * omega) - omega**2 * model.mass
    exact = inputs.T @ np.linalg.solve(dynamic.toarray(), inputs)
    assert_allclose(receptance(reduced, [400.0])[0], exact, atol=1e-2 * np.abs(exact).max())


@pytest.mark.parametrize(
    ("choice", "match"),
    [
        ({"interfaces": ("PAD1", "PAD1", "PAD2"), "pads": "average"}, "node 10 is in two pads"),
        ({"interfaces": PADS, "pads": "rigid"}, "the pad of node 220 spans no area"),
        (
            {"interfaces": ("PAD1", "PAD2", "TOP"), "pads": "average"},
            "all nodes of the pad of node 30",
        ),
        (
            {"interfaces": PADS[:2], "surface": ["TOP", 10], "pads": "rigid"},
            "node 10 of a rigid pad",
        ),
    ],
)
def test_impossible_pads(choice, match, files):
    with pytest.raises(UserError, match=match):
        load(files, **choice)
