"""Meshes: node numbers, sets and the shares of the optical surface's area."""

import meshio
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from wavequake.errors import UserError
from wavequake.mechanics.importers.areas import FACETS, area_shares
from wavequake.mechanics.importers.bulk import Card, axes_at, basic
from wavequake.mechanics.importers.mesh import MeshFile, chosen_nodes, read_mesh
from wavequake.mechanics.nodal.solids import integrated

DECK = """*HEADING
two hexahedra
*NODE
 11, 0, 0, 0
 12, 1, 0, 0
 13, 1, 1, 0
 14, 0, 1, 0
*INCLUDE, INPUT=top.inc
*NODE PRINT, NSET=Q
U
*ELEMENT, TYPE=C3D8I, ELSET=block
1, 11, 12, 13, 14,
21, 22, 23, 24
*NSET, NSET=Bottom, GENERATE
11, 14
*NSET, NSET=ODD, GENERATE
11, 23, 12
*NSET, NSET=BOTH
BOTTOM, 21
"""
TOP = "*NODE, NSET=TOP\n21, 0, 0, 2\n22, 1, 0, 2\n23, 1, 1, 2\n24, 0, 1, 2\n"


@pytest.fixture
def deck(tmp_path):
    (tmp_path / "top.inc").write_text(TOP)
    (tmp_path / "block.inp").write_text(DECK)
    return tmp_path / "block.inp"


def test_deck_keeps_node_numbers_and_sets(deck):
    mesh = read_mesh(deck)
    assert_array_equal(mesh.labels, [11, 12, 13, 14, 21, 22, 23, 24])
    assert_array_equal(mesh.points[5], [1, 0, 2])
    sets = {name: nodes.tolist() for name, nodes in mesh.sets.items()}
    assert sets == {
        "TOP": [21, 22, 23, 24],
        "BOTTOM": [11, 12, 13, 14],
        "ODD": [11, 23],
        "BOTH": [21, 11, 12, 13, 14],
        "BLOCK": [11, 12, 13, 14, 21, 22, 23, 24],
    }
    assert_array_equal(mesh.cells["hexahedron"], [[11, 12, 13, 14, 21, 22, 23, 24]])


def test_choice_keeps_its_order_and_drops_repetitions(deck):
    mesh = read_mesh(deck)
    assert_array_equal(chosen_nodes(mesh, [23, "top", 11], "interfaces"), [6, 4, 5, 7, 0])


def test_what_calculix_leaves_out_or_passes_over(tmp_path):
    """As in its test_channeljoint1a (coordinates), test_dloadlinIf (nodes) and decks with directed beams."""
    (tmp_path / "d.inp").write_text(
        "*NODE\n1\n2, 1.5\n3,2.,0.,\n4, ,3.\n5,1.,2.,3.\n"
        "*ELEMENT, TYPE=B31\n1, 1, 2, 5\n2, 2, 3, 5\n*ELEMENT, TYPE=C3D4\n3,1,2,\n3,4,5\n"
    )
    mesh = read_mesh(tmp_path / "d.inp")
    assert_array_equal(mesh.points, [[0, 0, 0], [1.5, 0, 0], [2, 0, 0], [0, 3, 0], [1, 2, 3]])
    assert_array_equal(mesh.cells["line"], [[1, 2], [2, 3]])
    assert_array_equal(mesh.cells["tetra"], [[1, 2, 3, 4]])


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        (" 12, 1, 0, 0", " 12, 1, 0, 0, 5", "block.inp, line 5: 4 numbers expected"),
        (" 12, 1, 0, 0", " 12, 1, O, 0", "block.inp, line 5: 4 numbers expected"),
        ("21, 22, 23, 24\n", "21, 22, 23\n", "block.inp, line 12: elements of 8 nodes expected"),
        ("BOTTOM, 21", "BOTOM, 21", "line 19: the node set 'BOTOM' is not defined before"),
        (" 14, 0, 1, 0", " 13, 0, 1, 0", "defines a node number twice"),
        ("1, 11, 12, 13, 14", "1, 11, 12, 13, 15", "element 1 stands on node 15, which the file lacks"),
        (" 14, 0, 1, 0", " 14, 0, nan, 0", "node 14 has no finite coordinates"),
        ("top.inc", "bottom.inc", "bottom.inc cannot be read"),
    ],
)
def test_damaged_deck(deck, old, new, match):
    deck.write_text(deck.read_text().replace(old, new))
    with pytest.raises(UserError, match=match):
        read_mesh(deck)


def test_a_deck_that_ends_within_a_line_is_cut_off(deck):
    """A 1.25 that ends as 1.2 reads as a number; keywords and comments may end without an end."""
    deck.write_text("*NODE\n1, 0, 0, 0\n2, 0, 0, 1.2")
    with pytest.raises(UserError, match=r"block.inp, line 3 has no end: the file is cut off"):
        read_mesh(deck)
    deck.write_text("*NODE\n1, 0, 0, 0\n2, 0, 0, 1.2\n** end")
    assert read_mesh(deck).points[1, 2] == 1.2


def test_deck_without_nodes(deck):
    deck.write_text("*STEP\n*END STEP\n")
    with pytest.raises(UserError, match="has no nodes"):
        read_mesh(deck)


def square():
    points = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 0]])
    triangles = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    return meshio.Mesh(points, [("triangle", triangles)])


def test_vtu_counts_nodes_from_one(tmp_path):
    square().write(tmp_path / "square.vtu")
    mesh = read_mesh(tmp_path / "square.vtu")
    assert_array_equal(mesh.labels, [1, 2, 3, 4, 5])
    assert_array_equal(mesh.cells["triangle"][0], [1, 2, 5])


def test_gmsh_physical_groups_are_node_sets(tmp_path):
    mesh = square()
    mesh.cell_data = {"gmsh:physical": [np.array([7, 7, 8, 8])], "gmsh:geometrical": [np.array([1, 1, 2, 2])]}
    mesh.field_data = {"lower": np.array([7, 2]), "upper": np.array([8, 2])}
    mesh.write(tmp_path / "square.msh", file_format="gmsh22", binary=False)
    read = read_mesh(tmp_path / "square.msh")
    assert_array_equal(read.sets["lower"], [1, 2, 3, 5])
    assert_array_equal(read.sets["upper"], [1, 3, 4, 5])


def test_nastran_deck_keeps_node_numbers(tmp_path):
    lines = ["BEGIN BULK"]
    lines += [
        f"GRID    {n:8d}        {x:8.3f}{y:8.3f}{0.0:8.3f}" for n, x, y in [(5, 0, 0), (9, 1, 0), (70, 0, 1)]
    ]
    lines += [f"CTRIA3  {1:8d}{1:8d}{5:8d}{9:8d}{70:8d}", "ENDDATA"]
    (tmp_path / "t.bdf").write_text("\n".join(lines))  # behind ENDDATA no end of a line is needed
    mesh = read_mesh(tmp_path / "t.bdf")
    assert_array_equal(mesh.labels, [5, 9, 70])
    assert_array_equal(mesh.points[2], [0, 1, 0])
    assert_array_equal(mesh.cells["triangle"], [[5, 9, 70]])


# A unit cube in Nastran's order: corners, middles below, upright, above (Quick Reference Guide, CHEXA).
CUBE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 5), (2, 6), (3, 7), (4, 5), (5, 6), (6, 7), (7, 4)]
WEDGE_EDGES = [(0, 1), (1, 2), (2, 0), (0, 3), (1, 4), (2, 5), (3, 4), (4, 5), (5, 3)]


def bulk_deck(folder, name, points, wide=False):
    """An element with nodes from 11 on; lines that continue a card begin with blanks alone."""
    lines = ["SOL 101", "CEND", "BEGIN BULK"]
    for number, (x, y, z) in enumerate(points, start=11):
        if wide:
            lines += [f"GRID*   {number:16d}{'':16s}{x:16.8f}{y:16.8f}*G", f"*G      {z:16.8f}"]
        else:
            lines.append(f"GRID,{number},,{x},{y},{z}")
    fields = [1, 1, *range(11, 11 + len(points))]
    for first in range(0, len(fields), 8):
        head = f"{name:8s}" if first == 0 else " " * 8
        lines.append(head + "".join(f"{field:8d}" for field in fields[first : first + 8]))
    path = folder / "deck.bdf"
    path.write_text("\n".join([*lines, "ENDDATA", "no card"]) + "\n")
    return read_mesh(path)


@pytest.mark.parametrize(
    ("name", "kind", "corners", "edges", "volume"),
    [
        ("CHEXA", "hexahedron20", CUBE, EDGES, 1.0),
        ("CPENTA", "wedge15", CUBE[[0, 1, 3, 4, 5, 7]], WEDGE_EDGES, 0.5),
    ],
)
def test_quadratic_solids_of_nastran_are_in_the_order_of_vtk(tmp_path, name, kind, corners, edges, volume):
    """An element whose nodes are where its shape functions want them has its volume and no fold."""
    points = np.vstack([corners, [corners[list(edge)].mean(axis=0) for edge in edges]])
    for wide in (False, True):
        mesh = bulk_deck(tmp_path, name, points, wide)
        found = integrated(kind, mesh.points, mesh.cells[kind] - 11)
        assert found.volumes.sum() == pytest.approx(volume, rel=1e-12)
        assert_allclose(found.volumes.sum(axis=1), volume)
        straight = np.einsum("egka,kb->egab", found.gradients, mesh.points[mesh.cells[kind][0] - 11])
        assert_allclose(straight, np.broadcast_to(np.eye(3), straight.shape), atol=1e-12)


def test_continuations_without_a_name_belong_to_their_card(tmp_path):
    """Eight corners go over two lines; a reader that drops the second makes a wedge of a brick."""
    mesh = bulk_deck(tmp_path, "CHEXA", CUBE)
    assert_array_equal(mesh.cells["hexahedron"], [range(11, 19)])


def test_nodes_stand_in_the_axes_that_their_cards_name(tmp_path):
    (tmp_path / "axes.bdf").write_text(
        "BEGIN BULK\n"
        "GRDSET,,20,,,,7\n"
        "CORD2R,10,,1.,2.,3.,1.,2.,4.,,\n+,1.,3.,3.\n"  # origin 1, 2, 3; z stays, x is y
        "CORD2C,20,10,0.,0.,0.,0.,0.,1.,,\n,1.,0.,0.\n"
        "CORD2S,30,,0.,0.,0.,0.,0.,1.,,\n,1.,0.,0.\n"
        "GRID,1,10,1.,0.,0.,0\nGRID,2,,2.,90.,5.\nGRID,3,30,2.,90.,30.,0\nGRID,4,0,1.5-1,2.d0,3,0\n"
    )
    mesh = read_mesh(tmp_path / "axes.bdf")
    exact = [[1, 3, 3], [-1, 2, 8], [np.sqrt(3), 1, 0], [0.15, 2, 3]]
    assert_allclose(mesh.points, exact, atol=1e-14)
    assert_array_equal(mesh.turned, [2])


def test_cards_that_repeat_others_are_counted_on(tmp_path):
    (tmp_path / "row.bdf").write_text(
        "BEGIN BULK\nGRID,1,,0.,2.,1.5\n=,*1,=,*(1.5),==\n=(2)\nGRID,9,,1.,1.,1.\n"
        "GRID          10            -.25\n=         *(10)       =   *-.5      7.\nENDDATA\n"
    )
    mesh = read_mesh(tmp_path / "row.bdf")
    assert_array_equal(mesh.labels, [1, 2, 3, 4, 9, 10, 20])
    assert_allclose(mesh.points[:4], [[x, 2.0, 1.5] for x in (0.0, 1.5, 3.0, 4.5)])
    assert_allclose(mesh.points[4:], [[1, 1, 1], [-0.25, 0, 0], [-0.75, 7, 0]])


@pytest.mark.parametrize("kind", ["CORD2R", "CORD2C", "CORD2S"])
def test_axes_of_a_node_are_the_ways_in_which_its_coordinates_move_it(kind):
    numbers = ["0.5", "-1.", "2.", "0.7", "0.", "3.", "2.", "0.5", "1.5"]
    axes = {"4": Card(kind, ["4", "", *numbers], 1)}
    place = np.array([[1.3, 40.0, 55.0]])
    step = 1e-5
    moved = np.concatenate([place + step * unit for unit in (*np.eye(3), *-np.eye(3))])
    ways = basic(moved, "4", axes, "deck")
    ways = (ways[:3] - ways[3:]).T
    here = basic(place, "4", axes, "deck")
    found = axes_at(here, "4", axes, "deck")[0]
    assert_allclose(found, ways / np.linalg.norm(ways, axis=0), atol=1e-9)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("=,*1,==\n", "line 2: there is no card before it that = repeats"),
        ("GRID,1\n=3\n", r"line 3: no card \(=\) before it says what is repeated"),
        ("GRID,1\n=,*1,==\n=x\n", "line 4: '=X' is not how often a card is repeated"),
        ("GRID,1\n=,*1,==\n=9999999\n", "line 4: '=9999999' is not how often a card is repeated"),
        ("GRID,1,5\n", "in the axes 5, which no CORD2R"),
        ("GRID,1\nCTRIA3,1,1,1,2\n", "line 3: CTRIA3 has fewer nodes than corners"),
        ("GRID,1,5\nCORD2R,5,,0.,0.,0.,0.,0.,1.\n", "line 3: CORD2R 5 needs three points"),
        ("GRID,1,5\nCORD2R,5,,0.,0.,0.,0.,0.,1.,,\n,0.,0.,2.\n", "line 3: CORD2R 5 needs three points"),
        ("GRID*,1,,x\n", "line 2: 'X' is not a number"),
        ("GRID,1,,x\n", "line 2: 'X' is not a number"),
        ("$ nothing\n", "has no nodes: no GRID card"),
        ("GRID,1,,1.2", "line 2 has no end, and ENDDATA is missing"),
        ("INCLUDE 'bad.bdf'\n", "line 2: bad.bdf includes itself"),
    ],
)
def test_bulk_data_that_cannot_be_read_is_refused_by_line(tmp_path, text, words):
    (tmp_path / "bad.bdf").write_text("BEGIN BULK\n" + text)
    with pytest.raises(UserError, match=words):
        read_mesh(tmp_path / "bad.bdf")


def test_unreadable_mesh(tmp_path):
    (tmp_path / "a.vtu").write_text("no mesh")
    with pytest.raises(UserError, match=r"meshio cannot read a.vtu"):
        read_mesh(tmp_path / "a.vtu")


def one_facet(kind, places):
    points = np.column_stack([places, np.zeros(len(places))])
    return MeshFile(
        kind, np.arange(1, len(points) + 1), points, {}, {kind: np.arange(1, len(points) + 1)[None]}
    )


# Shares of a quadratic square from the integrals of its squared shape functions, by Gauss-Legendre rule.
def test_shares_of_the_eight_node_facet():
    nodes, weights = np.polynomial.legendre.leggauss(4)
    x, y = (grid.ravel() for grid in np.meshgrid(nodes, nodes))
    w = np.outer(weights, weights).ravel()
    corners = [(1 + sx * x) * (1 + sy * y) * (sx * x + sy * y - 1) / 4 for sx in (-1, 1) for sy in (-1, 1)]
    middles = [(1 - x**2) * (1 + s * y) / 2 for s in (-1, 1)] + [
        (1 - y**2) * (1 + s * x) / 2 for s in (-1, 1)
    ]
    squares = np.array([(w * shape**2).sum() for shape in corners + middles])
    places = [(-1, -1), (1, -1), (1, 1), (-1, 1), (0, -1), (1, 0), (0, 1), (-1, 0)]
    order = [0, 2, 3, 1, 4, 7, 5, 6]  # of the lists above, around the square
    shares = area_shares(one_facet("quad8", places), np.arange(8))
    assert_allclose(shares, (squares / squares.sum())[order], rtol=1e-12)


def test_shares_of_the_six_node_facet():
    # Integrals over a triangle of area 1/2 of L1^a L2^b L3^c: a! b! c! / (a + b + c + 2)!
    corner = 4 * 24 / 720 - 4 * 6 / 120 + 2 / 24  # (L (2 L - 1))^2
    middle = 16 * 4 / 720  # (4 L1 L2)^2
    expected = np.array([corner] * 3 + [middle] * 3) / (3 * corner + 3 * middle)
    places = [(0, 0), (3, 1), (1, 2), (1.5, 0.5), (2, 1.5), (0.5, 1)]
    assert_allclose(area_shares(one_facet("triangle6", places), np.arange(6)), expected, rtol=1e-12)


NATURAL = {
    "tetra10": [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)],
    "wedge15": [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1)],
    "hexahedron20": [
        (0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)
    ],
}  # fmt: skip
EDGES = {
    "tetra10": [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)],
    "wedge15": [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)],
    "hexahedron20": [
        (0, 1),
        (1, 2),
        (2, 3),
        (3, 0),
        (4, 5),
        (5, 6),
        (6, 7),
        (7, 4),
        (0, 4),
        (1, 5),
        (2, 6),
        (3, 7),
    ],
}


@pytest.mark.parametrize("kind", sorted(NATURAL))
def test_facets_are_the_flat_sides_with_their_middle_nodes(kind):
    corners = np.array(NATURAL[kind], dtype=float)
    points = np.vstack([corners, [corners[list(edge)].mean(axis=0) for edge in EDGES[kind]]])
    inner = points.mean(axis=0)
    for facet in FACETS[kind]:
        side = points[list(facet)]
        normal = np.cross(side[1] - side[0], side[2] - side[0])
        assert_allclose((side - side[0]) @ normal, 0.0, rtol=0, atol=1e-12)
        assert abs((inner - side[0]) @ normal) > 0.1
        ring = len(facet) // 2
        assert_allclose(side[ring:], (side[:ring] + np.roll(side[:ring], -1, axis=0)) / 2, rtol=0, atol=1e-12)
    assert len({tuple(sorted(facet)) for facet in FACETS[kind]}) == len(FACETS[kind])
    stem = {"tetra10": "tetra", "wedge15": "wedge", "hexahedron20": "hexahedron"}[kind]
    count = {"tetra": 3}.get(stem, 4)
    assert FACETS[stem] == tuple(f[: len(f) // 2] for f in FACETS[kind])
    assert max(len(f) for f in FACETS[stem]) == count


def grid_mesh(xs, ys, kind="quad"):
    points = np.array([(x, y, 0.0) for y in ys for x in xs])
    n = len(xs)
    cells = np.array(
        [(a, a + 1, a + n + 1, a + n) for row in range(len(ys) - 1) for a in range(row * n, row * n + n - 1)]
    )
    return MeshFile("grid", np.arange(1, len(points) + 1), points, {}, {kind: cells + 1} if kind else {})


def test_shares_of_an_uneven_grid_are_its_trapezoidal_weights():
    xs, ys = np.array([0.0, 1.0, 4.0]), np.array([0.0, 2.0])
    shares = area_shares(grid_mesh(xs, ys), np.arange(6))
    expected = np.outer([0.5, 0.5], [0.5, 2.0, 1.5]).ravel() / 4.0
    assert_allclose(shares, expected, rtol=1e-14)


def test_a_facet_shared_by_two_elements_counts_once():
    mesh = grid_mesh(np.arange(3.0), np.arange(2.0))
    quads = mesh.cells["quad"]
    twice = MeshFile("grid", mesh.labels, mesh.points, {}, {"quad": np.vstack([quads, quads[:1]])})
    assert_allclose(area_shares(twice, np.arange(6)), area_shares(mesh, np.arange(6)), rtol=1e-14)


def test_top_of_a_brick_of_twenty_nodes():
    corners = np.array(NATURAL["hexahedron20"], dtype=float)
    points = np.vstack([corners, [corners[list(edge)].mean(axis=0) for edge in EDGES["hexahedron20"]]])
    mesh = MeshFile("brick", np.arange(1, 21), points, {}, {"hexahedron20": np.arange(1, 21)[None]})
    shares = area_shares(mesh, np.flatnonzero(points[:, 2] == 1.0))
    assert_allclose(shares, [3 / 76] * 4 + [16 / 76] * 4, rtol=1e-14)


def test_bare_nodes_share_the_area_of_triangles_and_leave_holes_open():
    angles = np.arange(60) * 2 * np.pi / 60
    rings = [0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]
    points = np.array([(r * np.cos(a), r * np.sin(a), 0.1 * r**2) for r in rings for a in angles])
    mesh = MeshFile("annulus", np.arange(len(points)), points)
    shares = area_shares(mesh, np.arange(len(points)))
    assert shares.min() > 0.0
    assert_allclose(shares.sum(), 1.0, rtol=1e-14)
    # Second moment of the annulus: (1 + 0.4^2) / 2. A filled hole would draw it down to 0.54.
    assert_allclose(shares @ (points[:, 0] ** 2 + points[:, 1] ** 2), 0.58, rtol=0.01)


@pytest.mark.parametrize("count", [2, 5])
def test_nodes_on_a_line_are_no_surface(count):
    points = np.outer(np.arange(count), [1.0, 2.0, 3.0])
    with pytest.raises(UserError, match="span no surface"):
        area_shares(MeshFile("line", np.arange(count), points), np.arange(count))
