"""Pads of nodes as interfaces, against solutions with Lagrange multipliers and distributed loads."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy
from numpy.testing import assert_allclose

from wavequake.errors import UserError
from wavequake.mechanics.assembly.bodies import placed
from wavequake.mechanics.assembly.links import End, Link
from wavequake.mechanics.assembly.plant import plant
from wavequake.mechanics.importers import import_model
from wavequake.mechanics.importers.areas import area_shares
from wavequake.mechanics.importers.mesh import MeshFile, read_mesh
from wavequake.mechanics.importers.pads import with_pads
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.mechanics.model import check_model, places, rigid_modes
from wavequake.mechanics.vibration.eigen import eigenmodes, rigid_motions
from wavequake.mechanics.vibration.modal import dense
from wavequake.reduction.intermediate import intermediate
from wavequake.reduction.metrics import receptance
from wavequake.reduction.reduce import reduce
from wavequake.reduction.two_stage import reduce_variants, reference

DATA = Path(__file__).parents[1] / "data"
PADS = ("PAD1", "PAD2", "PAD3")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The block of six tetrahedra on three pads of its lower face (two of three nodes, one of two)."""
    folder = tmp_path_factory.mktemp("pads")
    deck = (DATA / "tetrahedra.inp").read_text()
    sets = "*NSET, NSET=PAD1\n10, 40, 100\n*NSET, NSET=PAD2\n70, 160, 130\n*NSET, NSET=PAD3\n220, 250\n"
    sets += "*NSET, NSET=SIDE\n220, 250, 260\n"
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


TURNING = ("PAD1", "PAD2", "SIDE")


@pytest.mark.parametrize("pads", ["average", "rigid"])
def test_six_inputs_of_a_pad_see_rigid_motions_as_they_are(pads, files):
    model = load(files, TURNING, pads=pads, pad_dofs=6).model
    assert model.inputs.shape == (model.order, 18)
    assert model.turns.tolist() == [3, 4, 5]
    centers, origin = model.nodes[model.interfaces[:3]], np.array([0.1, -0.2, 0.3])
    seen = model.inputs.T @ rigid_motions(model, origin)
    assert_allclose(seen[:9], rigid_modes(centers, origin), atol=1e-12)
    turned = np.tile(np.hstack([np.zeros((3, 3)), np.eye(3)]), (3, 1))
    assert_allclose(seen[9:], turned, atol=1e-12)


def condensed(stiffness, kept):
    """Static stiffness (Guyan) of the coordinates that are kept, all others without loads."""
    rest = np.setdiff1d(np.arange(len(stiffness)), kept)
    inner = np.linalg.solve(stiffness[np.ix_(rest, rest)], stiffness[np.ix_(rest, kept)])
    return stiffness[np.ix_(kept, kept)] - stiffness[np.ix_(kept, rest)] @ inner


def test_stiffness_of_rigid_pads_is_the_reaction_to_their_prescribed_motion(files):
    """The full model, its nodes held to the 18 motions by Lagrange multipliers: these are the reactions."""
    plain, rigid = load(files, TURNING).model, load(files, TURNING, pads="rigid", pad_dofs=6).model
    rows, follow = [], []
    for k, name in enumerate(TURNING):
        nodes, _ = pad_nodes(files, name)
        rows.append(places(plain)[nodes, :3].ravel())
        moved = rigid_modes(plain.nodes[nodes], rigid.nodes[rigid.interfaces[k]])
        part = np.zeros((len(moved), 18))
        part[:, 3 * k : 3 * k + 3], part[:, 9 + 3 * k : 12 + 3 * k] = moved[:, :3], moved[:, 3:]
        follow.append(part)
    held, follow = np.eye(plain.order)[np.concatenate(rows)], np.vstack(follow)
    system = np.block([[plain.stiffness.toarray(), held.T], [held, np.zeros((len(held), len(held)))]])
    loads = np.vstack([np.zeros((plain.order, 18)), follow])
    exact = -follow.T @ np.linalg.solve(system, loads)[plain.order :]
    assert np.linalg.matrix_rank(exact, tol=1e-9 * np.abs(exact).max()) == 12
    interface = np.argmax(rigid.inputs.toarray(), axis=0)
    found = condensed(rigid.stiffness.toarray(), interface)
    assert_allclose(found, exact, rtol=0, atol=1e-9 * np.abs(exact).max())


def test_forces_of_a_moment_on_an_average_pad(files):
    """Its nodes carry f = share (J^-1 moment) x arm, J the shares' moments of inertia about the center."""
    plain = load(files, TURNING).model
    averaged = load(files, TURNING, pads="average", pad_dofs=6).model
    weights = np.zeros((plain.order, 18))
    for k, name in enumerate(TURNING):
        nodes, mesh = pad_nodes(files, name)
        shares, at = area_shares(mesh, nodes), places(plain)[nodes, :3]
        arms = plain.nodes[nodes] - shares @ plain.nodes[nodes]
        inertia = sum(w * (r @ r * np.eye(3) - np.outer(r, r)) for w, r in zip(shares, arms, strict=True))
        weights[at, 3 * k + np.arange(3)] = shares[:, None]
        for axis in range(3):
            turn = np.linalg.solve(inertia, np.eye(3)[axis])
            weights[at, 9 + 3 * k + axis] = shares[:, None] * np.cross(turn, arms)
    shift = (2 * np.pi * 800.0) ** 2
    exact, found = (
        np.vstack([b.T, m.surface.toarray()]) @ np.linalg.solve((m.stiffness - shift * m.mass).toarray(), b)
        for m, b in ((plain, weights), (averaged, averaged.inputs.toarray()))
    )
    assert_allclose(found, exact, rtol=0, atol=1e-9 * np.abs(exact).max())


@pytest.fixture(scope="module")
def disc():
    """A mirror of hexahedra on three rigid pads of six nodes about its mounts, with 18 inputs."""
    model = circular_mirror(CircularMirror(core=2, rings=2))
    grid = MeshFile("disc", np.arange(1, len(model.nodes) + 1), model.nodes)
    away = np.linalg.norm(model.nodes[model.interfaces][:, None] - model.nodes, axis=2)
    away[:, model.surface_nodes] = np.inf
    return with_pads(model, grid, np.argsort(away, axis=1, kind="stable")[:, :6], "rigid", 6)


@pytest.mark.parametrize("name", ["craigb54", "krylov54(0,500)", "rubin54"])
def test_reduced_models_take_moments_on_pads(name, disc):
    stage = intermediate(disc, highest=1000.0)
    omega = 2 * np.pi * 200.0

    def answer(model):
        dynamic = model.stiffness + 1j * omega * model.damping_matrix - omega**2 * model.mass
        return dense(model.inputs).T @ np.linalg.solve(as_array(dynamic), dense(model.inputs))

    exact = answer(disc)
    forces = receptance(reference(stage), [200.0])[0]  # displacements per force, so that all have one unit
    assert_allclose(forces, exact[:9, :9], rtol=0, atol=1e-8 * np.abs(exact[:9, :9]).max())
    for reduced in (reduce(disc, name), reduce_variants(stage, [name], disc)[0]):
        assert reduced.turns.tolist() == [3, 4, 5]
        found = answer(reduced)
        for block in np.ndindex(2, 2):  # forces and moments, displacements and rotations: of one unit each
            mine = tuple(slice(9 * place, 9 * place + 9) for place in block)
            assert_allclose(found[mine], exact[mine], rtol=0, atol=1e-3 * np.abs(exact[mine]).max())


def as_array(matrix):
    return matrix.toarray() if hasattr(matrix, "toarray") else matrix


def test_a_body_welded_to_the_ground_at_pads_does_not_turn_there(files):
    """Rigid connections hold three displacements and three rotations of every pad."""
    model = load(files, TURNING, pads="rigid", pad_dofs=6).model
    interface = np.argmax(model.inputs.toarray(), axis=0)
    inner = np.setdiff1d(np.arange(model.order), interface)
    stiffness, mass = (m.toarray()[np.ix_(inner, inner)] for m in (model.stiffness, model.mass))
    squared = 1.0 / scipy.linalg.eigh(mass, stiffness, eigvals_only=True)[::-1]
    reduced = reduce(model, "craigb48")
    names = {str(k + 1): k for k in range(3)}
    body = placed("mirror", reduced, names, turns={name: k + 3 for name, k in names.items()})
    ground = {name: model.nodes[model.interfaces[k]] for name, k in names.items()}
    welds = [Link(name, "rigid", End("mirror", name), End("ground", name)) for name in names]
    held = plant([body], welds, ground)
    assert_allclose(held.omega[:5], np.sqrt(squared[:5]), rtol=1e-6)
    assert held.places["mirror.1"][1] is not None
    hinged = plant(
        [replace(body, nodes={k: replace(n, turns=None) for k, n in body.nodes.items()})], welds, ground
    )
    assert hinged.omega[0] < 0.9 * held.omega[0]


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
        ({"interfaces": PADS, "pads": "average", "pad_dofs": 6}, "the pad of node 220 spans no area"),
        ({"interfaces": ("PAD1", 220), "pads": "rigid", "pad_dofs": 6}, "node 220 is this node alone"),
        ({"pad_dofs": 6}, "pad_dofs = 6 is of pads"),
        (
            {"interfaces": TURNING, "surface": ["TOP", 10, 40], "pads": "average", "pad_dofs": 6},
            "too many nodes of the pad of node 10",
        ),
    ],
)
def test_impossible_pads(choice, match, files):
    with pytest.raises(UserError, match=match):
        load(files, **choice)


def test_two_pads_hold_a_body_where_they_do_not_turn(files):
    """About the line through them it turns freely if their displacements alone stand still."""
    free, held = (load(files, TURNING[:2], pads="rigid", pad_dofs=dofs).model for dofs in (3, 6))
    with pytest.raises(UserError, match="the 2 interface nodes of the model block lie on a line"):
        check_model(free)
    check_model(held)
    for model, count in ((free, 1), (held, 0)):
        moves = np.setdiff1d(np.arange(model.order), model.inputs.tocoo().row)
        stiff = scipy.linalg.eigvalsh(model.stiffness.toarray()[np.ix_(moves, moves)])
        assert (stiff < 1e-9 * stiff[-1]).sum() == count
