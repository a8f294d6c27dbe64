import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavequake.errors import UserError
from wavequake.mechanics.mirrors.hexahedra import (
    BOTTOM,
    CORNERS,
    EDGES,
    NATURAL,
    TOP,
    assemble,
    gauss_points,
    lumped_areas,
    mass_matrices,
    serendipity,
    stiffness_matrices,
)
from wavequake.mechanics.mirrors.material import ALUMINUM, Material
from wavequake.mechanics.mirrors.models import CircularMirror, mirror_mesh
from wavequake.mechanics.model import rigid_modes

ONE = np.arange(20)[None]
EDGE_ENDS = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]


def straight_edges(corners):
    """The 20 nodes of a hexahedron with straight edges."""
    return np.vstack([corners, [(corners[a] + corners[b]) / 2 for a, b in EDGE_ENDS]])


def parallelepiped(spans):
    return NATURAL @ (np.asarray(spans) / 2)


def box_of_bricks(counts, move):
    """Nodes, elements and inner nodes of a unit cube of bricks whose inner corners `move` displaces."""
    axes = [np.linspace(0, 1, count + 1) for count in counts]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    inner = np.zeros(grid.shape[:3], dtype=bool)
    inner[1:-1, 1:-1, 1:-1] = True
    grid = grid + np.where(inner[..., None], move(grid), 0.0)
    offsets = ((NATURAL[:8] + 1) / 2).astype(int)
    starts = np.argwhere(np.ones(counts, dtype=bool))
    blocks = np.concatenate([straight_edges(grid[tuple((start + offsets).T)]) for start in starts])
    nodes, places = np.unique(np.round(blocks, 12), axis=0, return_inverse=True)
    elements = places.reshape(-1, 20)
    on_face = ((nodes < 1e-9) | (nodes > 1 - 1e-9)).any(axis=1)
    return nodes, elements, np.flatnonzero(~on_face)


def isotropic(material):
    """Elasticity matrix for xx, yy, zz and the shear strains yz, xz, xy, from its inverse."""
    compliance = np.zeros((6, 6))
    compliance[:3, :3] = -material.poisson
    compliance[range(3), range(3)] = 1.0
    compliance[range(3, 6), range(3, 6)] = 2 * (1 + material.poisson)
    return np.linalg.inv(compliance / material.young)


@pytest.mark.parametrize("natural", [NATURAL, np.concatenate([CORNERS, EDGES])], ids=["cube", "square"])
def test_shape_functions_are_one_at_their_node_and_zero_at_others(natural):
    values, _ = serendipity(natural, natural)
    np.testing.assert_allclose(values, np.eye(len(natural)), rtol=0, atol=1e-15)


@pytest.mark.parametrize("natural", [NATURAL, np.concatenate([CORNERS, EDGES])], ids=["cube", "square"])
def test_shape_functions_reproduce_quadratics_and_their_gradients(natural):
    random = np.random.default_rng(1)
    dimensions = natural.shape[1]
    square = random.normal(size=(dimensions, dimensions))
    points = random.uniform(-1, 1, (30, dimensions))

    def field(x):
        return 2 + x @ square[0] + np.einsum("gi,ij,gj->g", x, square, x)

    values, gradients = serendipity(natural, points)
    np.testing.assert_allclose(values @ field(natural), field(points), rtol=0, atol=1e-14)
    expected = square[0] + points @ (square + square.T)
    np.testing.assert_allclose(
        np.einsum("gkd,k->gd", gradients, field(natural)), expected, rtol=0, atol=1e-13
    )


def test_the_faces_are_where_their_names_say():
    assert (NATURAL[BOTTOM, 2] == -1).all()
    assert (NATURAL[TOP, 2] == 1).all()
    np.testing.assert_array_equal(NATURAL[BOTTOM, :2], NATURAL[TOP, :2])
    np.testing.assert_array_equal(NATURAL[TOP, :2], np.concatenate([CORNERS, EDGES]))


@pytest.mark.parametrize(("per_axis", "degree"), [(2, 3), (3, 5)])
def test_gauss_points_integrate_their_degree(per_axis, degree):
    points, weights = gauss_points(per_axis, 3)
    for power in range(degree + 1):
        exact = 8 / (power + 1) if power % 2 == 0 else 0.0
        assert weights @ points[:, 1] ** power == pytest.approx(exact, abs=1e-14)


# Two points per axis are exact for parallelepipeds only, three for all bricks with straight edges.
@pytest.mark.parametrize(("per_axis", "amplitude"), [(2, 0.0), (3, 0.12)])
def test_patch_test(per_axis, amplitude):
    """Constant strain: no force at inner nodes, and the exact energy."""
    shear = np.array([[1.0, 0.2, 0.1], [0.0, 1.1, -0.3], [0.2, 0.0, 0.9]])
    nodes, elements, inner = box_of_bricks(
        (3, 3, 3), lambda x: amplitude * np.sin(7 * x + 3 * np.roll(x, 1, axis=-1))
    )
    nodes = nodes @ shear
    gradient = np.random.default_rng(2).normal(size=(3, 3))
    displacement = (nodes @ gradient.T).ravel()
    _, stiffness = assemble(nodes, elements, ALUMINUM, per_axis)
    forces = stiffness @ displacement
    strain = (gradient + gradient.T) / 2
    voigt = np.array([*np.diag(strain), 2 * strain[1, 2], 2 * strain[0, 2], 2 * strain[0, 1]])
    stress = isotropic(ALUMINUM) @ voigt
    np.testing.assert_allclose(forces.reshape(-1, 3)[inner], 0, rtol=0, atol=1e-13 * np.abs(forces).max())
    volume = abs(np.linalg.det(shear))
    assert displacement @ forces == pytest.approx(volume * voigt @ stress, rel=1e-12)


def test_rigid_motions_of_curved_elements_cost_no_energy():
    mesh = mirror_mesh(CircularMirror(core=1, rings=2, focal_length=0.6))
    _, stiffness = assemble(mesh.nodes, mesh.elements, ALUMINUM)
    motions = rigid_modes(mesh.nodes, np.array([0.1, -0.2, 0.3]))
    terms = abs(stiffness) @ np.abs(motions)
    assert np.abs(stiffness @ motions).max() < 1e-14 * terms.max()


def test_only_rigid_motions_of_a_mesh_cost_no_energy():
    """Reduced integration has no soft modes beyond a single element; the mass matrix is not singular."""
    mesh = mirror_mesh(CircularMirror(core=1, rings=2))
    mass, stiffness = (matrix.toarray() for matrix in assemble(mesh.nodes, mesh.elements, ALUMINUM))
    energies = np.linalg.eigvalsh(stiffness)
    assert (energies > -1e-14 * energies[-1]).all()
    assert (np.abs(energies) < 1e-12 * energies[-1]).sum() == 6
    masses = np.linalg.eigvalsh(mass)
    assert masses[0] > 1e-3 * masses[-1]


def test_matrices_are_symmetric_to_the_last_bit():
    mesh = mirror_mesh(CircularMirror(core=2, rings=2))
    for matrix in assemble(mesh.nodes, mesh.elements, ALUMINUM):
        assert abs(matrix - matrix.T).max() == 0


def test_eight_points_would_leave_the_mass_singular():
    nodes = parallelepiped(np.eye(3))
    assert np.linalg.matrix_rank(mass_matrices(nodes, ONE, 1.0, 2)[0]) == 8
    assert np.linalg.matrix_rank(mass_matrices(nodes, ONE, 1.0, 3)[0]) == 20


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-0.4, 0.4), min_size=9, max_size=9))
def test_mass_and_inertia_of_a_parallelepiped(entries):
    spans = np.eye(3) + np.reshape(entries, (3, 3)) * (1 - np.eye(3))
    if np.linalg.det(spans) < 0.1:
        return
    nodes, density = parallelepiped(spans), 2700.0
    mass, _ = assemble(nodes, ONE, Material(1.0, 0.3, density))
    total = density * np.linalg.det(spans)
    motions = rigid_modes(nodes, np.zeros(3))
    gram = motions.T @ (mass @ motions)
    second = total / 12 * spans.T @ spans
    np.testing.assert_allclose(gram[:3, :3], total * np.eye(3), rtol=0, atol=1e-12 * total)
    np.testing.assert_allclose(
        gram[3:, 3:], np.trace(second) * np.eye(3) - second, rtol=0, atol=1e-12 * total
    )
    np.testing.assert_allclose(gram[:3, 3:], 0, rtol=0, atol=1e-12 * total)


def test_a_bar_stretches_as_hooke_says():
    """Uniaxial tension of one brick: the strain is stress / E, the contraction nu times it."""
    nodes = parallelepiped(np.diag([2.0, 0.5, 0.4]))
    stiffness = stiffness_matrices(nodes, ONE, ALUMINUM)[0]
    strain = np.diag([1.0, -ALUMINUM.poisson, -ALUMINUM.poisson]) * 1e-3
    forces = (stiffness @ (nodes @ strain).ravel()).reshape(20, 3)
    pull = forces[nodes[:, 0] > 0.9].sum(axis=0)
    np.testing.assert_allclose(pull, [ALUMINUM.young * 1e-3 * 0.2, 0, 0], rtol=0, atol=1e-6)


def test_a_folded_element_is_refused():
    nodes = parallelepiped(np.eye(3))
    with pytest.raises(UserError, match="element 1 of the mesh is folded"):
        assemble(np.vstack([nodes, nodes * [1, 1, -1]]), np.vstack([ONE, ONE + 20]), ALUMINUM)


def test_a_node_that_is_not_finite_is_refused():
    nodes = parallelepiped(np.eye(3))
    nodes[3, 1] = np.nan
    with pytest.raises(UserError, match="node 3 of the mesh is not finite"):
        assemble(nodes, ONE, ALUMINUM)


def test_shares_of_a_square_facet_are_the_published_ones():
    """3/76 for corners and 16/76 for middles (Cook, Concepts and Applications of FEA, Section 11.3)."""
    shares = lumped_areas(np.concatenate([CORNERS, EDGES]), np.arange(8)[None])
    np.testing.assert_allclose(shares, np.array([3] * 4 + [16] * 4) / 76, rtol=1e-14)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"young": 0.0}, "Young's modulus is 0.0 Pa"),
        ({"young": np.nan}, "Young's modulus is nan Pa"),
        ({"poisson": 0.5}, "Poisson's ratio is 0.5"),
        ({"density": -1.0}, "density is -1.0"),
    ],
)
def test_impossible_materials_are_refused(changes, message):
    with pytest.raises(UserError, match=message):
        Material(**{"young": 1.0, "poisson": 0.3, "density": 1.0} | changes)
