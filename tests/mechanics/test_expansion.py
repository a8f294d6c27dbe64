"""Thermal expansion of solid bodies against closed forms: free bodies without stress, plates, held bodies."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from wavequake.errors import UserError
from wavequake.mechanics.importers.ansys_reader import read_results
from wavequake.mechanics.importers.mesh import read_mesh
from wavequake.mechanics.mirrors.deck import write_deck
from wavequake.mechanics.mirrors.models import ALUMINUM, CircularMirror, mirror_mesh
from wavequake.mechanics.nodal.expansion import Material, Solid, expanded, solid_of
from wavequake.mechanics.nodal.rst import read_rst
from wavequake.mechanics.nodal.solids import KINDS
from wavequake.mechanics.nodal.temperatures import thermal_displacements
from wavequake.mechanics.nodal.thermal import Thermal

DATA = Path(__file__).parents[1] / "data"
ALPHA = 2e-5
SKEW = np.array([[1.0, 0.2, 0.1], [0.0, 0.8, -0.3], [0.1, 0.0, 1.3]])  # of a single element


def one_element(kind):
    points = KINDS[kind][0] @ SKEW.T + np.array([0.5, -0.2, 0.3])
    return Solid(kind, points, {kind: np.arange(len(points))[None]})


def block():
    mesh = read_mesh(DATA / "tetrahedra.inp")
    return solid_of(mesh.source, mesh.labels, mesh.points, mesh.cells)


def test_an_element_numbered_the_other_way_round_is_the_same():
    points = KINDS["tetra10"][0] @ SKEW.T
    mirrored = np.array([[0, 2, 1, 3, 6, 5, 4, 7, 9, 8]])
    warmer = points[None, :, 2] * 7.0
    one, other = (
        expanded(Solid("t", points, {"tetra10": nodes}), warmer, [Material(ALPHA, 0.3)])
        for nodes in (np.arange(10)[None], mirrored)
    )
    assert_allclose(other, one, rtol=0, atol=1e-17)


def gradient_field(points, g):
    """Displacements of a free body with T = g z: without stress, planes bend to spheres of alpha g."""
    x, y, z = points.T
    return ALPHA * g * np.column_stack([x * z, y * z, (z**2 - x**2 - y**2) / 2])


def same_but_for_rigid_motion(found, exact, points):
    modes = np.concatenate([np.tile(np.eye(3), (len(points), 1))[:, :, None].transpose(0, 2, 1)])[:, 0]
    arm = points - points.mean(axis=0)
    turns = np.cross(np.eye(3)[None], arm[:, None, :]).transpose(0, 2, 1).reshape(-1, 3)
    rigid = np.hstack([modes, turns])
    left = (found - exact).ravel()
    left = left - rigid @ np.linalg.lstsq(rigid, left, rcond=None)[0]
    assert np.abs(left).max() < 1e-12 * np.abs(exact).max()


@pytest.mark.parametrize("kind", KINDS)
def test_a_free_body_grows_as_a_whole(kind):
    """Of uniform warming: by alpha dT about its center of mass, which is that of its volume."""
    body = one_element(kind)
    (found,) = expanded(body, np.full((1, len(body.points)), 30.0), [Material(ALPHA, 0.3)])
    center = {"tetra": [0.25] * 3, "hexahedron": [0.0] * 3, "wedge": [1 / 3, 1 / 3, 0.0]}[kind.rstrip("0125")]
    middle = SKEW @ center + np.array([0.5, -0.2, 0.3])
    assert_allclose(found, 30.0 * ALPHA * (body.points - middle), rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    "body", [*map(one_element, ("tetra10", "hexahedron20", "wedge15")), block()], ids=str
)
@pytest.mark.parametrize("poisson", [0.0, 0.33])
def test_a_linear_gradient_bends_a_free_body_without_stress(body, poisson):
    warmer = 50.0 * body.points[None, :, 2]
    (found,) = expanded(body, warmer, [Material(ALPHA, poisson)])
    same_but_for_rigid_motion(found, gradient_field(body.points, 50.0), body.points)


def mirror_body(layers=1, thickness=0.02):
    mesh = mirror_mesh(
        CircularMirror(thickness=thickness, core=4, rings=4, layers=layers, focal_length=np.inf)
    )
    return mesh, Solid("disc", mesh.nodes, {"hexahedron20": mesh.elements})


def curvature(body, nodes, moved):
    """Of displacements along z, by a fit of their paraboloid within 0.3 of a radius of 0.5, 1/m."""
    x, y = body.points[nodes, :2].T
    inside = np.hypot(x, y) < 0.3
    columns = np.column_stack([np.ones_like(x), x, y, (x**2 + y**2) / 2])[inside]
    return np.linalg.lstsq(columns, moved[nodes, 2][inside], rcond=None)[0][3]


def test_a_gradient_through_a_disc_curves_it_by_alpha_times_the_gradient():
    mesh, body = mirror_body()  # whose elements at the rim are curved, so that it is not exact
    (found,) = expanded(body, 1000.0 * body.points[None, :, 2], [Material(ALPHA, 0.33)])
    assert curvature(body, mesh.front_nodes, found) == pytest.approx(-ALPHA * 1000.0, rel=2e-4)


def test_a_cubic_profile_bends_a_thin_plate_by_its_moment():
    """Away from the rim by 12 alpha / h^3 integral(T z dz) = 1.2 alpha T / h (Timoshenko 1959, ch. 2)."""
    thickness = 0.02
    mesh, body = mirror_body(layers=4, thickness=thickness)
    height = (body.points[:, 2] + thickness / 2) / (thickness / 2)  # from -1 to 1
    (found,) = expanded(body, 10.0 * height[None] ** 3, [Material(ALPHA, 0.33)])
    assert curvature(body, mesh.front_nodes, found) == pytest.approx(
        -1.2 * ALPHA * 10.0 / thickness, rel=0.01
    )


def test_mounts_hold_a_body_where_they_are():
    mesh, body = mirror_body()
    (free,) = expanded(body, np.full((1, len(body.points)), 10.0), [Material(ALPHA, 0.33)])
    (held,) = expanded(body, np.full((1, len(body.points)), 10.0), [Material(ALPHA, 0.33)], mesh.mounts)
    assert_allclose(held[mesh.mounts].mean(axis=0), 0.0, atol=1e-17)
    # The front face is a thickness of 20 mm above the mounts on the rear.
    assert_allclose(held[mesh.front_nodes, 2], 10.0 * ALPHA * 0.02, rtol=1e-9)
    assert_allclose(free[mesh.front_nodes, 2], 10.0 * ALPHA * 0.01, rtol=1e-9)


def deck(folder):
    mesh = mirror_mesh(CircularMirror(core=2, rings=2, focal_length=np.inf))
    write_deck(folder / "disc.inp", mesh, ALUMINUM)
    return mesh, folder / "disc.inp"


def test_temperatures_of_a_csv_by_number_or_place_over_time(tmp_path):
    mesh, path = deck(tmp_path)
    z = mesh.nodes[:, 2]
    both = np.concatenate([20.0 + 0 * z, 30.0 + 100.0 * z])
    time, number = np.repeat([0.0, 60.0], len(z)), np.tile(np.arange(1, len(z) + 1), 2)
    order = np.random.default_rng(0).permutation(len(both))
    places = np.tile(mesh.nodes, (2, 1)) * 1e3
    rows = np.column_stack([time, number, places, both])[order]
    names = "time_s,node,x_mm,y_mm,z_mm,temperature_c"
    np.savetxt(tmp_path / "t.csv", rows, "%.12g", ",", header=names, comments="")
    np.savetxt(
        tmp_path / "n.csv", rows[:, [0, 1, 5]], "%.12g", ",", header="time_s,node,temperature_c", comments=""
    )
    np.savez(
        tmp_path / "t.npz", nodes_mm=mesh.nodes * 1e3, temperatures_c=both.reshape(2, -1), time_s=[0, 60]
    )
    thermal = Thermal(expansion_per_k=ALPHA, reference=20, nodes="SURFACE", held="INTERFACES")
    warmer = np.stack([0 * z, 10.0 + 100.0 * z])
    body = Solid("disc", mesh.nodes, {"hexahedron20": mesh.elements})
    exact = expanded(body, warmer, [Material(ALPHA, 0.33)], mesh.mounts)[:, mesh.front_nodes]
    for name in ("t.csv", "n.csv", "t.npz"):
        found = thermal_displacements(tmp_path / name, "m", path, thermal)
        assert (found.kind, found.values.tolist()) == ("time", [0.0, 60.0])
        assert_allclose(found.motions, exact, atol=1e-13)
        assert_allclose(found.points, mesh.nodes[mesh.front_nodes], atol=1e-12)
    np.savetxt(tmp_path / "t.txt", np.column_stack([mesh.nodes, 30.0 + 100.0 * z]), "%.12g")
    found = thermal_displacements(tmp_path / "t.txt", "m", path, thermal)
    assert_allclose(found.motions[0], exact[1], atol=1e-13)


def test_temperatures_of_nastran_are_those_of_heat_conduction_through_two_bricks():
    """1300 at one end and 300 at the other, so 800 in the middle: they grow so much along z, in the mean."""
    points = np.array([[x, y, z] for z in range(3) for y in range(2) for x in range(2)], dtype=float)
    found = thermal_displacements(
        DATA / "nodal" / "hot_bricks.op2",
        "m",
        DATA / "nodal" / "hot_bricks.inp",
        Thermal(expansion_per_k=1e-5, reference=0),
    )
    assert_allclose(found.points, points)
    length = found.motions[0, 8:, 2].mean() - found.motions[0, :4, 2].mean()
    assert length == pytest.approx(2.0 * 1e-5 * 800.0, rel=1e-7)
    sides = [np.ptp(found.motions[0, 4 * end : 4 * end + 4, 0]) for end in range(3)]
    assert_allclose(sides, [13e-3, 8e-3, 3e-3], rtol=0.1)  # of bricks that bend no better than linearly


FRD = """    1C
    2C                             4                                     1
 -1         1 0.00000E+00 0.00000E+00 0.00000E+00
 -1         2 1.00000E+00 0.00000E+00 0.00000E+00
 -1         3 0.00000E+00 1.00000E+00 0.00000E+00
 -1         4 0.00000E+00 0.00000E+00 1.00000E+00
 -3
    1PSTEP                         1           1           1
  100CL  101 1.000000000           4                     0    1           1
 -4  NDTEMP      1    1
 -5  T           1    1    0    0
 -1         1 2.50000E+01
 -1         2 2.50000E+01
 -1         3 2.50000E+01
 -1         4 2.50000E+01
 -3
 9999
"""
TETRA = "*NODE\n1,0,0,0\n2,1,0,0\n3,0,1,0\n4,0,0,1\n5,1,1,1\n*ELEMENT, TYPE=C3D4\n1,1,2,3,4\n"


def test_temperatures_of_calculix(tmp_path):
    (tmp_path / "t.frd").write_text(FRD)
    (tmp_path / "t.inp").write_text(TETRA)
    found = thermal_displacements(
        tmp_path / "t.frd", "mm", tmp_path / "t.inp", Thermal(expansion_per_k=ALPHA, reference=20)
    )
    corner = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert_allclose(found.motions[0], 5.0 * ALPHA * 1e-3 * (corner - 0.25), rtol=1e-9, atol=1e-18)


class AnsysResults:
    """As ansys-mapdl-reader shows a file: two load steps of a quadratic tetrahedron, in mm."""

    n_results, time_values, _resultheader = 2, [1.0, 2.0], {"kan": 0}
    points = KINDS["tetra10"][0] * [20.0, 30.0, 40.0]
    mesh = SimpleNamespace(nnum=np.arange(1, 11), nodes=points)

    def nodal_temperature(self, step):
        """Of corners, as results of structures have them; ansys-mapdl-reader has nan amid edges."""
        warm = 20.0 + step * 50.0 * self.points[:, 2] * 1e-3
        return np.arange(1, 11), np.where(np.arange(10) < 4, warm, np.nan)

    def nodal_displacement(self, step):
        return np.arange(1, 11), np.zeros((10, 6))


def test_temperatures_of_ansys_bend_a_body_without_stress(tmp_path, monkeypatch):
    """Those amid edges are the means of the ends, so a linear field is met to rounding."""
    reader = SimpleNamespace(read_binary=lambda path: AnsysResults())
    for name in ("ansys", "ansys.mapdl", "ansys.mapdl.reader"):
        monkeypatch.setitem(
            sys.modules, name, SimpleNamespace(mapdl=SimpleNamespace(reader=reader), reader=reader)
        )
    monkeypatch.setattr(
        "wavequake.mechanics.nodal.rst.reader_arrays", lambda path, what: read_results(path, what)
    )
    points = AnsysResults.points
    nodes = [f"{k}, {x!r}, {y!r}, {z!r}" for k, (x, y, z) in enumerate(points.tolist(), 1)]
    deck = ["*NODE", *nodes, "*ELEMENT, TYPE=C3D10", "1,1,2,3,4,5,6,7,8,9,10"]
    (tmp_path / "t.inp").write_text("\n".join([*deck, ""]))
    for name in ("t.rst", "t.rth"):
        found = thermal_displacements(
            tmp_path / name, "mm", tmp_path / "t.inp", Thermal(expansion_per_k=ALPHA, reference=20)
        )
        assert (found.kind, found.values.tolist()) == ("case", [1.0, 2.0])
        assert np.abs(found.motions[0]).max() < 1e-20
        same_but_for_rigid_motion(found.motions[1], gradient_field(points * 1e-3, 50.0), points * 1e-3)
    assert read_rst(tmp_path / "t.rst").steps[1].values.shape == (10, 3)


def test_temperatures_of_points_without_places_are_passed_over(tmp_path):
    beyond = " -1         4 2.50000E+01\n"
    (tmp_path / "t.frd").write_text(FRD.replace(beyond, beyond + beyond.replace("4 2.5", "9 9.5")))
    (tmp_path / "t.inp").write_text(TETRA)
    found = thermal_displacements(
        tmp_path / "t.frd", "mm", tmp_path / "t.inp", Thermal(expansion_per_k=ALPHA, reference=20)
    )
    assert np.ptp(found.motions[0], axis=0) == pytest.approx([5.0 * ALPHA * 1e-3] * 3)


@pytest.mark.parametrize(
    ("csv", "inp", "thermal", "words"),
    [
        ("node,temperature_c\n1,3\n2,3\n3,3\n", TETRA, {}, "no temperature of node 4 of t.inp at step 1"),
        ("node,temperature_c\n1,3\n2,3\n3,3\n4,3\n2,4\n", TETRA, {}, "gives node 2 twice at one step"),
        (None, TETRA.replace("1,1,2,3,4", "1,1,2,3,9"), {}, "element 1 stands on node 9, which"),
        (None, TETRA.replace("5,1,1,1", "6,1,1,1").replace("1,1,2,3,4", "1,1,2,3,5"), {}, "stands on node 5"),
        ("node,x_mm,y_mm,z_mm,dx_mm,dy_mm,dz_mm\n1,0,0,0,0,0,0\n", TETRA, {}, "holds displacements"),
        (None, TETRA.split("*ELEMENT")[0], {}, "has no solid elements"),
        (None, TETRA.replace("1,1,2,3,4", "1,1,2,3,3"), {}, "element 1 of its tetras is folded"),
        (None, TETRA, {"held": [1]}, "leave it free to turn"),
        (None, TETRA, {"nodes": [5]}, "node 5 of t.inp belongs to no solid element"),
        (None, TETRA.replace("1,1,2,3,4", "1,1,2,3,4\n2,5,6,7,8").replace(
            "5,1,1,1", "5,5,5,5\n6,6,5,5\n7,5,6,5\n8,5,5,6"), {}, "some part is loose"),
    ],
)  # fmt: skip
def test_what_gives_no_displacements_is_said(tmp_path, csv, inp, thermal, words):
    rows = "".join(f"{node},25\n" for node in range(1, 9))
    (tmp_path / "t.csv").write_text(csv or "node,temperature_c\n" + rows)
    (tmp_path / "t.inp").write_text(inp)
    with pytest.raises(UserError, match=words):
        thermal_displacements(
            tmp_path / "t.csv",
            "mm",
            tmp_path / "t.inp",
            Thermal(expansion_per_k=ALPHA, reference=20, **thermal),
        )
